"""Merge the rows of a stored round, and link its fruit to those of other days."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from statistics import fmean

import numpy as np

from cucumbervision.capture.frames import Stop
from cucumbervision.crop.profiles import CropProfile
from cucumbervision.errors import RoundError, StoreError
from cucumbervision.methods.matching import ALONG
from cucumbervision.names import house_key
from cucumbervision_greenhouse.rounds import fruit_table
from cucumbervision_greenhouse.rounds.day_linking import link_days
from cucumbervision_greenhouse.rounds.merge import merge_row
from cucumbervision_greenhouse.rounds.poses import sign_of_side
from cucumbervision_greenhouse.rounds.row_views import row_fruit
from cucumbervision_greenhouse.rounds.walking import is_demonstration, refuse_taken
from cucumbervision_greenhouse.store.marks import MOVE_ROUND, STOP_EDITS
from cucumbervision_greenhouse.store.records import SURE, LinkKind, LinkRecord, Round, StopRecord
from cucumbervision_greenhouse.store.repository import Store
from cucumbervision_greenhouse.store.waiting import WaitingCaptures

DAY_S = 86400.0


@dataclass(frozen=True)
class RowCounts:
    """One row of a round as it was merged last.

    Parameters
    ----------
    row : str
        The row.
    stops, views : int
        Stops with a position, and detections.
    fruit : int
        The fruit that these are merged into, those included that have no place.
    merged : bool
        Whether the row has been merged.
    stop_sd_m : float, optional
        How well the stops are known now, on average, metres.
    unplaced : int
        Detections that could not take part: without a position or without depth.
    """

    row: str
    stops: int
    views: int
    fruit: int
    merged: bool = True
    stop_sd_m: float | None = None
    unplaced: int = 0


@dataclass(frozen=True)
class RowLinks:
    """The result of linking one row between two rounds.

    Parameters
    ----------
    row : str
        The row.
    earlier, later : int
        Fruit of both rounds.
    links, sure : int
        Pairs likelier than not, and those that are sure; the others are offered to be confirmed.
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


def merge_round(store: Store, round_key: str) -> dict[str, list[str]]:
    """Merge all rows of a round again, and save the links and the fitted stop positions.

    What was linked or parted by hand is kept: it comes before what is found here.

    Parameters
    ----------
    store : Store
        Where the round is.
    round_key : str
        The round.

    Returns
    -------
    dict of str to list of str
        By row, the sides where positions seem to be reversed: their captures should be added again.

    Raises
    ------
    RoundError
        If a row has more than two sides.
    """
    links: list[LinkRecord] = []
    positions: dict[str, tuple[float, float]] = {}
    mirrored = {}
    for row in fruit_table.read_round(store, round_key).rows:
        merged = merge_row(row.stops, row.views)
        for (a, b), chance in zip(merged.pairs.tolist(), merged.probability.tolist(), strict=True):
            links.append(LinkRecord(LinkKind.SAME, row.fruit[a].key, row.fruit[b].key, chance))
        along = merged.stops.at_m[:, ALONG].tolist(), merged.stops.sd_m[:, ALONG].tolist()
        keys = [stop.key for stop in row.taken]
        positions |= dict(zip(keys, zip(*along, strict=True), strict=True))
        mirrored[row.name] = [row.sides[side] for side in merged.mirrored]
    store.save_merging(round_key, links, positions)
    return mirrored


@lru_cache(maxsize=fruit_table.CONTENTS)  # today's list, the forecast and the map ask for the same
def row_counts(content: fruit_table.RoundContent) -> tuple[RowCounts, ...]:
    """Return the rows of a round as they were merged last, what was done by hand included."""
    fruit = Counter(view.row or "" for view in fruit_table.counted_fruit(content.views))
    return tuple(
        RowCounts(
            row=row.name,
            stops=len(row.stops),
            views=len(row.views),
            fruit=fruit[row.name],
            merged=any(stop.fitted_m is not None for stop in row.taken),
            stop_sd_m=fmean(fruit_table.stored_merging(row)[1].sd_m[:, ALONG])
            if row.taken
            else None,
            unplaced=row.unplaced,
        )
        for row in content.rows
    )


