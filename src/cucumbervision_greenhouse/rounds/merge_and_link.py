"""Merge the rows of a stored round, and link its fruit to those of other days."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from statistics import fmean
from typing import Any

import numpy as np

from cucumbervision.capture.frames import Stop
from cucumbervision.crop.profiles import CropProfile
from cucumbervision.errors import RoundError, StoreError
from cucumbervision.methods.matching import ALONG
from cucumbervision.names import house_key
from cucumbervision_greenhouse.rounds import fruit_table
from cucumbervision_greenhouse.rounds.day_linking import link_days
from cucumbervision_greenhouse.rounds.merge import merge_row
from cucumbervision_greenhouse.rounds.row_views import row_fruit
from cucumbervision_greenhouse.rounds.walking import is_demonstration, refuse_taken, sign_of_side
from cucumbervision_greenhouse.store.marks import MOVE_ROUND, STOP_EDITS
from cucumbervision_greenhouse.store.records import SURE, LinkKind, LinkRecord, Round, StopRecord
from cucumbervision_greenhouse.store.repository import Store
from cucumbervision_greenhouse.store.waiting import WaitingCaptures

DAY_S = 86400.0


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


def row_counts(content: fruit_table.RoundContent) -> list[dict[str, Any]]:
    """Return a line for each row of a round as it was merged last, links by hand included.

    Each has 'row', 'stops' (with a position), 'views', 'fruit' (those without a place included),
    'stop_sd_m' (how well the stops are known now, on average, metres; None without any), and
    'unplaced': views without a position or depth, which were not merged.
    """
    fruit = Counter(view.row or "" for view in fruit_table.counted_fruit(content.views))
    return [
        {
            **{"row": row.name, "stops": len(row.stops), "views": len(row.views)},
            **{"fruit": fruit[row.name], "unplaced": row.unplaced},
            "stop_sd_m": fmean(fruit_table.stored_merging(row)[1].sd_m[:, ALONG])
            if row.taken
            else None,
        }
        for row in content.rows
    ]


def link_rounds(
    store: Store, earlier: str, later: str, profile: CropProfile | None = None
) -> list[dict[str, Any]]:
    """Link the fruit of two merged rounds and save the links.

    Parameters
    ----------
    store : Store
        Where the rounds are.
    earlier, later : str
        Their keys.
    profile : CropProfile, optional
        Whose growth is expected; 3 cm a day, give or take 1, without.

    Returns
    -------
    list of dict
        A line for each row: 'row', the fruit of both rounds as 'earlier' and 'later', 'links'
        (pairs likelier than not), 'sure' (those that are sure; people are asked about the others),
        and how far the row was moved along, 'shift_m' and 'shift_sd_m', medians of its stretches.

    Raises
    ------
    RoundError
        If one of them is not there, they are of two houses, or the later does not come later.
    """
    rounds = store.rounds()
    first, second = (_round_of(rounds, key) for key in (earlier, later))
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
    rows_before = {row.name: row for row in fruit_table.read_round(store, earlier).rows}
    links, lines = [], list[dict[str, Any]]()
    for row in fruit_table.read_round(store, later).rows:
        before = rows_before.get(row.name)
        if before is None or not (len(before.views) and len(row.views)):
            continue
        fruit = [row_fruit(*fruit_table.stored_merging(day), day.views) for day in (before, row)]
        linked = link_days(fruit[0], fruit[1], days, *growth)
        for (a, b), chance in zip(linked.pairs.tolist(), linked.probability.tolist(), strict=True):
            keys = before.fruit[fruit[0].best[a]].key, row.fruit[fruit[1].best[b]].key
            links.append(LinkRecord(LinkKind.GROWTH, *keys, chance))
        shifts = {"shift_m": linked.shift_m, "shift_sd_m": linked.shift_sd_m}
        lines.append(
            {
                **{"row": row.name, "earlier": len(fruit[0]), "later": len(fruit[1])},
                **{"links": len(linked.pairs), "sure": sum(linked.probability >= SURE)},
                **{name: float(np.median(x[:, ALONG])) for name, x in shifts.items()},
            }
        )
    store.save_growth(earlier, later, links)
    # As they were linked before the captures of that day were added.
    store.save_growth(later, earlier, ())
    return lines


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
        rounds = store.rounds()
        oldest_s = _round_of(rounds, round_key).walked_s - _FARTHEST_S
        earlier, later = (walks[:1] for walks in _neighbours(rounds, round_key))
        before = [x.key for x in earlier if x.walked_s > oldest_s]
        for key in before:
            link_rounds(store, key, round_key, profile)
        for after in later:
            link_rounds(store, round_key, after.key, profile)
            for key in before:  # they were neighbours before this round was added
                store.save_growth(key, after.key, ())
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
    _, after = _neighbours(store.rounds(), round_key)
    store.delete_round(round_key)
    return [later.key for later in after[:1]]  # its fruit are those of the round before now


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
        later.key
        for rounds in (before, after)
        for key in keys
        for later in _neighbours(rounds, key)[1][:1]
    ]
    return list(dict.fromkeys([*keys, *following]))


def earlier_rounds(store: Store, round_key: str) -> list[Round]:
    """Return the rounds of the same house of earlier days, the nearest first.

    Days are those of the captures (`Round.walked_s`), whenever a round was begun.
    """
    return _neighbours(store.rounds(), round_key)[0]


def _neighbours(rounds: list[Round], round_key: str) -> tuple[list[Round], list[Round]]:
    """Return the rounds of a house with fruit on earlier days and on later ones, nearest first.

    Later rounds that are so far off that they show none of the same fruit are left out.
    """
    current = _round_of(rounds, round_key)
    others = sorted(_of_house(rounds, current), key=lambda x: abs(x.walked_s - current.walked_s))
    after_s = [(x, x.walked_s - current.walked_s) for x in others]
    earlier = [x for x, later_s in after_s if later_s < -_SAME_DAY_S]
    return earlier, [x for x, later_s in after_s if _SAME_DAY_S < later_s < _FARTHEST_S]


def _round_of(rounds: list[Round], key: str) -> Round:
    for walk in rounds:
        if walk.key == key:
            return walk
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
