"""How far the lengths of a run agree with hand-measured ones, as reviewers of a method ask."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from cucumbervision.accuracy.own_truth import REPORTED, Measured, OwnTruth, Reading, comparable
from cucumbervision.accuracy.statistics import ReportTable
from cucumbervision.accuracy.truth import TrueLength
from cucumbervision.methods.result import LengthDefinition

_LEAST_PAIRS = 3
_WANTED_CM = 0.1  # to which the mean difference is to be known
_COLUMNS = {
    "kind": "truth",
    "method": "method",
    "pairs": "pairs",
    "fruit": "fruit",
    "bias_cm": "bias cm:+.2",
    "low_cm": "limits of agreement, from:+.2",
    "high_cm": "to:+.2",
    "limit_margin_cm": "each ±",
    "rmse_cm": "RMSE cm",
    "ccc": "CCC:.3",
    "icc": "ICC(2,1):.3",
    "repeat_sd_cm": "repeatability sd cm",
    "repeat_limit_cm": "two captures differ by, cm",
    "fruit_needed": "fruit for bias ±1 mm",
}
_COMMENT = (
    "Of measured fruit. Bland and Altman's 95 % limits of measured minus true length, each with "
    "half the width of its 95 % interval; Lin's concordance; ICC(2,1) of camera and hand; "
    "repeatability over captures of one specimen, and what two of them differ by in 95 % of cases."
)


def agreement(
    lengths_m: ArrayLike, truth_m: ArrayLike, specimens: Sequence[str]
) -> dict[str, float]:
    """Return the statistics of agreement of measured with true lengths.

    Parameters
    ----------
    lengths_m, truth_m : array_like of float, shape (N,)
        Measured and true lengths in metres, at least three.
    specimens : sequence of str, length N
        The physical fruit of each.

    Returns
    -------
    dict of str to float
        As the columns of `agreement.csv`; NaN for repeatability without repeated captures.

    Examples
    --------
    >>> numbers = agreement([0.11, 0.19, 0.31], [0.10, 0.20, 0.30], ["a", "b", "c"])
    >>> round(numbers["bias_cm"], 3), round(numbers["rmse_cm"], 3)
    (0.333, 1.0)
    """
    x, y = 100 * np.asarray(lengths_m, float), 100 * np.asarray(truth_m, float)
    off, count = x - y, len(x)
    bias, sd = float(off.mean()), float(off.std(ddof=1))
    # Two-way analysis of variance: fruit, and camera against hand.
    raters = np.stack([x, y])
    grand = raters.mean()
    fruit_ms = 2 * ((raters.mean(axis=0) - grand) ** 2).sum() / (count - 1)
    rater_ms = count * ((raters.mean(axis=1) - grand) ** 2).sum()
    error_ms = (((raters - grand) ** 2).sum() - fruit_ms * (count - 1) - rater_ms) / (count - 1)
    names = np.unique(specimens, return_inverse=True)[1]
    repeats = np.bincount(names)
    within = ((x - (np.bincount(names, x) / repeats)[names]) ** 2).sum()
    spare = count - len(repeats)
    repeat_sd = math.sqrt(within / spare) if spare else math.nan
    z = float(stats.norm.ppf(0.975))
    return {
        "pairs": count,
        "fruit": len(repeats),
        "bias_cm": bias,
        "low_cm": bias - z * sd,
        "high_cm": bias + z * sd,
        "limit_margin_cm": float(stats.t.ppf(0.975, count - 1)) * sd * math.sqrt(3 / count),
        "rmse_cm": float(np.sqrt((off**2).mean())),
        "ccc": float(2 * np.cov(x, y, ddof=0)[0, 1] / (x.var() + y.var() + bias**2)),
        "icc": float(
            (fruit_ms - error_ms) / (fruit_ms + error_ms + 2 * (rater_ms - error_ms) / count)
        ),
        "repeat_sd_cm": repeat_sd,
        "repeat_limit_cm": z * math.sqrt(2) * repeat_sd,
        "fruit_needed": math.ceil((z * sd / _WANTED_CM) ** 2),
    }


def _pairs(
    evaluation: OwnTruth, kind: LengthDefinition, method: str
) -> Iterator[tuple[TrueLength, Reading, float]]:
    """Yield the hand lengths of one kind, with their reading and its length by one method."""
    for truth, reading in evaluation.pairs:
        length_m = reading.lengths_m.get(method)
        if truth.kind is kind and length_m and comparable(method, kind, reading.kind):
            yield truth, reading, length_m


def agreement_rows(evaluation: OwnTruth) -> list[dict[str, Any]]:
    """Return the rows of `agreement.csv`: a kind of length and a method each."""
    rows = []
    methods = dict.fromkeys(key for _, reading in evaluation.pairs for key in reading.lengths_m)
    for kind, method in product(LengthDefinition, methods):
        pairs = list(_pairs(evaluation, kind, method))
        if len(pairs) >= _LEAST_PAIRS:
            lengths, truths = zip(*((x, truth.length_m) for truth, _, x in pairs), strict=True)
            numbers = agreement(lengths, truths, [truth.specimen for truth, _, _ in pairs])
            rows.append({"kind": str(kind), "method": method, **numbers})
    return rows


def agreement_table(evaluation: OwnTruth) -> ReportTable:
    """Return the table of agreement by method."""
    rows = agreement_rows(evaluation)
    return ReportTable.of_records("Agreement with hand-measured lengths", _COLUMNS, rows, _COMMENT)


def hidden_table(measured: Measured, evaluation: OwnTruth) -> ReportTable:
    """Return error and coverage of the reported length by its hidden share, in tenths."""
    written = {
        (capture["name"], fruit["fruit"]): fruit
        for capture in measured.report.get("captures", ())
        for fruit in capture["fruit"]
    }
    parts: dict[tuple[str, int], list[tuple[float, float]]] = {}
    for kind in LengthDefinition:
        for truth, reading, length_m in _pairs(evaluation, kind, REPORTED):
            fruit = written.get((reading.capture, reading.fruit), {})
            if fruit.get("hidden_share") is not None:
                low_cm, high_cm = (fruit.get(f"interval_{end}_cm") for end in ("low", "high"))
                has_interval = low_cm is not None and fruit.get("interval_of") == kind
                holds = low_cm <= 100 * truth.length_m <= high_cm if has_interval else math.nan
                tenth = min(int(10 * fruit["hidden_share"]), 9)
                percent = 100 * (length_m / truth.length_m - 1)
                parts.setdefault((str(kind), tenth), []).append((percent, holds))
    rows = []
    for (kind_name, tenth), values in sorted(parts.items()):
        errors, holds = np.transpose(values)
        held: NDArray[np.float64] = holds[~np.isnan(holds)]
        share = f"{10 * tenth} to {10 * tenth + 10}"
        coverage = 100 * held.mean() if held.size else math.nan
        figures = np.abs(errors).mean(), errors.mean(), held.size, coverage
        rows.append((kind_name, share, len(errors), *figures))
    heads = ["truth", "hidden %", "fruit", "mean error %:.1", "bias %:+.1"]
    heads += ["with interval", "intervals that hold %:.0"]
    return ReportTable.of("The reported length by hidden share", heads, rows)


def plot_agreement(evaluation: OwnTruth, out: Path) -> list[Path]:
    """Draw Bland-Altman plots of the reported length, a PNG for each kind of hand length.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    files = []
    for row in agreement_rows(evaluation):
        if row["method"] == REPORTED:
            pairs = list(_pairs(evaluation, LengthDefinition(row["kind"]), REPORTED))
            x, y = 100 * np.array([(length_m, truth.length_m) for truth, _, length_m in pairs]).T
            figure = Figure(figsize=(6, 4), layout="constrained")
            axes = figure.add_subplot()
            axes.scatter((x + y) / 2, x - y, s=14)
            for name in ("bias_cm", "low_cm", "high_cm"):
                axes.axhline(row[name], linestyle="-" if name == "bias_cm" else "--", linewidth=1)
            axes.set(xlabel="mean of camera and hand, cm", ylabel="camera minus hand, cm")
            files.append(out / f"bland-altman-{row['kind']}.png")
            figure.savefig(files[-1], dpi=150)
    return files
