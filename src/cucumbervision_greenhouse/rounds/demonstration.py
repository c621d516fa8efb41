"""The demonstration's round, which has simulated captures only."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cucumbervision_greenhouse.store.records import Round, key_of

if TYPE_CHECKING:
    from cucumbervision_greenhouse.store.repository import Store


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
