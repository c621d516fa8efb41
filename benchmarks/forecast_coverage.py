"""Whether the forecast's intervals hold in simulated houses.

    python -m benchmarks.forecast_coverage --houses 200

Growth differs by house, row, fruit and day; lengths are measured with errors. The fruit that were
seen are counted, in cells that the forecast calls complete.
"""

from __future__ import annotations

import argparse

from cucumbervision_lab.cli import show_tables
from cucumbervision_lab.evaluate.harvests import Scenario, houses_table

SCENARIOS = (
    *(Scenario("3±0.8 cm/day", links) for links in (0, 5, 50)),
    *(Scenario("1.5 cm/day", links, 1.5) for links in (0, 50)),
    *(Scenario("5 cm/day", links, 5.0) for links in (0, 50)),
    *(Scenario("slows, full at 45 cm", links, full_m=0.45) for links in (0, 5, 50, 500)),
)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--houses", type=int, default=200)
    count = parser.parse_args().houses
    show_tables([houses_table([[scenario] * count for scenario in SCENARIOS])])


if __name__ == "__main__":
    main()
