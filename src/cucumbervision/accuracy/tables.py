"""From records to tables: accuracy, who errs less, and fruit one by one."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.accuracy.statistics import Metrics, bootstrap_mean, compare, score
from cucumbervision.accuracy.table import Cell, Column, Table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cucumbervision.accuracy.records import Record

__all__ = [
    "DESCRIPTIONS",
    "PAPER_METHODS",
    "MethodRow",
    "Readings",
    "Truth",
    "accuracy_table",
    "comparison_table",
    "is_scored",
    "length_and_error",
    "method_rows",
    "methods_against",
    "readings",
    "span_text",
    "truth_m",
    "validation_table",
]


class Truth(StrEnum):
    """Which true length the methods are held against."""

    CENTRELINE = "centreline"
    THREAD = "thread"
    CHORD = "chord"


# In the order of every table.
DESCRIPTIONS = {
    "M1": "scan line",
    "M2": "box PCA",
    "M3": "mask PCA",
    "M4": "keypoints",
    "M5": "medial arc spline",
    "M6": "swept tube, centreline",
    "M6 thread": "swept tube, thread",
    "M6 chord": "swept tube, chord",
    "skan": "longest skeleton path",
    "PlantCV": "longest skeleton segment",
    "rectangle": "smallest rectangle",
    "selector best": "what this program reports",
    "selector paper": "what the paper's selector reports",
    "reported": "what the run reported",
    "oracle": "the true tube, ends by the outline",
}
PAPER_METHODS = ("M1", "M2", "M3", "M4", "M5")
_COUNT_OF_RESAMPLES = 10_000
_RESAMPLED_VALUES = 5_000_000  # bounds the memory of a bootstrap over thousands of captures


@dataclass(frozen=True, eq=False)
class Readings:
    """What one method read on the captures that it was given.

    Parameters
    ----------
    lengths_m, truth_m : ndarray of float64, shape (N,)
        Read (NaN where it refused) and true lengths, metres.
    fruit : tuple of str
        The fruit of each capture.
    """

    lengths_m: NDArray[np.float64]
    truth_m: NDArray[np.float64]
    fruit: tuple[str, ...]

    @property
    def errors_cm(self) -> NDArray[np.float64]:
        """Absolute errors in cm, refused ones as a length of 0."""
        return np.asarray(100 * np.abs(np.nan_to_num(self.lengths_m) - self.truth_m))

    @property
    def errors_percent(self) -> NDArray[np.float64]:
        """Absolute relative errors, refused ones as 100 %."""
        return np.asarray(self.errors_cm / self.truth_m)


@dataclass(frozen=True)
class MethodRow:
    """One method's accuracy over a set of captures.

    Parameters
    ----------
    method : str
        Its name in `Record.lengths_m`.
    fruit_count : int
        How many fruit the captures are of.
    metrics : Metrics
        Its errors.
    by_capture, by_fruit : (float, float)
        Bootstrap 95 % interval of the MAPE, percent, captures or whole fruit resampled.
    """

    method: str
    fruit_count: int
    metrics: Metrics
    by_capture: tuple[float, float]
    by_fruit: tuple[float, float]


def truth_m(record: Record, truth: Truth) -> float | None:
    """Give a record's true length of one kind, metres."""
    lengths = {
        Truth.CENTRELINE: record.centreline_m,
        Truth.THREAD: record.thread_m,
        Truth.CHORD: record.chord_m,
    }
    return lengths[truth]


def is_scored(record: Record, method: str, truth: Truth) -> bool:
    """Say whether a method was run on a record and may be held against this kind of truth.

    M1 to M5 and other people's tools are held against every kind: they do not say which they
    measure. M6's own kinds and the oracle's are held against their own; M6's centreline also
    against the thread, since that is what the paper would do.
    """
    if method not in record.lengths_m or truth_m(record, truth) is None:
        return False
    if method == "reported":  # its kind changes from fruit to fruit
        reported = record.details.get("reported_kind")
        return reported == truth or reported not in set(Truth)
    for kind in (Truth.THREAD, Truth.CHORD):
        if method.endswith(f" {kind}"):
            return truth is kind
    if method == "oracle":
        return truth is Truth.CENTRELINE
    return not (method in ("M6", "selector best") and truth is Truth.CHORD)


