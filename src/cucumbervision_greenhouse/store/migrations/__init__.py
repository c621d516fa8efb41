"""Steps between the versions of the tables, by Alembic's operations: `STEPS[n]` from 3 + n on."""

from cucumbervision_greenhouse.store.migrations import v4

FIRST = 3
"""Version of the stores of 0.1.0, the oldest that are opened."""

STEPS = (v4.upgrade,)
