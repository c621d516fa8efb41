"""A round's fruit, each once, with the length of all its views; and the context of one fruit."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from statistics import fmean, stdev
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.measurement.matching import pooled_length
from cucumbervision.measurement.result import INTERVAL_Z
from cucumbervision_greenhouse.agronomy.forecast import natural_key
from cucumbervision_greenhouse.rounds.from_store import (
    CONTENTS,
    RoundContent,
    counted_fruit,
    joint_groups,
    stored_merging,
)
from cucumbervision_greenhouse.rounds.row_fruit import joint_tube_is_used
from cucumbervision_greenhouse.store.views import Verdict

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from cucumbervision_greenhouse.store.records import DetectionRecord, JointRecord
    from cucumbervision_greenhouse.store.views import DetectionSummary


# Fields from a joint tube fit; all others are those of the best view.
_OF_ALL_VIEWS = (
    *("reason", "fallback", "flags", "length", "raw_length"),
    *("centreline_m", "thread_m", "chord_m", "inner_arc_m"),
    *("diameter_max_m", "diameter_mean_m", "volume_m3", "tilt_deg", "hidden_share"),
)


@dataclass(frozen=True)
class RoundFruit:
    """One fruit of a round.

    Parameters
    ----------
    number : int
        Its number in the table, from 1, by row and position.
    view : DetectionSummary
        The representative view, with its measurement. Where two or more views show the whole fruit,
        its length and interval are those of all of them together: of one tube fitted to all of
        them where there is one, and else their lengths pooled.
    joint : JointRecord, optional
        The tube fitted to all views, where its length is used.
    """

    number: int
    view: DetectionSummary
    joint: JointRecord | None = None


@dataclass(frozen=True)
class RoundFigures:
    """The figures of a round, the same on all pages and in all files, without deleted fruit.

    Parameters
    ----------
    fruit, measured, picked : int
        Fruit, each once; those with a length; and those that were picked.
    detections : int
        Number of their detections.
    mean_m, sd_m, shortest_m, longest_m : float, optional
        Of the lengths of the fruit on the plant, metres; lower bounds and lengths of which
        nothing is known are left out.
    """

    fruit: int
    measured: int
    picked: int
    detections: int
    mean_m: float | None
    sd_m: float | None
    shortest_m: float | None
    longest_m: float | None


def on_the_plant(fruit: Iterable[DetectionSummary]) -> list[DetectionSummary]:
    """Return the fruit that count today: neither deleted, picked nor doubtful."""
    return [
        view
        for view in fruit
        if view.picked_s is None and view.verdict is not Verdict.REJECTED and not view.doubtful
    ]


def hanging_lengths_m(fruit: Iterable[DetectionSummary]) -> list[float]:
    """Return the lengths of the fruit on the plant, metres, that count (`whole_length`)."""
    lengths = (view.record.whole_length for view in on_the_plant(fruit))
    return [length.value_m for length in lengths if length is not None]


def round_figures(content: RoundContent, table: Sequence[RoundFruit]) -> RoundFigures:
    """Return the figures of a round from its content and its `fruit_table`."""
    lengths_m = hanging_lengths_m(line.view for line in table)
    return RoundFigures(
        fruit=len(table),
        measured=sum(line.view.record.length_m is not None for line in table),
        picked=sum(line.view.picked_s is not None for line in table),
        detections=sum(view.verdict is not Verdict.REJECTED for view in content.views),
        mean_m=fmean(lengths_m) if lengths_m else None,
        sd_m=stdev(lengths_m) if len(lengths_m) > 1 else None,
        shortest_m=min(lengths_m, default=None),
        longest_m=max(lengths_m, default=None),
    )


@lru_cache(maxsize=CONTENTS)  # all pages of a round ask for the same
def fruit_table(content: RoundContent) -> tuple[RoundFruit, ...]:
    """Return a round's fruit, each once, by row and position; rejected ones are left out."""
    pooled, joint = _pooled(content), _joint(content)
    best = counted_fruit(content.views)
    best.sort(key=lambda v: (natural_key(v.row or ""), v.along_m is None, v.along_m or 0.0, v.key))
    return tuple(
        _fruit(number, view, joint.get(view.key), pooled.get(view.key))
        for number, view in enumerate(best, 1)
    )


def _joint(content: RoundContent) -> dict[str, JointRecord]:
    """Return joint measurements of fruit that several stops show whole, by the best views' keys."""
    joint_of_group = {}
    for key, views in joint_groups(content).items():
        joint = content.joint.get(key)
        if joint is not None and joint.reason == "ok":
            joint_of_group[views[0].group] = joint
    return joint_of_group


def _fruit(
    number: int,
    view: DetectionSummary,
    joint: JointRecord | None,
    pooled: tuple[float, float, int] | None,
) -> RoundFruit:
    """Return a fruit's line, with the length of all views where they give one."""
    tube = None if joint is None else joint.record
    if tube is not None and tube.length is not None:
        pooled_length = _own_length(view.record) if pooled is None else pooled[:2]
        if joint_tube_is_used(tube.length, pooled_length):
            values = {name: getattr(tube, name) for name in _OF_ALL_VIEWS}
            return RoundFruit(number, _measured(view, **values), joint)
    if pooled is not None and pooled[2] > 1 and view.record.length is not None:
        length_m, sd_m, _ = pooled
        length = replace(view.record.length, value_m=length_m)
        if length.low_m is not None:
            spread = math.exp(INTERVAL_Z * sd_m / length_m)
            length = replace(length, low_m=length_m / spread, high_m=length_m * spread)
        return RoundFruit(number, _measured(view, length=length))
    return RoundFruit(number, view)


def _measured(view: DetectionSummary, **values: Any) -> DetectionSummary:
    return replace(view, record=replace(view.record, **values))


def _own_length(record: DetectionRecord) -> tuple[float, float] | None:
    """Return the length of a view and its standard deviation; None unless it is whole and known."""
    length = record.whole_length
    if length is None or not length.relative_sd:
        return None
    return length.value_m, length.value_m * length.relative_sd


def _pooled(content: RoundContent) -> dict[str, tuple[float, float, int]]:
    """Return the pooled length of each fruit by all keys of its views, and how many gave it.

    Whole views with different kinds of length count as one view, the best.
    """
    length_of_key = {}
    kind = {view.key: view.record.length and view.record.length.kind for view in content.views}
    for row in content.rows:
        if not len(row.views):
            continue
        cluster = stored_merging(content, row).cluster
        views = row.views
        order = np.argsort(cluster, kind="stable")
        for members in np.split(order, np.flatnonzero(np.diff(cluster[order])) + 1):
            length = pooled_length(
                views.length_m[members], views.length_sd[members], views.partial[members]
            )
            if length is None:
                continue
            measured = members[np.isfinite(views.length_m[members]) & ~views.partial[members]]
            kinds = {kind[row.fruit_keys[k]] for k in measured.tolist()}
            count = len(measured) if len(kinds) == 1 else 1
            keys = (row.fruit_keys[k] for k in members.tolist())
            length_of_key.update(dict.fromkeys(keys, (*length, count)))
    return length_of_key


def least_sure_first(fruit: Sequence[DetectionSummary]) -> list[DetectionSummary]:
    """Return unjudged fruit with a single view, the least certain first."""
    once = [view for view in fruit if view.views == 1 and view.verdict is None]
    return sorted(once, key=lambda view: (view.record.score, view.key))