def methods_against(records: Sequence[Record], truth: Truth) -> list[str]:
    """Give the methods to hold against a kind of truth (`is_scored`), in the tables' order.

    Examples
    --------
    >>> from cucumbervision.accuracy.records import Masks, Record, Suite
    >>> read = {"M6": 0.2, "M1": 0.1, "M6 thread": 0.2, "oracle": 0.2}
    >>> where = dict(distance_m=0.5, tilt_deg=0.0, bend_radius_m=None, hidden_share=0.0, fill=1.0)
    >>> one = Record("a", Suite.PAPER, Masks.EXACT, "f", 0.2, 0.22, None, lengths_m=read, **where)
    >>> methods_against([one], Truth.THREAD)
    ['M1', 'M6', 'M6 thread']
    >>> methods_against([one], Truth.CHORD)
    []
    """
    found = {name for r in records for name in r.lengths_m if is_scored(r, name, truth)}
    order = {name: k for k, name in enumerate(DESCRIPTIONS)}
    return sorted(found, key=lambda name: (order.get(name, len(order) - 1.5), name))


def readings(records: Sequence[Record], method: str, truth: Truth) -> Readings:
    """Gather what a method read where it was run and the truth is known."""
    rows = [
        (record.lengths_m[method], true, record.fruit)
        for record in records
        if is_scored(record, method, truth) and (true := truth_m(record, truth)) is not None
    ]
    lengths = np.array([np.nan if length is None else length for length, _, _ in rows], float)
    return Readings(lengths, np.array([true for _, true, _ in rows]), tuple(r[2] for r in rows))


def method_rows(records: Sequence[Record], truth: Truth) -> list[MethodRow]:
    """Score every method on the captures that it was run on.

    Parameters
    ----------
    records : sequence of Record
        Of one suite and one kind of masks.
    truth : Truth
        What to hold them against.
    """
    rows = []
    for method in methods_against(records, truth):
        read = readings(records, method, truth)
        percent = read.errors_percent
        resamples = int(np.clip(_RESAMPLED_VALUES / len(percent), 1000, _COUNT_OF_RESAMPLES))
        rows.append(
            MethodRow(
                method,
                len(set(read.fruit)),
                score(read.lengths_m, read.truth_m),
                bootstrap_mean(percent, resamples=resamples),
                bootstrap_mean(percent, read.fruit, resamples=resamples),
            )
        )
    return rows


_ACCURACY = (
    Column("method"),
    Column("captures"),
    Column("fruit"),
    Column("measured (%)", 1),
    Column("MAE (cm)"),
    Column("RMSE (cm)"),
    Column("MAPE (%)"),
    Column("95 % by capture (%)"),
    Column("95 % by fruit (%)"),
    Column("median error (%)"),
    Column("worst error (%)", 1),
    Column("R²", 3),
    Column("Pearson r", 4),
    Column("bias (%)", 2, signed=True),
    Column("what it is"),
)
_LOWEST_IS_BEST = {
    4: "mae_cm",
    5: "rmse_cm",
    6: "mape_percent",
    9: "median_percent",
    10: "worst_percent",
}


def accuracy_table(rows: Sequence[MethodRow], truth: Truth, title: str = "") -> Table:
    """Set methods' accuracy out as the main table; the best of all but the oracle in bold."""
    cells = tuple(
        (
            row.method,
            row.metrics.count,
            row.fruit_count,
            100 * row.metrics.measured,
            row.metrics.mae_cm,
            row.metrics.rmse_cm,
            row.metrics.mape_percent,
            span_text(row.by_capture),
            span_text(row.by_fruit),
            row.metrics.median_percent,
            row.metrics.worst_percent,
            row.metrics.r2,
            row.metrics.pearson_r,
            row.metrics.bias_percent,
            DESCRIPTIONS.get(row.method, ""),
        )
        for row in rows
    )
    ranked = [k for k, row in enumerate(rows) if row.method != "oracle"]
    bold = frozenset(
        (min(ranked, key=lambda k: getattr(rows[k].metrics, name)), column)
        for column, name in _LOWEST_IS_BEST.items()
        if len(ranked) > 1
    )
    comment = (
        f"Errors against the true {truth}. A fruit that a method did not measure counts as 100 % "
        "error. Captures of one fruit resemble each other, so the interval by fruit is the "
        "honest one."
    )
    return Table(title or f"Accuracy against the {truth}", _ACCURACY, cells, comment, bold)


