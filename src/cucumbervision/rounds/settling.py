"""What follows every new or moved stop: views merged, fruit linked to those of other days."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cucumbervision.errors import RoundError, StoreError
from cucumbervision.rounds.merge_and_link import DAY_S, link_rounds, merge_round
from cucumbervision.rounds.poses import sign_of_side
from cucumbervision.rounds.walking import refuse_taken
from cucumbervision.store.edits import STOP_EDITS, StopPlace

if TYPE_CHECKING:
    from cucumbervision.agronomy.profiles import CropProfile
    from cucumbervision.capture.frames import Stop
    from cucumbervision.store.repository import Store
    from cucumbervision.store.views import RoundView, StopView
    from cucumbervision.store.waiting import WaitingCaptures

_SAME_DAY_S = DAY_S / 4  # rounds nearer than that show one day's fruit
_FARTHEST_S = 10 * DAY_S  # fruit seen longer ago are picked, or too long


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
        before, after = earlier_round(store, round_key), later_rounds(store, round_key)
        for one in () if before is None else (before,):
            link_rounds(store, one.key, round_key, profile)
        for one in after[:1]:
            link_rounds(store, round_key, one.key, profile)
            if before is not None:  # they were neighbours while this round was not there
                store.save_growth(before.key, one.key, ())
    except (RoundError, StoreError) as error:  # somebody may delete a round or fruit meanwhile
        return str(error)
    return ""


def move_stop(store: Store, stop: StopView, place: Stop, note: str = "") -> int:
    """Say where a stop was taken really; return the change's number in the log.

    Where the side changes, what lay to the left of the camera lies to the right of it.

    Raises
    ------
    RoundError
        If it is moved to where another stop of the round is, of the same camera.
    """
    if (place.row, place.side, place.position_m) != (stop.row, stop.side, stop.position_m):
        camera = store.cameras(stop.round_key)[stop.key]
        refuse_taken(store, stop.round_key, place, camera, but=stop.key)
    turned = sign_of_side(place.side) != sign_of_side(stop.side)
    where = StopPlace(
        place.row, place.side, place.position_m, place.step, note, stop.mirrored != turned
    )
    return store.place_stop(stop.key, where)


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
    waits = sum(one.round_key == round_key for one in waiting.captures())
    if waits:
        words = "1 capture waits" if waits == 1 else f"{waits} captures wait"
        raise RoundError(f"{words} to be measured into it", remedy="delete it afterwards")
    after = later_rounds(store, round_key)[:1]
    store.delete_round(round_key)
    return [one.key for one in after]  # its fruit are those of the round before now


def undo(store: Store, round_key: str | None = None, *, number: int | None = None) -> str:
    """Undo a correction, as `Store.undo` does.

    Returns
    -------
    str
        The round whose stop has moved, so that it has to be merged again; empty for none.

    Raises
    ------
    StoreError
        If there is nothing to undo, or a later action depends on it.
    """
    done = store.undo(round_key, number=number)
    line = next(one for one in store.log(round_key, limit=None) if one.number == done)
    return (line.round_key or "") if line.details["kind"] in STOP_EDITS else ""


def earlier_round(store: Store, round_key: str) -> RoundView | None:
    """Return the newest round of the same house of an earlier day; None where there is none."""
    one, others = _neighbours(store, round_key)
    begun = one.record.started_s
    near = [x for x in others if _SAME_DAY_S < begun - x.record.started_s < _FARTHEST_S]
    return near[0] if near else None


def later_rounds(store: Store, round_key: str) -> list[RoundView]:
    """Return the rounds of the same house of later days, the nearest first."""
    one, others = _neighbours(store, round_key)
    begun = one.record.started_s
    return [x for x in others[::-1] if _SAME_DAY_S < x.record.started_s - begun < _FARTHEST_S]


def _neighbours(store: Store, round_key: str) -> tuple[RoundView, list[RoundView]]:
    """Return a round, and the others of its house that hold fruit, the newest first."""
    rounds = store.rounds()
    one = next((x for x in rounds if x.key == round_key), None)
    if one is None:
        raise RoundError(f"there is no round {round_key}", remedy="see the list of rounds")
    house = one.record.house
    return one, [x for x in rounds if x.key != round_key and x.record.house == house and x.fruit]
