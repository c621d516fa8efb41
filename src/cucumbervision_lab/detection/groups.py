"""Recall and precision at one confidence: overall, and by distance, size, occlusion and edge."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from cucumbervision_lab.detection.estimates import Estimate, share

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from cucumbervision_lab.detection.outcomes import FoundRow, FruitRow

__all__ = ["GroupScore", "group_scores", "overall"]

ALL = "all"
_DISTANCE_M = (0.0, 0.45, 0.6, 0.75, 0.9, math.inf)
_LONG_PX = (0.0, 50.0, 100.0, 200.0, 300.0, 450.0, math.inf)
_HIDDEN = (0.0, 0.01, 0.1, 0.25, 0.5, 0.75, 1.01)


@dataclass(frozen=True)
class GroupScore:
    """Recall and precision of one group.

    Parameters
    ----------
    factor, group : str
        By what, and which.
    middle : float
        Where to plot it: the mean of the fruit's own values; NaN where there is no scale.
    recall : Estimate
        Of the fruit of this group.
    precision : Estimate, optional
        Of the detections of this group, neutral ones left out; None where detections that hit
        nothing have no such property.
    """

    factor: str
    group: str
    middle: float
    recall: Estimate
    precision: Estimate | None


def overall(fruit: Sequence[FruitRow], found: Sequence[FoundRow]) -> GroupScore:
    """Give recall and precision of everything."""
    return GroupScore(ALL, ALL, math.nan, _recall(fruit), _precision(found))


def group_scores(fruit: Sequence[FruitRow], found: Sequence[FoundRow]) -> list[GroupScore]:
    """Give recall and precision by each factor.

    Parameters
    ----------
    fruit : sequence of FruitRow
        For recall: by the fruit's own distance, size, hidden share and whether it is cut off.
    found : sequence of FoundRow
        For precision: by distance and size of the detection and whether its box reaches the
        picture's border. How much of a false detection is hidden nobody can say.

    Returns
    -------
    list of GroupScore
        Groups without any fruit or detection are left out.
    """
    scores = _by_scale(
        "distance (m)", _DISTANCE_M, fruit, found, lambda r: r.distance_m, lambda r: r.distance_m
    )
    scores += _by_scale(
        "longer side of the box (px)",
        _LONG_PX,
        fruit,
        found,
        lambda r: r.long_px,
        lambda r: r.long_px,
    )
    scores += _by_scale("hidden share (%)", _HIDDEN, fruit, found, lambda r: r.hidden_share, None)
    for name, cut in (("whole in the picture", False), ("cut by the picture's edge", True)):
        own = [r for r in fruit if r.cut_off is cut]
        seen = [r for r in found if r.cut_off is cut]
        if own or seen:
            score = GroupScore("edge", name, math.nan, _recall(own), _precision(seen))
            scores.append(score)
    return scores


def _by_scale(
    factor: str,
    edges: Sequence[float],
    fruit: Sequence[FruitRow],
    found: Sequence[FoundRow],
    of_fruit: Callable[[FruitRow], float],
    of_found: Callable[[FoundRow], float] | None,
) -> list[GroupScore]:
    scores = []
    for low, high in pairwise(edges):
        own = [r for r in fruit if low <= of_fruit(r) < high]
        seen = [r for r in found if of_found is not None and low <= of_found(r) < high]
        if not own and not seen:
            continue
        middle = sum(map(of_fruit, own)) / len(own) if own else math.nan
        precision = None if of_found is None else _precision(seen)
        name = _name(low, high, 100.0 if of_found is None else 1.0)
        scores.append(GroupScore(factor, name, middle, _recall(own), precision))
    return scores


def _name(low: float, high: float, scale: float) -> str:
    if high > 1 and scale > 1:
        return f"{scale * low:g} or more"
    if math.isinf(high):
        return f"{low:g} or more"
    return f"under {scale * high:g}" if low == 0 else f"{scale * low:g} to {scale * high:g}"


def _recall(rows: Sequence[FruitRow]) -> Estimate:
    return share([r.found for r in rows], [r.scene for r in rows])


def _precision(rows: Sequence[FoundRow]) -> Estimate:
    judged = [r for r in rows if r.outcome != "neutral"]
    return share([r.outcome == "hit" for r in judged], [r.scene for r in judged])
