"""Error metrics of lengths with confidence intervals."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cucumbervision.arrays import Array
from cucumbervision.files import json_value

_FEWEST_GROUPS = 2


@dataclass(frozen=True, kw_only=True)
class Metrics:
    """Errors of one method over a set of captures.

    Parameters
    ----------
    count : int
        Number of captures, including unmeasured ones.
    measured : float
        Share of measured captures, 0 to 1.
    mae_cm, rmse_cm : float
        Mean absolute and root mean square error; an unmeasured fruit counts as a length of 0.
    mape_percent, median_percent, worst_percent : float
        Mean, median and largest absolute relative error; an unmeasured fruit counts as 100 %.
    bias_percent : float
        Mean signed relative error of the measured ones; NaN if there are none.
    r2 : float
        Coefficient of determination; NaN if all true lengths are the same.
    pearson_r : float
        Correlation with the truth over the measured ones; NaN below three.
    """

    count: int
    measured: float
    mae_cm: float
    mape_percent: float
    rmse_cm: float
    r2: float
    pearson_r: float
    median_percent: float
    worst_percent: float
    bias_percent: float


def percent_errors(lengths_m: ArrayLike, truth_m: ArrayLike) -> Array:
    """Compute absolute relative errors in percent; 100 for a length of NaN.

    Parameters
    ----------
    lengths_m, truth_m : array_like of float, shape (N,)
        Measured (NaN where not measured) and true lengths in metres.

    Examples
    --------
    >>> percent_errors([0.22, np.nan], [0.20, 0.20]).round(6).tolist()
    [10.0, 100.0]
    """
    lengths, truth = np.asarray(lengths_m, float), np.asarray(truth_m, float)
    return np.asarray(100 * np.abs(np.nan_to_num(lengths) - truth) / truth)


def score(lengths_m: ArrayLike, truth_m: ArrayLike) -> Metrics:
    """Compute the paper's metrics (Eqs. 7 to 10); a missing length counts as an error of 100 %.

    Parameters
    ----------
    lengths_m, truth_m : array_like of float, shape (N,)
        Measured (NaN where not measured) and true lengths in metres, N >= 1.

    Raises
    ------
    ValueError
        If there are no lengths, or a true length is not positive.

    Examples
    --------
    >>> m = score([0.11, 0.19], [0.10, 0.20])
    >>> round(m.mae_cm, 6), round(m.mape_percent, 6), round(m.r2, 6)
    (1.0, 7.5, 0.96)
    """
    lengths, truth = np.asarray(lengths_m, float), np.asarray(truth_m, float)
    if not truth.size or not (truth > 0).all():
        raise ValueError("true lengths must be positive, and at least one")
    is_measured = np.isfinite(lengths)
    error_cm, percent = 100 * (np.nan_to_num(lengths) - truth), percent_errors(lengths, truth)
    read, of = lengths[is_measured], truth[is_measured]
    spread = float(((truth - truth.mean()) ** 2).sum())
    is_spread = len(of) >= 3 and np.ptp(of) > 0 and np.ptp(read) > 0
    return Metrics(
        count=len(truth),
        measured=float(is_measured.mean()),
        mae_cm=float(np.abs(error_cm).mean()),
        mape_percent=float(percent.mean()),
        rmse_cm=float(np.sqrt((error_cm**2).mean())),
        r2=1 - float((error_cm**2).sum()) / (1e4 * spread) if spread > 0 else np.nan,
        pearson_r=float(np.corrcoef(read, of)[0, 1]) if is_spread else np.nan,
        median_percent=float(np.median(percent)),
        worst_percent=float(percent.max()),
        bias_percent=float((100 * (read / of - 1)).mean()) if len(of) else np.nan,
    )


@dataclass(frozen=True)
class Estimate:
    """An estimate with its interval and sample size.

    Parameters
    ----------
    value : float
        The estimate; NaN without values.
    low, high : float
        Bootstrap interval, resampled by group; NaN with less than two groups.
    count : int
        Number of values.
    groups : int
        Number of groups (fruit, scenes).
    """

    value: float
    low: float
    high: float
    count: int
    groups: int


def estimate(
    values: ArrayLike,
    groups: Sequence[Hashable] | None = None,
    quantile: float | None = None,
    resamples: int = 2000,
) -> Estimate:
    """Compute a mean, or a quantile, with its 95 % percentile bootstrap interval.

    Parameters
    ----------
    values : array_like of float, shape (N,)
        One value per capture, fruit or detection.
    groups : sequence of hashable, optional
        Fruit or scene of each value. Groups are resampled as a whole, because values of one group
        are not independent. By default, each value is a group.
    quantile : float, optional
        Quantile to compute, 0 to 1, instead of the mean.
    resamples : int
        Number of resamples.

    Examples
    --------
    >>> error = estimate([1.0, 1.0, 9.0, 9.0], ["a", "a", "b", "b"])
    >>> error.value, error.low, error.high, error.count, error.groups
    (5.0, 1.0, 9.0, 4, 2)
    >>> estimate([3.0, 1.0, 2.0], ["a", "a", "a"], quantile=0.5)
    Estimate(value=2.0, low=nan, high=nan, count=3, groups=1)
    """
    data = np.asarray(values, float)
    if not data.size:
        return Estimate(np.nan, np.nan, np.nan, 0, 0)
    names = range(len(data)) if groups is None else groups
    index = {name: k for k, name in enumerate(dict.fromkeys(names))}
    member = np.array([index[name] for name in names])
    value = float(data.mean() if quantile is None else np.quantile(data, quantile))
    if len(index) < _FEWEST_GROUPS:
        return Estimate(value, np.nan, np.nan, len(data), len(index))
    weights = resample_weights(len(index), resamples)
    if quantile is None:
        sums = weights @ np.bincount(member, data, len(index))
        drawn = sums / (weights @ np.bincount(member, minlength=len(index)))
    else:
        counts = (w[member].astype(np.intp) for w in weights)
        drawn = np.array([np.quantile(np.repeat(data, count), quantile) for count in counts])
    low, high = np.percentile(drawn, [2.5, 97.5]).tolist()
    return Estimate(value, low, high, len(data), len(index))


def share(hits: ArrayLike, groups: Sequence[Hashable]) -> Estimate:
    """Compute a share with its interval, resampled by group.

    If all or no values are hits, resampling has no variance; the interval is then the exact
    binomial one with the number of groups as trials.

    Examples
    --------
    >>> hit_rate = share([True] * 6, ["a", "b", "c", "d", "e", "e"])
    >>> hit_rate.value, round(hit_rate.low, 3), hit_rate.high
    (1.0, 0.478, 1.0)
    """
    hit_rate = estimate(np.asarray(hits, float), groups)
    if hit_rate.groups < _FEWEST_GROUPS or hit_rate.value not in (0.0, 1.0):
        return hit_rate
    low, high = binomial_interval(int(hit_rate.value) * hit_rate.groups, hit_rate.groups)
    return replace(hit_rate, low=low, high=high)


def resample_weights(groups: int, resamples: int) -> Array:
    """Return the multiplicity of each group in each resample, shape (resamples, groups)."""
    drawn = np.random.default_rng(0).integers(groups, size=(resamples, groups))
    drawn += groups * np.arange(resamples)[:, None]
    counts = np.bincount(drawn.ravel(), minlength=resamples * groups)
    return np.asarray(counts.reshape(resamples, groups), float)


def binomial_interval(hits: int, count: int) -> tuple[float, float]:
    """Compute the exact (Clopper–Pearson) 95 % interval of a share.

    Examples
    --------
    >>> lower, upper = binomial_interval(90, 100)
    >>> round(lower, 3), round(upper, 3)
    (0.824, 0.951)
    """
    from scipy.stats import binomtest

    interval = binomtest(hits, count).proportion_ci(0.95, method="exact")
    return float(interval.low), float(interval.high)


Cell = str | int | float | bool | None


def cell_text(cell: Cell, form: str = ".2") -> str:
    """Format a cell as text; an en dash for a missing number.

    Parameters
    ----------
    cell : str, int, float, bool or None
        The cell.
    form : str
        Number of decimals of floats, after a plus sign where the sign is always shown.

    Examples
    --------
    >>> cell_text(1.26, "+.1"), cell_text(float("nan")), cell_text(True), cell_text(7)
    ('+1.3', '–', 'yes', '7')
    """
    if cell is None or (isinstance(cell, float) and not math.isfinite(cell)):
        return "–"
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    return f"{cell:{form}f}".replace("-", "−") if isinstance(cell, float) else str(cell)


@dataclass(frozen=True)
class ReportTable:
    """A table of a report.

    Parameters
    ----------
    title : str
        Title.
    columns : tuple of str
        Headings with unit, with a number format behind a colon: 'bias (%):+.1' (`cell_text`).
    rows : tuple of tuple
        Rows, each with a cell for every column.
    comment : str
        Explanation of the table.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    comment: str = ""

    @classmethod
    def of(
        cls, title: str, columns: Iterable[str], rows: Iterable[Sequence[Any]], comment: str = ""
    ) -> ReportTable:
        """Create a table whose cells may be numbers of NumPy.

        Examples
        --------
        >>> table = ReportTable.of("Burst", ["frames", "MAPE (%):.1"], [[1, 0.9], [5, 0.75]])
        >>> table.text_rows()
        [['1', '0.9'], ['5', '0.8']]
        """
        cells = tuple(tuple(x.item() if hasattr(x, "item") else x for x in row) for row in rows)
        return cls(title, tuple(columns), cells, comment)

    @classmethod
    def of_records(
        cls,
        title: str,
        columns: Mapping[str, str],
        records: Iterable[Mapping[str, Any]],
        comment: str = "",
    ) -> ReportTable:
        """Create a table from records; `columns` maps names to columns.

        Examples
        --------
        >>> rows = [{"method": "M1", "bias": 1.25, "count": 3}]
        >>> columns = {"method": "method", "bias": "bias (%):+.1"}
        >>> ReportTable.of_records("a", columns, rows).text_rows()
        [['M1', '+1.2']]
        """
        rows = ([record[name] for name in columns] for record in records)
        return cls.of(title, columns.values(), rows, comment)

    @property
    def heads(self) -> list[str]:
        """The columns' headings."""
        return [column.partition(":")[0] for column in self.columns]

    @property
    def numeric(self) -> list[bool]:
        """Whether each column contains only numbers and missing values, which are right-aligned."""
        numbers = int | float | None
        return [
            all(isinstance(row[k], numbers) for row in self.rows) for k in range(len(self.columns))
        ]

    def text_rows(self) -> list[list[str]]:
        """Return every cell as text."""
        forms = [column.partition(":")[2] or ".2" for column in self.columns]
        return [[*map(cell_text, row, forms)] for row in self.rows]

    def as_json(self) -> dict[str, Any]:
        """Return the table with unrounded numbers; NaN becomes null.

        Examples
        --------
        >>> ReportTable.of("a", ["b"], [[float("nan")]]).as_json()["rows"]
        [{'b': None}]
        """
        rows = [dict(zip(self.heads, json_value(row), strict=True)) for row in self.rows]
        return {"title": self.title, "comment": self.comment, "rows": rows}
