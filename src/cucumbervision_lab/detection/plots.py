"""The evaluation's plots, as PNG bytes."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.accuracy.plots import as_png, new_figure

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cucumbervision.accuracy.statistics import Estimate
    from cucumbervision_lab.detection.outcomes import EndRow, GroupScore
    from cucumbervision_lab.detection.overlaps import OverlapRow

__all__ = ["end_error_plot", "overlap_plot", "recall_plot"]

BLUE, ORANGE, GREEN = "#0072B2", "#D55E00", "#009E73"
_LEAST_PERCENT = 0.05


def recall_plot(groups: Sequence[GroupScore]) -> bytes:
    """Plot recall and precision against each factor that has a scale, with 95 % by scene.

    Parameters
    ----------
    groups : sequence of GroupScore
        Of any factors.
    """
    scaled = [one for one in groups if math.isfinite(one.middle)]
    factors = list(dict.fromkeys(one.factor for one in scaled))
    figure = new_figure(3.6)
    axes = figure.subplots(1, max(len(factors), 1), sharey=True, squeeze=False)[0]
    for ax, factor in zip(axes, factors, strict=False):
        own = [one for one in scaled if one.factor == factor]
        scale = 100.0 if "%" in factor else 1.0
        where = np.array([scale * one.middle for one in own])
        parts: list[tuple[str, str, str, list[Estimate | None]]] = [
            ("recall", BLUE, "o", [one.recall for one in own]),
            ("precision", ORANGE, "s", [one.precision for one in own]),
        ]
        for label, colour, marker, estimates in parts:
            known = [
                (x, e) for x, e in zip(where, estimates, strict=True) if e is not None and e.count
            ]
            if not known:
                continue
            x = [one[0] for one in known]
            y = np.array([one[1].value for one in known])
            low = y - np.nan_to_num([e.low for _, e in known], nan=1.0)
            high = np.nan_to_num([e.high for _, e in known], nan=0.0) - y
            bars = np.maximum([low, high], 0)
            ax.errorbar(x, y, bars, color=colour, marker=marker, capsize=3, label=label)
        ax.set_xlabel(factor)
        ax.set_ylim(-0.02, 1.02)
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("share")
    if factors:
        axes[0].legend(fontsize=9, loc="lower left")
    return as_png(figure)


def end_error_plot(rows: Sequence[EndRow]) -> bytes:
    """Plot how many ends have at most which error, those in sight and those hidden.

    Parameters
    ----------
    rows : sequence of EndRow
        At least one.
    """
    ends = [(r.blossom_percent, r.blossom_seen) for r in rows]
    ends += [(r.stem_percent, r.stem_seen) for r in rows]
    figure = new_figure(3.6)
    ax = figure.subplots()
    for label, colour, seen in (("in sight", BLUE, True), ("hidden", ORANGE, False)):
        errors = np.sort([e for e, s in ends if s is seen and math.isfinite(e)])
        if errors.size:
            share = 100 * np.arange(1, len(errors) + 1) / len(errors)
            name = f"{label} (n = {len(errors)})"
            ax.step(np.maximum(errors, _LEAST_PERCENT), share, color=colour, label=name)
    for limit, style in ((2.0, ":"), (6.0, "--")):
        ax.axvline(limit, color="black", linewidth=0.8, linestyle=style)
    ax.set_xscale("log")
    ticks = [0.1, 0.5, 1, 2, 6, 10, 50, 100]
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.set_xlabel("distance from the true end (% of the fruit's length in the picture)")
    ax.set_ylabel("ends with at most that error (%)")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=9)
    return as_png(figure)


def overlap_plot(rows: Sequence[OverlapRow]) -> bytes:
    """Plot how many masks have at least which overlap: the network's own and SAM's two.

    Parameters
    ----------
    rows : sequence of OverlapRow
        At least one, of drawn or of real pictures.
    """
    kinds = {
        "network alone": ([r.network_iou for r in rows], GREEN, ":"),
        "SAM, box": ([r.box_iou for r in rows], BLUE, "--"),
        "SAM, box + centre": ([r.point_iou for r in rows], ORANGE, "-"),
    }
    figure = new_figure(3.6)
    ax = figure.subplots()
    for name, (values, colour, line) in kinds.items():
        known = np.sort([v for v in values if math.isfinite(v)])
        if known.size:
            share = 100 * (len(known) - np.arange(len(known))) / len(known)
            label = f"{name} (n = {len(known)})"
            ax.step(known, share, color=colour, linestyle=line, label=label, where="post")
    ax.set_xlim(0.5, 1.0)
    ax.set_xlabel("intersection over union with the true mask")
    ax.set_ylabel("masks with at least that (%)")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=9, loc="lower left")
    return as_png(figure)