def link_rounds(
    store: Store, earlier: str, later: str, profile: CropProfile | None = None
) -> list[RowLinks]:
    """Link the fruit of two merged rounds and save the links.

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
        If one of them is not there, they are of two houses, or the later does not come later.
    """
    first, second = (_round_of(store.rounds(), key) for key in (earlier, later))
    if house_key(first.house) != house_key(second.house):
        raise RoundError(
            "the rounds are of two houses, '{first}' and '{second}'",
            remedy="name two rounds of one house, or move one of them",
            first=first.house,
            second=second.house,
        )
    days = (second.walked_s - first.walked_s) / DAY_S
    if not days > 0:
        raise RoundError(
            "the later round was walked no later, by the times of its captures",
            remedy="name the earlier one first",
        )
    growth: tuple[float, ...] = ()
    if profile is not None:
        prior = profile.growth
        sd_m = math.hypot(prior.house_sd, prior.row_sd, prior.fruit_sd) / 100
        growth = prior.mean / 100, sd_m
    contents = fruit_table.read_round(store, earlier), fruit_table.read_round(store, later)
    rows_before = {row.name: row for row in contents[0].rows if len(row.views)}
    links, row_links = [], []
    for row in contents[1].rows:
        before = rows_before.get(row.name)
        if before is None or not len(row.views):
            continue
        fruit = [row_fruit(*fruit_table.stored_merging(day), day.views) for day in (before, row)]
        linked = link_days(fruit[0], fruit[1], days, *growth)
        for (a, b), chance in zip(linked.pairs.tolist(), linked.probability.tolist(), strict=True):
            keys = before.fruit[fruit[0].best[a]].key, row.fruit[fruit[1].best[b]].key
            links.append(LinkRecord(LinkKind.GROWTH, *keys, chance))
        shift = float(np.median(linked.shift_m[:, ALONG]))
        sd = float(np.median(linked.shift_sd_m[:, ALONG]))
        sizes = (
            len(fruit[0]),
            len(fruit[1]),
            len(linked.pairs),
            int((linked.probability >= SURE).sum()),
        )
        row_links.append(RowLinks(row.name, *sizes, shift, sd))
    store.save_growth(earlier, later, links)
    # As they were linked before the captures of that day were added.
    store.save_growth(later, earlier, ())
    return row_links


_SAME_DAY_S = DAY_S / 4  # rounds closer in time show the fruit of one day
_FARTHEST_S = 10 * DAY_S  # fruit of earlier rounds are picked by now, or too long


def settle(store: Store, round_key: str, profile: CropProfile | None = None) -> str:
    """Merge a round's views, and link its fruit to the neighbouring rounds of its house.

    Parameters
    ----------
    store : Store
        Where the round is.
    round_key : str
        The round.
    profile : CropProfile, optional
        Whose growth is expected between days.

    Returns
    -------
    str
        What could not be done, in one line; empty where all was.
    """
    try:
        merge_round(store, round_key)
        before = earlier_rounds(store, round_key, within_s=_FARTHEST_S)[:1]
        after = later_rounds(store, round_key)[:1]
        for earlier in before:
            link_rounds(store, earlier.key, round_key, profile)
        for later in after:
            link_rounds(store, round_key, later.key, profile)
            for earlier in before:  # they were neighbours before this round was added
                store.save_growth(earlier.key, later.key, ())
    except (RoundError, StoreError) as error:  # a round or fruit may have been deleted meanwhile
        return str(error)
    return ""


def move_stop(store: Store, stop: StopRecord, place: Stop, note: str = "") -> int:
    """Correct the place of a stop; return the number of the mark in the log.

    Where the side changes, what lay to the left of the camera lies to the right of it.

    Raises
    ------
    RoundError
        If it is moved to where another stop of the round is, of the same camera.
    StoreConflictError
        If it is not where `stop` says any more.
    """
    turned = sign_of_side(place.side) != sign_of_side(stop.side)
    moved = replace(stop, **asdict(place), note=note, mirrored=stop.mirrored != turned)
    if (moved.row, moved.side, moved.position_m) != (stop.row, stop.side, stop.position_m):
        refuse_taken(store, moved)
    return store.place_stop(moved, stop)


