"""The report's plots, as PNG bytes: matplotlib without a screen, colours for every eye."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.accuracy.tables import Truth, is_scored, methods_against, readings, truth_m
from cucumbervision.errors import MissingExtraError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from cucumbervision.accuracy.groups import CoverageRow
    from cucumbervision.accuracy.records import Record

__all__ = [
    "as_png",
    "coverage_by_group",
    "error_against_hidden",
    "error_against_tilt",
    "error_spread",
    "new_figure",
    "predicted_against_truth",
    "tracking",
]

DPI = 110
WIDTH_IN = 10.0
FEW_CAPTURES = 200  # drawn as larger dots
# Okabe and Ito's colours, told apart by colour-blind eyes too; each method also has its marker.
STYLES: dict[str, tuple[str, str, str]] = {
    "M1": ("#E69F00", "v", "-"),
    "M2": ("#56B4E9", "s", "-"),
    "M3": ("#009E73", "D", "-"),
    "M4": ("#CC79A7", "^", "-"),
    "M5": ("#0072B2", "o", "-"),
    "M6": ("#D55E00", "*", "-"),
    "skan": ("#777777", "x", ":"),
    "PlantCV": ("#777777", "+", "--"),
    "rectangle": ("#AAAAAA", "s", "-."),
    "oracle": ("#000000", ".", "--"),
}
_SMALLEST_CM, _SMALLEST_PERCENT = 0.001, 0.01  # what a logarithmic axis starts at


def predicted_against_truth(records: Sequence[Record], truth: Truth) -> bytes:
    """Plot each method's lengths against the truth, one small picture a method, with y = x.

    Parameters
    ----------
    records : sequence of Record
        Of one suite and one kind of masks.
    truth : Truth
        What to hold them against.

    Returns
    -------
    bytes
        A PNG. What a method did not measure stands on the bottom line.

    Raises
    ------
    MissingExtraError
        If matplotlib is not installed.
    """
    methods = _plotted(records, truth)
    columns = min(4, len(methods))
    lines = -(-len(methods) // columns)
    figure = new_figure(2.6 * lines + 0.5)
    axes = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
    reads = {method: readings(records, method, truth) for method in methods}
    top = 100 * max(max(r.truth_m.max(), np.nan_to_num(r.lengths_m).max()) for r in reads.values())
    for ax, method in zip(axes.flat, methods, strict=False):
        read, (colour, marker, _) = reads[method], _style(method)
        refused = ~np.isfinite(read.lengths_m)
        ax.plot([0, top], [0, top], color="black", linewidth=0.8)
        lengths_cm = 100 * np.nan_to_num(read.lengths_m)
        ax.scatter(100 * read.truth_m, lengths_cm, s=16, c=colour, marker=marker, alpha=0.7)
        title = f"{method}: {refused.sum()} not measured" if refused.any() else method
        ax.set_title(title, fontsize=10)
        ax.set_xlim(0, 1.03 * top)
        ax.set_ylim(-0.03 * top, 1.03 * top)
        ax.grid(alpha=0.3)
    for ax in axes.flat[len(methods) :]:
        ax.set_visible(False)
    figure.supxlabel(f"true {truth} (cm)")
    figure.supylabel("measured (cm)")
    return as_png(figure)


def tracking(records: Sequence[Record], truth: Truth) -> bytes:
    """Plot the truth and each method's length, capture by capture from short to long.

    Parameters
    ----------
    records, truth
        As for `predicted_against_truth`.
    """
    known = [r for r in records if truth_m(r, truth) is not None]
    known.sort(key=lambda r: (truth_m(r, truth) or 0.0, r.case))
    figure = new_figure(4.6)
    ax = figure.subplots()
    place = np.arange(1, len(known) + 1)
    true_cm = [100 * (truth_m(r, truth) or 0.0) for r in known]
    ax.step(place, true_cm, where="mid", color="black", linewidth=1.4, label=f"true {truth}")
    for method in _plotted(known, truth, own_tools_only=True):
        lengths = [r.lengths_m.get(method) for r in known]
        shown = [np.nan if length is None else 100 * length for length in lengths]
        colour, marker, _ = _style(method)
        size = 9 if marker == "*" else 5
        ax.plot(place, shown, marker, color=colour, markersize=size, alpha=0.8, label=method)
    ax.set_xlabel("capture, ordered by true length")
    ax.set_ylabel("length (cm)")
    ax.set_ylim(bottom=0)
    ax.grid(alpha=0.3)
    ax.legend(ncols=2, fontsize=9)
    return as_png(figure)


def error_spread(records: Sequence[Record], truth: Truth) -> bytes:
    """Plot each method's absolute errors as a box and every capture as a dot.

    Parameters
    ----------
    records, truth
        As for `predicted_against_truth`. What was not measured has its whole length as error.
    """
    methods = _plotted(records, truth)
    figure = new_figure(0.5 * len(methods) + 1.4)
    ax = figure.subplots()
    rng = np.random.default_rng(0)
    for k, method in enumerate(reversed(methods)):
        errors = np.maximum(readings(records, method, truth).errors_cm, _SMALLEST_CM)
        colour, _, _ = _style(method)
        jitter = k + rng.uniform(-0.25, 0.25, len(errors))
        size = 24 if len(errors) <= FEW_CAPTURES else 9
        ax.scatter(errors, jitter, s=size, c=colour, alpha=0.6, linewidths=0, zorder=3)
        ax.boxplot(
            [errors],
            positions=[k],
            orientation="horizontal",
            widths=0.6,
            showfliers=False,
            whis=(5, 95),
            manage_ticks=False,
            medianprops={"color": "black", "linewidth": 2, "zorder": 4},
        )
    ax.set_yticks(range(len(methods)), reversed(methods))
    ax.set_xscale("log")
    ticks = [0.001, 0.01, 0.1, 1.0, 10.0]
    ax.set_xticks(ticks, ["0.01 mm", "0.1 mm", "1 mm", "1 cm", "10 cm"])
    ax.set_xlabel(f"absolute error against the true {truth} (each mark is ten times the last)")
    ax.grid(alpha=0.3, axis="x")
    return as_png(figure)


def error_against_tilt(records: Sequence[Record], truth: Truth) -> bytes:
    """Plot each method's mean relative error by tilt.

    Parameters
    ----------
    records, truth
        As for `predicted_against_truth`.
    """
    return _error_against(
        records, truth, lambda r: abs(r.tilt_deg), np.arange(0, 61, 7.5), "tilt of the fruit (°)"
    )


def error_against_hidden(records: Sequence[Record], truth: Truth) -> bytes:
    """Plot each method's mean relative error by hidden share.

    Parameters
    ----------
    records, truth
        As for `predicted_against_truth`.
    """
    edges = np.array([0, 0.01, 10, 20, 30, 40, 50, 60])
    label = "hidden share of the fruit (%)"
    return _error_against(records, truth, lambda r: 100 * r.hidden_share, edges, label)


def coverage_by_group(rows: Sequence[CoverageRow], level: float = 0.9) -> bytes:
    """Plot how often the interval holds the truth, by group, with binomial 95 % bars.

    Parameters
    ----------
    rows : sequence of CoverageRow
        From `groups.coverage_rows`, at least one.
    level : float
        What the interval claims.
    """
    figure = new_figure(0.3 * len(rows) + 1.2)
    ax = figure.subplots()
    for k, row in enumerate(reversed(rows)):
        share, colour = row.hits / row.count, "#0072B2" if row.as_stated else "#D55E00"
        ax.plot([100 * row.low, 100 * row.high], [k, k], color=colour, linewidth=2)
        ax.plot(100 * share, k, "o" if row.as_stated else "D", color=colour)
    labels = [
        f"{row.group} (n = {row.count})"
        if row.factor == row.group
        else f"{row.factor}: {row.group} (n = {row.count})"
        for row in reversed(rows)
    ]
    ax.set_yticks(range(len(rows)), labels, fontsize=9)
    ax.axvline(100 * level, color="black", linewidth=1, linestyle="--")
    ax.set_xlim(min(100 * min(row.low for row in rows), 100 * level - 10) - 2, 101)
    ax.set_xlabel(f"intervals that hold the truth (%); {100 * level:.0f} % is stated")
    ax.grid(alpha=0.3, axis="x")
    return as_png(figure)


def _error_against(
    records: Sequence[Record],
    truth: Truth,
    value: Callable[[Record], float],
    edges: NDArray[Any],
    label: str,
) -> bytes:
    figure = new_figure(4.6)
    ax = figure.subplots()
    known = [r for r in records if truth_m(r, truth) is not None]
    for method in _plotted(known, truth):
        run = [r for r in known if is_scored(r, method, truth)]
        percent = readings(run, method, truth).errors_percent
        where = np.array([value(r) for r in run])
        # The last edge belongs to the last group.
        group = np.minimum(np.digitize(where, edges), len(edges) - 1)
        group[where > edges[-1]] = 0
        full = [k for k in range(1, len(edges)) if (group == k).any()]
        means = [max(percent[group == k].mean(), _SMALLEST_PERCENT) for k in full]
        middles = [where[group == k].mean() for k in full]
        colour, marker, line = _style(method)
        wide = 2.4 if method.startswith("M6") else 1.2
        ax.plot(
            middles,
            means,
            color=colour,
            marker=marker,
            linestyle=line,
            linewidth=wide,
            label=method,
        )
    ax.set_xlim(left=-1)
    ax.set_yscale("log")
    ax.set_yticks([0.1, 1, 10, 100], ["0.1", "1", "10", "100"])
    ax.set_xlabel(label)
    ax.set_ylabel(f"mean error against the {truth} (%)")
    ax.grid(alpha=0.3, which="both")
    ax.legend(fontsize=9, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return as_png(figure)


def _plotted(records: Sequence[Record], truth: Truth, *, own_tools_only: bool = False) -> list[str]:
    """Give the methods to draw: M6 only by its own kind, no selectors."""
    methods = methods_against(records, truth)
    aside = {"reported", *(m for m in methods if m.startswith("selector"))}
    if f"M6 {truth}" in methods:
        aside.add("M6")
    if own_tools_only:
        aside |= {"skan", "PlantCV", "rectangle", "oracle"}
    return [method for method in methods if method not in aside]


def _style(method: str) -> tuple[str, str, str]:
    return STYLES.get(method) or STYLES.get(method.split()[0]) or ("#777777", ".", "-")


def new_figure(height_in: float) -> Figure:
    """Start a figure of the report's width.

    Raises
    ------
    MissingExtraError
        If matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        raise MissingExtraError("matplotlib", "report") from None
    return Figure(figsize=(WIDTH_IN, height_in), dpi=DPI, layout="constrained")


def as_png(figure: Figure) -> bytes:
    """Draw a figure as PNG, the same bytes for the same figure."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()
