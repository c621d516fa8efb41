"""Predict the next stop of a walk: its position, side and step."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

from cucumbervision.capture.frames import Stop
from cucumbervision.errors import RoundError
from cucumbervision_greenhouse.store.records import Round, StopRecord, key_of
from cucumbervision_greenhouse.store.repository import Store

_STEP_M = 0.4
_WIDEST_M = 5.0
_SAME_M = 0.005  # positions are typed to the centimetre


_T = TypeVar("_T", bound="Stop")


@dataclass(frozen=True)
class NextPlace:
    """Where the next stop of a walk will be.

    Parameters
    ----------
    row, side : str
        Row of the house, and side of the row.
    position_m : float
        Along the row.
    step_m : float
        From one stop to the next, positive.
    back : bool
        Whether positions fall along the walk.
    """

    row: str = "1"
    side: str = "left"
    position_m: float = 0.0
    step_m: float = _STEP_M
    back: bool = False

    def onward(self) -> NextPlace:
        """Return the place one step farther; no position is below 0.

        Examples
        --------
        >>> NextPlace(position_m=0.8).onward().position_m
        1.2
        >>> NextPlace(position_m=0.8, back=True).onward().position_m
        0.4
        """
        way = -self.step_m if self.back else self.step_m
        at_m = max(round(self.position_m + way, 2), 0.0)
        return NextPlace(
            row=self.row, side=self.side, position_m=at_m, step_m=self.step_m, back=self.back
        )


def next_place(stops: Sequence[Stop]) -> NextPlace:
    """Return the next place of a walk: one step from its last stop, the distance of the last two.

    Parameters
    ----------
    stops : sequence of Stop
        What was taken so far, in order.

    Examples
    --------
    >>> from cucumbervision.capture.frames import Stop
    >>> next_place([])
    NextPlace(row='1', side='left', position_m=0.0, step_m=0.4, back=False)
    >>> next_place([Stop("3", "right", 2.0, 5), Stop("3", "right", 1.5, 6)])
    NextPlace(row='3', side='right', position_m=1.0, step_m=0.5, back=True)
    """
    placed = [stop for stop in stops if stop.position_m is not None]
    if not placed:
        return NextPlace()
    last = placed[-1]
    row, side, at_m = last.row or "", last.side or "left", last.position_m or 0.0
    positions_m = [
        stop.position_m or 0.0 for stop in placed if (stop.row, stop.side) == (last.row, last.side)
    ]
    apart = positions_m[-1] - positions_m[-2] if len(positions_m) > 1 else _STEP_M
    plausible = 0.0 < abs(apart) <= _WIDEST_M
    step_m = round(abs(apart), 2) if plausible else _STEP_M
    return NextPlace(
        row=row, side=side, position_m=round(at_m, 2), step_m=step_m, back=plausible and apart < 0
    ).onward()


def unless_taken(stop: Stop, taken: Sequence[Stop]) -> Stop:
    """Return a stop at a free place: if its place is taken, one step after the last of its row.

    Two people who walk one round thus never give one place to two stops.

    Parameters
    ----------
    stop : Stop
        The position given by the operator.
    taken : sequence of Stop
        Where the others are, in order.

    Examples
    --------
    >>> from cucumbervision.capture.frames import Stop
    >>> earlier_stops = [Stop("3", "left", 0.0), Stop("3", "left", 0.5), Stop("3", "right", 1.0)]
    >>> unless_taken(Stop("3", "left", 0.5), earlier_stops).position_m
    1.0
    >>> unless_taken(Stop("3", "left", 0.25), earlier_stops).position_m
    0.25
    """
    if not stops_at(stop, taken):
        return stop
    same_side = [placed for placed in taken if (placed.row, placed.side) == (stop.row, stop.side)]
    on = next_place(same_side)
    if on.back and on.position_m == 0.0:  # the row ends there: continue from its other end
        on = replace(
            on, position_m=max(placed.position_m or 0.0 for placed in same_side), back=False
        ).onward()
    while stops_at(moved := replace(stop, position_m=on.position_m), same_side):
        on = replace(on, back=False).onward()
    return moved


def stops_at(stop: Stop, stops: Iterable[_T]) -> list[_T]:
    """Return the stops at the place of a stop; none if its place is unknown."""
    at_m = stop.position_m
    if at_m is None:
        return []
    return [
        candidate
        for candidate in stops
        if (candidate.row, candidate.side) == (stop.row, stop.side)
        and candidate.position_m is not None
        and abs(candidate.position_m - at_m) < _SAME_M
    ]


def refuse_taken(store: Store, stop: StopRecord) -> None:
    """Refuse a stop at a place that has one of the same camera: most likely a slip in typing.

    Two cameras on one mast share every place. They are two where their intrinsics differ, or their
    heights.

    Parameters
    ----------
    store : Store
        Where its round is.
    stop : StopRecord
        The stop, at its new place; itself in the round does not count.

    Raises
    ------
    RoundError
        If one is there.
    """
    for there in stops_at(stop, store.stops(stop.round_key)):
        if there.key != stop.key and there.has_camera_of(stop):
            fault = "stop {number} is at {position:.2f} m of that row and side"
            if there.step is None:
                fault = "a stop is at {position:.2f} m of that row and side"
            remedy = "choose another position, or move or delete that stop first"
            raise RoundError(fault, remedy=remedy, number=there.step, position=there.position_m)


def last_step(*walks: Sequence[Stop]) -> int:
    """Return the highest number that a stop has; 0 without any.

    Examples
    --------
    >>> from cucumbervision.capture.frames import Stop
    >>> last_step([Stop(step=2), Stop(step=7)], [Stop()])
    7
    """
    return max((stop.step or 0 for stops in walks for stop in stops), default=0)


def sides_of(stops: Iterable[Stop]) -> list[str]:
    """Return the names of a house's row sides from its stops; otherwise left and right.

    Examples
    --------
    >>> from cucumbervision.capture.frames import Stop
    >>> sides_of([Stop(side="right")]), sides_of([Stop(side="B"), Stop(side="A")])
    (['left', 'right'], ['A', 'B'])
    """
    usual = ["left", "right"]
    sides = sorted({stop.side for stop in stops if stop.side})
    return usual if set(sides) <= set(usual) else sides


DEMONSTRATION = key_of("demonstration")
"""Key of the demonstration's round."""

_NAME = "Demonstration (computer-made example)"


def is_demonstration(round_key: str) -> bool:
    """Return whether a round is the demonstration, which has simulated captures only."""
    return round_key == DEMONSTRATION


def round_for_capture(store: Store, round_key: str, *, simulated: bool, profile: str = "") -> str:
    """Return the round for a capture: the demonstration for simulated ones, else the open round.

    Parameters
    ----------
    store : Store
        Where the rounds are; the demonstration is begun where it is missing, and comes back where
        it was deleted.
    round_key : str
        The round that is open.
    simulated : bool
        Whether the capture is simulated.
    profile : str
        Crop profile of a demonstration that is begun.

    Raises
    ------
    StoreError
        If the demonstration cannot be begun.
    """
    if not simulated:
        return round_key
    if any(round_summary.key == DEMONSTRATION for round_summary in store.rounds(deleted=True)):
        store.restore_round(DEMONSTRATION)
    elif all(round_summary.key != DEMONSTRATION for round_summary in store.rounds()):
        store.save_round(Round(DEMONSTRATION, _NAME, profile=profile))
    return DEMONSTRATION