def delete_round(store: Store, round_key: str, waiting: WaitingCaptures) -> list[str]:
    """Take a round out of the list of rounds; return the rounds that have to be settled then.

    Parameters
    ----------
    store : Store
        Where it is.
    round_key : str
        The round.
    waiting : WaitingCaptures
        What waits to be measured.

    Raises
    ------
    RoundError
        If captures wait to be measured into it.
    StoreError
        If it is not there.
    """
    waits = sum(capture.round_key == round_key for capture in waiting.captures())
    if waits:
        fault = "{count} captures wait to be measured into it"
        fault = "1 capture waits to be measured into it" if waits == 1 else fault
        raise RoundError(fault, remedy="delete it afterwards", count=waits)
    after = later_rounds(store, round_key)[:1]
    store.delete_round(round_key)
    return [later.key for later in after]  # its fruit are those of the round before now


def move_rounds(
    store: Store, keys: Sequence[str], house: str, seen: str | None = None
) -> list[str]:
    """Move rounds to a house, as `Store.move_rounds` does.

    Returns
    -------
    list of str
        The rounds that have to be settled then: those that moved, and those that follow on them,
        in the house that they left and in the other.
    """
    before = store.rounds()
    store.move_rounds(keys, house, seen)
    return _to_settle(keys, before, store.rounds())


def undo(store: Store, round_key: str | None = None, *, number: int | None = None) -> list[str]:
    """Undo a correction, as `Store.undo` does.

    Returns
    -------
    list of str
        The rounds that have to be settled then: one whose stop has moved, or that is in another
        house again, and those that follow on it.

    Raises
    ------
    StoreError
        If there is nothing to undo, or a later action depends on it.
    """
    before = store.rounds()
    done = store.undo(round_key, number=number)
    line = next(entry for entry in store.log(round_key, limit=None) if entry.number == done)
    if line.round_key and line.details["kind"] == MOVE_ROUND:
        return _to_settle([line.round_key], before, store.rounds())
    return [line.round_key] if line.round_key and line.details["kind"] in STOP_EDITS else []


def _to_settle(keys: Sequence[str], before: list[Round], after: list[Round]) -> list[str]:
    """Return rounds that moved, with those that follow on them, before and after they did."""
    following = [
        later.key for rounds in (before, after) for key in keys for later in _later(rounds, key)[:1]
    ]
    return list(dict.fromkeys([*keys, *following]))


def earlier_rounds(store: Store, round_key: str, within_s: float = math.inf) -> list[Round]:
    """Return the rounds of the same house of earlier days, the nearest first.

    Days are those of the captures (`Round.walked_s`), whenever a round was begun.

    Parameters
    ----------
    store : Store
        Where the rounds are.
    round_key : str
        A round.
    within_s : float
        Longest time before that round, seconds.
    """
    return [x for days_s, x in _neighbours(store.rounds(), round_key) if 0 < -days_s < within_s]


def later_rounds(store: Store, round_key: str) -> list[Round]:
    """Return the rounds of the same house of later days, the nearest first."""
    return _later(store.rounds(), round_key)


def _later(rounds: list[Round], round_key: str) -> list[Round]:
    return [x for days_s, x in _neighbours(rounds, round_key) if 0 < days_s < _FARTHEST_S]


def _round_of(rounds: list[Round], key: str) -> Round:
    for round_summary in rounds:
        if round_summary.key == key:
            return round_summary
    raise RoundError("there is no round {key}", remedy="see the list of rounds", key=key)


def rounds_of_house(store: Store, round_key: str) -> list[Round]:
    """Return the rounds of a round's house that hold fruit, the latest walk first."""
    rounds = store.rounds()
    return sorted(_of_house(rounds, _round_of(rounds, round_key)), key=lambda x: -x.walked_s)


def _of_house(rounds: list[Round], current: Round) -> list[Round]:
    """Return the rounds of one house that hold fruit.

    The demonstration is in no house, so that it is never a day of one without a name.
    """
    house = house_key(current.house), is_demonstration(current.key)
    return [x for x in rounds if x.fruit and (house_key(x.house), is_demonstration(x.key)) == house]


def _neighbours(rounds: list[Round], round_key: str) -> list[tuple[float, Round]]:
    """Return the other rounds of a house that hold fruit, each with how much later it was walked.

    Those of the same day are left out; the nearest is first.
    """
    current = _round_of(rounds, round_key)
    others = [(x.walked_s - current.walked_s, x) for x in _of_house(rounds, current)]
    return sorted(
        (part for part in others if abs(part[0]) > _SAME_DAY_S), key=lambda part: abs(part[0])
    )
