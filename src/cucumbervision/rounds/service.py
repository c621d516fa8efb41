"""Rounds as commands and pages need them: merged, linked between days, listed, forecast."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from statistics import fmean, stdev
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.agronomy.forecast import natural_key
from cucumbervision.errors import RoundError
from cucumbervision.rounds.day_linking import link_days
from cucumbervision.rounds.from_store import (
    RoundContent,
    by_hand_of,
    joint_groups,
    read_round,
    stored_merging,
)
from cucumbervision.rounds.merge import NO_PAIRS, Merged, MergeSettings, merge_row
from cucumbervision.rounds.row_fruit import (
    LENGTH_Z,
    CountEstimate,
    combined_length,
    count_fruit,
    one_tube_stands,
    relative_sd,
    row_fruit,
)
from cucumbervision.rounds.row_views import ALONG
from cucumbervision.rounds.stop_alignment import prior_stops
from cucumbervision.store.views import LinkKind, LinkRecord, Position, ShiftRecord, Verdict

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from cucumbervision.agronomy.profiles import CropProfile
    from cucumbervision.rounds.from_store import StoredRow
    from cucumbervision.store.records import DetectionRecord, JointRecord
    from cucumbervision.store.repository import Store
    from cucumbervision.store.views import DetectionView, RoundView

DAY_S = 86400.0

# What a tube in all views says of a fruit; the rest of its line is the best view's.
_OF_ALL_VIEWS = (
    *("reason", "fallback", "flags", "length_m", "length_kind", "length_sd_m"),
    *("interval_low_m", "interval_high_m", "interval_of", "interval_basis"),
    *("centreline_m", "thread_m", "chord_m", "inner_arc_m"),
    *("diameter_max_m", "diameter_mean_m", "volume_m3", "tilt_deg", "hidden_share"),
    *("raw_length_m", "raw_length_kind"),
)


@dataclass(frozen=True)
class RowReport:
    """What merging found of one row.

    Parameters
    ----------
    row : str
        The row.
    stops, views : int
        Stops with a position, and detections.
    count : CountEstimate
        The fruit that these are merged into, and how many there are.
    merged : bool
        Whether the row has been merged.
    stop_sd_m : float, optional
        How well the stops are known now, on average, metres.
    across_m : float, optional
        Distance between the cameras of the two aisles, where both were walked.
    mirrored : tuple of str
        Sides where positions seem to count the other way: they should be added anew.
    unplaced : int
        Detections that could not take part: without a position or without depth.
    """

    row: str
    stops: int
    views: int
    count: CountEstimate
    merged: bool = True
    stop_sd_m: float | None = None
    across_m: float | None = None
    mirrored: tuple[str, ...] = ()
    unplaced: int = 0

    @property
    def fruit(self) -> int:
        """How many fruit were found."""
        return len(self.count.seen)


@dataclass(frozen=True)
class RowLinks:
    """What linking found of one row between two rounds.

    Parameters
    ----------
    row : str
        The row.
    earlier, later : int
        Fruit of both rounds.
    links, sure : int
        Pairs likelier than not, and those sure enough to count for growth.
    shift_m, shift_sd_m : float
        How far the row was moved along, metres; the median of its stretches.
    """

    row: str
    earlier: int
    later: int
    links: int
    sure: int
    shift_m: float
    shift_sd_m: float


@dataclass(frozen=True)
class RoundFruit:
    """One fruit of a round.

    Parameters
    ----------
    number : int
        Its number in the table, from 1, by row and position.
    view : DetectionView
        The view that stands, with its measurement. Where two or more views show the whole fruit,
        its length and interval are those of all of them together: of one tube fitted to all of
        them where there is one, and else their lengths combined.
    combined_m, combined_sd_m : float, optional
        Length that all views give together.
    joint : JointRecord, optional
        The one tube, where it stands.
    """

    number: int
    view: DetectionView
    combined_m: float | None
    combined_sd_m: float | None
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


def find_round(store: Store, name: str = "") -> RoundView:
    """Find a round by its key, the start of it, or its name; the newest without one.

    Raises
    ------
    RoundError
        If there is none, or several begin so.
    """
    rounds = store.rounds()
    wanted = name.strip().lower()
    named = [one for one in rounds if one.record.name == name or one.key == wanted]
    # A short number is never the start of a key: it may be a mistyped name.
    is_start = not wanted.isdecimal() or len(wanted) > 5
    found = named or [one for one in rounds if is_start and one.key.startswith(wanted)]
    if not wanted:
        found = rounds[:1]
    if len(found) == 1:
        return found[0]
    problem = "several rounds are" if found else "no round is"
    raise RoundError(f"{problem} called '{name}'", source=store.name, remedy="see `round list`")


def merge_round(
    store: Store, round_key: str, settings: MergeSettings | None = None
) -> list[RowReport]:
    """Merge all rows of a round anew and save the links and where the stops were.

    What was merged or parted by hand stands.

    Parameters
    ----------
    store : Store
        Where the round is.
    round_key : str
        The round.
    settings : MergeSettings, optional
        How to merge.

    Raises
    ------
    RoundError
        If a row has more than two sides.
    """
    by_hand = store.links(round_key)
    links: list[LinkRecord] = []
    positions: dict[str, Position] = {}
    reports = []
    for row in read_round(store, round_key).rows:
        merged = _merged(row, settings, by_hand)
        for (a, b), chance in zip(merged.pairs.tolist(), merged.probability.tolist(), strict=True):
            first, second = row.fruit_keys[a], row.fruit_keys[b]
            links.append(LinkRecord(LinkKind.SAME, first, second, chance))
        along = merged.stops.at_m[:, ALONG].tolist(), merged.stops.sd_m[:, ALONG].tolist()
        for key, at_m, sd_m in zip(row.stop_keys, *along, strict=True):
            positions[key] = Position(at_m, sd_m)
        reports.append(_report(row, merged))
    store.save_merging(round_key, links, positions)
    return reports


def _merged(row: StoredRow, settings: MergeSettings | None, links: Sequence[LinkRecord]) -> Merged:
    if not len(row.views):
        nothing = np.zeros(0)
        return Merged(nothing.astype(np.int64), prior_stops(row.stops), NO_PAIRS, nothing)
    return merge_row(row.stops, row.views, settings, by_hand_of(row, links))


def _report(row: StoredRow, merged: Merged, *, done: bool = True) -> RowReport:
    return RowReport(
        row.name,
        len(row.stops),
        len(row.views),
        count_fruit(merged, row.stops, row.views, row.accepted, row.false),
        done,
        float(merged.stops.sd_m[:, ALONG].mean()) if len(row.stops) else None,
        merged.across_m,
        tuple(row.sides[side] for side in merged.mirrored),
        row.unplaced,
    )


def row_reports(content: RoundContent) -> list[RowReport]:
    """Return the rows of a round as they were merged last, what was done by hand included."""
    fitted = {stop.key for stop in content.stops if stop.fitted_m is not None}
    return [
        _report(row, stored_merging(content, row), done=not fitted.isdisjoint(row.stop_keys))
        for row in content.rows
    ]


def link_rounds(
    store: Store, earlier: str, later: str, profile: CropProfile | None = None
) -> list[RowLinks]:
    """Link the fruit of two merged rounds and save links and shifts.

    Parameters
    ----------
    store : Store
        Where the rounds are.
    earlier, later : str
        Their keys.
    profile : CropProfile, optional
        Whose growth is expected; 3 cm a day, give or take 1, without.

    Raises
    ------
    RoundError
        If one of them is not there, or the later does not come later.
    """
    begun = {one.key: one.record.started_s for one in store.rounds()}
    if gone := {earlier, later} - begun.keys():
        raise RoundError(f"there is no round {min(gone)}", remedy="see the list of rounds")
    days = (begun[later] - begun[earlier]) / DAY_S
    if not days > 0:
        raise RoundError("the later round began no later", remedy="name the earlier one first")
    growth: tuple[float, ...] = ()
    if profile is not None:
        of = profile.growth
        growth = of.mean / 100, math.hypot(of.house_sd, of.row_sd, of.fruit_sd) / 100
    contents = read_round(store, earlier), read_round(store, later)
    first = {row.name: row for row in contents[0].rows if len(row.views)}
    links, shifts, found = [], [], []
    for row in contents[1].rows:
        before = first.get(row.name)
        if before is None or not len(row.views):
            continue
        fruit = [
            row_fruit(stored_merging(content, one), one.views)
            for content, one in zip(contents, (before, row), strict=True)
        ]
        linked = link_days(fruit[0], fruit[1], days, *growth)
        for (a, b), chance in zip(linked.pairs.tolist(), linked.probability.tolist(), strict=True):
            one = before.fruit_keys[fruit[0].best[a]], row.fruit_keys[fruit[1].best[b]]
            links.append(LinkRecord(LinkKind.GROWTH, *one, chance))
        shift = float(np.median(linked.shift_m[:, ALONG]))
        sd = float(np.median(linked.shift_sd_m[:, ALONG]))
        if row.name:
            shifts.append(ShiftRecord(row.name, earlier, later, shift, sd))
        sizes = len(fruit[0]), len(fruit[1]), len(linked.pairs), int(linked.sure.sum())
        found.append(RowLinks(row.name, *sizes, shift, sd))
    store.save_growth(earlier, later, links, shifts)
    return found


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
    if not one_tube_stands((found.length_m, low_m, high_m), others):
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
