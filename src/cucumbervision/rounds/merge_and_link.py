"""Merge the rows of a stored round, and link its fruit to those of another round."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.errors import RoundError
from cucumbervision.rounds.day_linking import link_days
from cucumbervision.rounds.from_store import RoundContent, by_hand_of, read_round, stored_merging
from cucumbervision.rounds.merge import NO_PAIRS, Merged, merge_row
from cucumbervision.rounds.row_fruit import CountEstimate, count_fruit, row_fruit
from cucumbervision.rounds.row_views import ALONG
from cucumbervision.rounds.stop_alignment import prior_stops
from cucumbervision.store.links import LinkKind, LinkRecord, Position, ShiftRecord

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cucumbervision.agronomy.profiles import CropProfile
    from cucumbervision.rounds.from_store import StoredRow
    from cucumbervision.store.repository import Store

DAY_S = 86400.0


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


def merge_round(store: Store, round_key: str) -> list[RowReport]:
    """Merge all rows of a round anew and save the links and where the stops were.

    Corrections by hand are kept.

    Parameters
    ----------
    store : Store
        Where the round is.
    round_key : str
        The round.

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
        merged = _merged(row, by_hand)
        for (a, b), chance in zip(merged.pairs.tolist(), merged.probability.tolist(), strict=True):
            first, second = row.fruit_keys[a], row.fruit_keys[b]
            links.append(LinkRecord(LinkKind.SAME, first, second, chance))
        along = merged.stops.at_m[:, ALONG].tolist(), merged.stops.sd_m[:, ALONG].tolist()
        for key, at_m, sd_m in zip(row.stop_keys, *along, strict=True):
            positions[key] = Position(at_m, sd_m)
        reports.append(_report(row, merged))
    store.save_merging(round_key, links, positions)
    return reports


def _merged(row: StoredRow, links: Sequence[LinkRecord]) -> Merged:
    if not len(row.views):
        nothing = np.zeros(0)
        return Merged(nothing.astype(np.int64), prior_stops(row.stops), NO_PAIRS, nothing)
    return merge_row(row.stops, row.views, by_hand=by_hand_of(row, links))


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
