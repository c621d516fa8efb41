"""Accuracy and the intervals' coverage by size, tilt, distance, bend, hidden share, condition."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.accuracy.records import Record
from cucumbervision.accuracy.statistics import binomial_interval
from cucumbervision.accuracy.table import Cell, Column, Table
from cucumbervision.accuracy.tables import Truth, methods_against, readings, truth_m

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = [
    "Band",
    "CoverageRow",
    "Factor",
    "coverage_rows",
    "coverage_table",
    "factors_of",
    "group_table",
]

INTERVAL = {
    Truth.CENTRELINE: "interval",
    Truth.THREAD: "thread_interval",
    Truth.CHORD: "chord_interval",
}
LARGE_GROUP = 400  # fruit from which on coverage is held against fixed bounds
LARGE_GROUP_SHARE = (0.87, 0.93)  # for a 90 % interval; moved along with another level


@dataclass(frozen=True)
class Band:
    """A group of captures.

    Parameters
    ----------
    label : str
        With its bounds.
    holds : callable
        Whether a record, with its true length in metres, belongs to it.
    """

    label: str
    holds: Callable[[Record, float], bool]


@dataclass(frozen=True)
class Factor:
    """Something that lengths may depend on.

    Parameters
    ----------
    head : str
        What it is, with its unit.
    bands : tuple of Band
        Its groups; they may overlap.
    comment : str
        What is counted how.
    """

    head: str
    bands: tuple[Band, ...]
    comment: str = ""


@dataclass(frozen=True)
class CoverageRow:
    """How often M6's interval holds the true length, in one group.

    Parameters
    ----------
    factor, group : str
        What was grouped by, and the group.
    count, fruit_count : int
        Captures with an interval, and the fruit that they are of.
    hits : int
        Intervals that hold the truth.
    low, high : float
        Exact binomial 95 % interval of the share of hits.
    width_percent : float
        Mean width, percent of the length measured.
    as_stated : bool
        Whether this is as the level says: within three points for 400 fruit and more, else
        whether the binomial interval contains the level.
    """

    factor: str
    group: str
    count: int
    fruit_count: int
    hits: int
    low: float
    high: float
    width_percent: float
    as_stated: bool


def factors_of(records: Sequence[Record]) -> list[Factor]:
    """Give the factors that tell these records apart: at least two groups have captures.

    Examples
    --------
    >>> factors_of([])
    []
    """
    conditions = dict.fromkeys(r.condition for r in records)
    bases = dict.fromkeys(str(b) for r in records if (b := r.details.get("interval_basis")))
    factors = [
        *_FIXED,
        Factor("condition", tuple(_with_condition(name) for name in conditions)),
        Factor("what the interval rests on", tuple(_with_basis(name) for name in bases)),
    ]
    return [f for f in factors if sum(any(_in(b, r) for r in records) for b in f.bands) > 1]


def group_table(
    records: Sequence[Record], factor: Factor, truth: Truth, title: str = ""
) -> Table | None:
    """Give each method's MAPE by group, and M6's median, worst and share measured.

    The selectors are left out: what they choose is in the table already.

    Returns
    -------
    Table or None
        None where no group has a capture with this truth.
    """
    methods = methods_against(records, truth)
    own = f"M6 {truth}" if f"M6 {truth}" in methods else "M6"
    methods = [
        m
        for m in methods
        if m != "reported" and not m.startswith("selector") and not (m == "M6" != own)
    ]
    columns = [Column(factor.head), Column("captures"), Column("fruit")]
    columns += [Column(f"{method} MAPE (%)") for method in methods]
    if own in methods:
        columns += [Column(f"{own} median (%)"), Column(f"{own} worst (%)", 1)]
        columns += [Column(f"{own} measured (%)", 1)]
    rows: list[tuple[Cell, ...]] = []
    for band in factor.bands:
        inside = [
            r for r in records if (true := truth_m(r, truth)) is not None and band.holds(r, true)
        ]
        if not inside:
            continue
        row: list[Cell] = [band.label, len(inside), len({r.fruit for r in inside})]
        percent = {m: readings(inside, m, truth).errors_percent for m in methods}
        row += [float(percent[m].mean()) if percent[m].size else None for m in methods]
        if own in methods:
            row += _spread(inside, own, truth)
        rows.append(tuple(row))
    if not rows:
        return None
    heading = title or f"By {factor.head}, against the {truth}"
    return Table(heading, tuple(columns), tuple(rows), factor.comment)


def _spread(records: Sequence[Record], method: str, truth: Truth) -> list[Cell]:
    read = readings(records, method, truth)
    if not read.fruit:
        return [None, None, None]
    percent = read.errors_percent
    measured = 100 * float(np.isfinite(read.lengths_m).mean())
    return [float(np.median(percent)), float(percent.max()), measured]


def coverage_rows(
    records: Sequence[Record],
    level: float = 0.9,
    truth: Truth = Truth.CENTRELINE,
    factors: Sequence[Factor] | None = None,
) -> list[CoverageRow]:
    """Count by group how often M6's interval holds the truth.

    Parameters
    ----------
    records : sequence of Record
        Those count that have 'interval_low_m' and 'interval_high_m' (of the centreline) or
        'thread_interval_…', 'chord_interval_…' in their details.
    level : float
        What the interval claims.
    truth : Truth
        Which length.
    factors : sequence of Factor, optional
        What to group by; all that tell the records apart if not given.
    """
    name = f"{INTERVAL[truth]}_low_m"
    known = [
        r for r in records if r.details.get(name) is not None and truth_m(r, truth) is not None
    ]
    if not known:
        return []
    everything = Factor("all", (Band("all", lambda _record, _true: True),))
    chosen = factors_of(known) if factors is None else factors
    rows = []
    for factor in (everything, *chosen):
        for band in factor.bands:
            inside = [r for r in known if _in(band, r)]
            if inside:
                rows.append(_covered(factor.head, band.label, inside, level, truth))
    return rows


def _covered(
    factor: str, group: str, records: Sequence[Record], level: float, truth: Truth
) -> CoverageRow:
    low = np.array([r.details[f"{INTERVAL[truth]}_low_m"] for r in records], float)
    high = np.array([r.details[f"{INTERVAL[truth]}_high_m"] for r in records], float)
    true = np.array([truth_m(r, truth) for r in records], float)
    hits, count = int(((low <= true) & (true <= high)).sum()), len(records)
    bounds = binomial_interval(hits, count)
    fruit_count = len({r.fruit for r in records})
    if fruit_count >= LARGE_GROUP:
        allowed = [level - 0.9 + share for share in LARGE_GROUP_SHARE]
        as_stated = allowed[0] <= hits / count <= allowed[1]
    else:
        as_stated = bounds[0] <= level <= bounds[1]
    width = float((200 * (high - low) / (high + low)).mean())
    return CoverageRow(factor, group, count, fruit_count, hits, *bounds, width, as_stated)


def coverage_table(rows: Sequence[CoverageRow], level: float = 0.9, title: str = "") -> Table:
    """Set the coverage out by group."""
    columns = (
        Column("by"),
        Column("group"),
        Column("captures"),
        Column("fruit"),
        Column("holds the truth (%)", 1),
        Column("95 % of that, low (%)", 1),
        Column("95 % of that, high (%)", 1),
        Column("mean width (% of length)", 1),
        Column("as stated"),
    )
    cells = tuple(
        (
            row.factor,
            row.group,
            row.count,
            row.fruit_count,
            100 * row.hits / row.count,
            100 * row.low,
            100 * row.high,
            row.width_percent,
            row.as_stated,
        )
        for row in rows
    )
    comment = (
        f"An interval that states {100 * level:.0f} % should hold the true length that often, in "
        "every group and not only over all. 'As stated': within three points in groups of 400 "
        "fruit and more; in smaller ones the binomial 95 % interval (Clopper and Pearson) "
        "contains the level. It takes captures for independent; those of one fruit are not. Fruit "
        "that M6 did not measure have no interval and are not counted here."
    )
    return Table(title or "How often the interval holds the truth", columns, cells, comment)


def _in(band: Band, record: Record) -> bool:
    true = next((t for kind in Truth if (t := truth_m(record, kind)) is not None), np.nan)
    return band.holds(record, true)


def _with_condition(name: str) -> Band:
    return Band(name, lambda record, _true: record.condition == name)


def _with_basis(name: str) -> Band:
    return Band(name, lambda record, _true: str(record.details.get("interval_basis")) == name)


def _banded(
    value: Callable[[Record, float], float], bounds: Sequence[tuple[str, float, float]]
) -> tuple[Band, ...]:
    """Make bands from label, lower (inside) and upper bound (outside)."""

    def band(label: str, low: float, high: float) -> Band:
        return Band(label, lambda record, true: low <= value(record, true) < high)

    return tuple(band(*one) for one in bounds)


_TINY = 1e-9
_STRAIGHT_CM = 1e6
_HIDDEN = (
    ("0", -_TINY, _TINY),
    ("above 0 to 20", _TINY, 20.0),
    ("20 to 40", 20.0, 40.0),
    ("40 to 60", 40.0, 60 + _TINY),
    ("above 60", 60 + _TINY, np.inf),
)
_LOWER = "The lower bound belongs to the group, the upper to the next."


def _bend_cm(record: Record, _true: float) -> float:
    return _STRAIGHT_CM if record.bend_radius_m is None else 100 * record.bend_radius_m


def _hidden_ends_seen(record: Record, _true: float) -> float:
    return 100 * record.hidden_share if record.details.get("ends_seen") else np.nan


_FIXED = (
    Factor(
        "true length (cm)",
        _banded(
            lambda _record, true: 100 * true,
            (
                ("small: below 10", 0, 10),
                ("medium: 10 to 18", 10, 18),
                ("large: 18 and more", 18, np.inf),
            ),
        ),
        _LOWER,
    ),
    Factor(
        "tilt (°)",
        _banded(
            lambda record, _true: abs(record.tilt_deg),
            (
                ("0 to 15", 0, 15),
                ("15 to 30", 15, 30),
                ("30 to 45", 30, 45),
                ("45 to 60", 45, 60 + _TINY),
                ("above 60", 60 + _TINY, np.inf),
                ("30 to 60, together", 30, 60 + _TINY),
            ),
        ),
        f"Angle of the fruit's chord out of the picture plane. {_LOWER}",
    ),
    Factor(
        "distance (cm)",
        _banded(
            lambda record, _true: 100 * record.distance_m,
            (
                ("below 50", 0, 50),
                ("50 to 70", 50, 70),
                ("70 to 90", 70, 90),
                ("90 and more", 90, np.inf),
            ),
        ),
        f"From the camera to the fruit's middle. {_LOWER}",
    ),
    Factor(
        "radius of the bend (cm)",
        _banded(
            _bend_cm,
            (
                ("straight", _STRAIGHT_CM, np.inf),
                ("30 and more", 30, _STRAIGHT_CM),
                ("15 to 30", 15, 30),
                ("below 15", 0, 15),
            ),
        ),
        f"The smaller, the more bent. {_LOWER}",
    ),
    Factor(
        "hidden share of the fruit (%)",
        _banded(lambda record, _true: 100 * record.hidden_share, _HIDDEN),
        _LOWER,
    ),
    Factor(
        "hidden share (%), both ends in sight",
        _banded(_hidden_ends_seen, _HIDDEN),
        f"Only fruit whose two ends nothing hides. {_LOWER}",
    ),
)
