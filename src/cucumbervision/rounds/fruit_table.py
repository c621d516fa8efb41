"""A round's fruit, each once, with the length that all of its views give; and its figures."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from statistics import fmean, stdev
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.agronomy.forecast import natural_key
from cucumbervision.rounds.from_store import RoundContent, joint_groups, stored_merging
from cucumbervision.rounds.row_fruit import (
    LENGTH_Z,
    combined_length,
    joint_tube_is_used,
    relative_sd,
)
from cucumbervision.store.views import Verdict

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from cucumbervision.store.records import DetectionRecord, JointRecord
    from cucumbervision.store.views import DetectionView

# What a tube in all views says of a fruit; the rest of its line is the best view's.
_OF_ALL_VIEWS = (
    *("reason", "fallback", "flags", "length_m", "length_kind", "length_sd_m"),
    *("interval_low_m", "interval_high_m", "interval_of", "interval_basis"),
    *("centreline_m", "thread_m", "chord_m", "inner_arc_m"),
    *("diameter_max_m", "diameter_mean_m", "volume_m3", "tilt_deg", "hidden_share"),
    *("raw_length_m", "raw_length_kind"),
)


@dataclass(frozen=True)
class RoundFruit:
    """One fruit of a round.

    Parameters
    ----------
    number : int
        Its number in the table, from 1, by row and position.
    view : DetectionView
        The representative view, with its measurement. Where two or more views show the whole fruit,
        its length and interval are those of all of them together: of one tube fitted to all of
        them where there is one, and else their lengths combined.
    length_m, length_sd_m : float, optional
        Length that all views give together.
    joint : JointRecord, optional
        The tube fitted to all views, where its length is used.
    """

    number: int
    view: DetectionView
    length_m: float | None
    length_sd_m: float | None
    joint: JointRecord | None = None


@dataclass(frozen=True)
class RoundFigures:
    """The figures of a round, the same on all pages and in all files. Deleted fruit count not.

    Parameters
    ----------
    fruit, measured, picked : int
        Fruit, each once; those with a length; and those that were picked.
    detections : int
        Finds that these are made of.
    mean_m, sd_m, shortest_m, longest_m : float, optional
        Of the lengths of the fruit on the plant, metres.
    """

    fruit: int
    measured: int
    picked: int
    detections: int
    mean_m: float | None
    sd_m: float | None
    shortest_m: float | None
    longest_m: float | None


def hanging_lengths_m(fruit: Iterable[DetectionView]) -> list[float]:
    """Return the lengths of the fruit that are neither deleted, picked nor doubtful, metres."""
    return [
        view.record.length_m
        for view in fruit
        if view.record.length_m is not None
        and view.picked_s is None
        and view.verdict is not Verdict.REJECTED
        and not view.doubtful
    ]


def round_figures(content: RoundContent, table: Sequence[RoundFruit]) -> RoundFigures:
    """Return the figures of a round from its content and its `fruit_table`."""
    lengths_m = hanging_lengths_m(line.view for line in table)
    return RoundFigures(
        len(table),
        sum(line.view.record.length_m is not None for line in table),
        sum(line.view.picked_s is not None for line in table),
        sum(view.verdict is not Verdict.REJECTED for view in content.views),
        fmean(lengths_m) if lengths_m else None,
        stdev(lengths_m) if len(lengths_m) > 1 else None,
        min(lengths_m, default=None),
        max(lengths_m, default=None),
    )


def fruit_table(content: RoundContent) -> list[RoundFruit]:
    """Return a round's fruit, each once, by row and position; rejected ones are left out."""
    combined, joint = _combined(content), _joint(content)
    best = [view for view in content.views if view.best and view.verdict is not Verdict.REJECTED]
    best.sort(key=lambda v: (natural_key(v.row or ""), v.along_m is None, v.along_m or 0.0, v.key))
    lines = []
    for number, view in enumerate(best, 1):
        known = combined.get(view.key)
        line = _by_one_tube(number, view, joint.get(view.key), known)
        if line is None and known is not None:
            length_m, sd_m, views = known
            seen = _by_all_views(view, length_m, sd_m) if views > 1 else view
            line = RoundFruit(number, seen, length_m, sd_m)
        lines.append(line or RoundFruit(number, view, None, None))
    return lines


def _joint(content: RoundContent) -> dict[str, JointRecord]:
    """Return what one tube says of fruit that several stops show whole, by the best views' keys."""
    found = {}
    for key, views in joint_groups(content).items():
        one = content.joint.get(key)
        if one is not None and one.reason == "ok":
            found[views[0].group] = one
    return found


def _by_one_tube(
    number: int,
    view: DetectionView,
    joint: JointRecord | None,
    combined: tuple[float, float, int] | None,
) -> RoundFruit | None:
    found = None if joint is None else joint.record
    if found is None or found.length_m is None:
        return None
    low_m, high_m = found.interval_low_m, found.interval_high_m
    if low_m is None or high_m is None or not 0 < low_m <= found.length_m <= high_m:
        return None
    others = _own_length(view.record) if combined is None else combined[:2]
    if not joint_tube_is_used((found.length_m, low_m, high_m), others):
        return None
    sd_m = found.length_m * relative_sd(low_m, high_m)
    record = replace(view.record, **{name: getattr(found, name) for name in _OF_ALL_VIEWS})
    return RoundFruit(number, replace(view, record=record), found.length_m, sd_m, joint)


def _own_length(record: DetectionRecord) -> tuple[float, float] | None:
    """Return the length of a view and its standard deviation; None where it is a lower bound."""
    low_m, high_m = record.interval_low_m, record.interval_high_m
    if record.at_least or not record.length_m or not low_m or not high_m or low_m >= high_m:
        return None
    return record.length_m, record.length_m * relative_sd(low_m, high_m)


def _by_all_views(view: DetectionView, length_m: float, sd_m: float) -> DetectionView:
    spread = math.exp(LENGTH_Z * sd_m / length_m)
    record = replace(view.record, length_m=length_m, length_sd_m=sd_m)
    if record.interval_low_m is not None:
        low, high = length_m / spread, length_m * spread
        record = replace(record, interval_low_m=low, interval_high_m=high)
    return replace(view, record=record)


def _combined(content: RoundContent) -> dict[str, tuple[float, float, int]]:
    """Return the combined length of each fruit by all keys of its views, and how many gave it.

    Whole views of which one is a thread and another a chord count as one: the best.
    """
    found = {}
    kind = {view.key: view.record.length_kind for view in content.views}
    for row in content.rows:
        if not len(row.views):
            continue
        cluster = stored_merging(content, row).cluster
        views = row.views
        order = np.argsort(cluster, kind="stable")
        for own in np.split(order, np.flatnonzero(np.diff(cluster[order])) + 1):
            length = combined_length(views.length_m[own], views.length_sd[own], views.partial[own])
            if length is None:
                continue
            whole = own[np.isfinite(views.length_m[own]) & ~views.partial[own]]
            kinds = {kind[row.fruit_keys[k]] for k in whole.tolist()}
            count = len(whole) if len(kinds) == 1 else 1
            keys = (row.fruit_keys[k] for k in own.tolist())
            found.update(dict.fromkeys(keys, (*length, count)))
    return found