def comparison_table(records: Sequence[Record], truth: Truth, title: str = "") -> Table | None:
    """Test M5 against M1 to M4, as the paper does, and M6 against everybody but the oracle.

    Returns
    -------
    Table or None
        None where neither was run beside another on at least five captures.
    """
    methods = methods_against(records, truth)
    own = next((m for m in (f"M6 {truth}", "M6") if m in methods), None)
    ours = ("oracle", "reported")
    rivals = [m for m in methods if m not in ours and not m.startswith(("M6", "selector"))]
    rows = _tests(records, truth, "M5", [m for m in PAPER_METHODS[:4] if m in methods])
    rows += _tests(records, truth, own, rivals) if own else []
    if not rows:
        return None
    columns = (
        Column("method"),
        Column("against"),
        Column("captures"),
        Column("median difference (cm)", 3, signed=True),
        Column("p"),
        Column("level (0.05 / tests)", 4),
        Column("differ"),
        Column("fruit"),
        Column("p by fruit"),
    )
    comment = (
        "Wilcoxon's signed-rank test of the absolute errors, two-sided, Bonferroni's correction. "
        "A negative difference means that the first errs less. The test takes captures for "
        "independent, which captures of one fruit are not; 'p by fruit' therefore tests each "
        "fruit's mean error (with seven fruit it cannot fall below 0.016)."
    )
    return Table(title or f"Who errs less, against the {truth}", columns, tuple(rows), comment)


def _tests(
    records: Sequence[Record], truth: Truth, first: str, others: Sequence[str]
) -> list[tuple[Cell, ...]]:
    rows: list[tuple[Cell, ...]] = []
    for second in others:
        both = [r for r in records if {first, second} <= r.lengths_m.keys()]
        a, b = readings(both, first, truth), readings(both, second, truth)
        if len(a.fruit) < 5:
            continue
        result = compare(a.errors_cm, b.errors_cm, len(others))
        fruit = compare(_fruit_means(a), _fruit_means(b), len(others))
        rows.append(
            (
                first,
                second,
                len(a.fruit),
                result.median_difference,
                _p_text(result.p_value),
                result.alpha,
                result.significant,
                len(set(a.fruit)),
                _p_text(fruit.p_value),
            )
        )
    return rows


def _fruit_means(read: Readings) -> list[float]:
    fruit, errors = np.array(read.fruit), read.errors_cm
    return [float(errors[fruit == name].mean()) for name in dict.fromkeys(read.fruit)]


def validation_table(records: Sequence[Record], truth: Truth, title: str = "") -> Table:
    """Set each capture out as the paper's validation table: length and signed error a method."""
    methods = [
        m
        for m in methods_against(records, truth)
        if m not in ("oracle", "reported") and not m.startswith("selector")
    ]
    columns = [Column("fruit"), Column(f"true {truth} (cm)")]
    columns += [Column(f"{method} (cm)") for method in methods]
    rows: list[tuple[Cell, ...]] = []
    known = [(r, true) for r in records if (true := truth_m(r, truth)) is not None]
    for record, true in known:
        cells = [length_and_error(record.lengths_m.get(method), true) for method in methods]
        name = record.fruit if record.fruit == record.case else f"{record.fruit} ({record.case})"
        rows.append((name, 100 * true, *cells))
    scores = [score(r.lengths_m, r.truth_m) for r in (readings(records, m, truth) for m in methods)]
    rows.append(("MAE (cm)", None, *[m.mae_cm for m in scores]))
    rows.append(("MAPE (%)", None, *[m.mape_percent for m in scores]))
    comment = "Length read and, in brackets, read less true, both in cm."
    heading = title or f"The validation fruit, one by one, against the {truth}"
    return Table(heading, tuple(columns), tuple(rows), comment)


def span_text(interval: tuple[float, float] | None) -> str | None:
    """Give an interval as text.

    Examples
    --------
    >>> span_text((1.0, 2.345))
    '1.00 to 2.35'
    """
    return None if interval is None else f"{interval[0]:.2f} to {interval[1]:.2f}"


def length_and_error(length_m: float | None, true_m: float) -> str:
    """Give a length and, in brackets, its signed error, in cm.

    Examples
    --------
    >>> length_and_error(0.2359, 0.2570)
    '23.59 (−2.11)'
    """
    if length_m is None:
        return "not measured"
    error = f"{100 * (length_m - true_m):+.2f}".replace("-", "−")
    return f"{100 * length_m:.2f} ({error})"


def _p_text(p_value: float) -> str:
    return "< 0.0001" if p_value < 1e-4 else f"{p_value:.4f}"
