"""Add captures to a round: measure each, place it along the row, and save it as a stop."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from cucumbervision.errors import StoreAwayError
from cucumbervision.run.batch import (
    Engine,
    Item,
    LoopOptions,
    Outcome,
    ReadCapture,
    ResultWorker,
    in_process,
    measure_all,
    never,
)
from cucumbervision.run.inputs import Listed, read_captures
from cucumbervision.run.measurer import Boundary, Failure, Measurer
from cucumbervision_greenhouse.rounds.placing import Place, Placed
from cucumbervision_greenhouse.rounds.walking import refuse_taken
from cucumbervision_greenhouse.store.records import Saved, key_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from cucumbervision.capture.frames import Capture
    from cucumbervision.run.measurer import CaptureResult
    from cucumbervision.run.options import MeasureOptions
    from cucumbervision_greenhouse.store.repository import Store


Report: TypeAlias = Callable[["Added"], None]


@dataclass(frozen=True)
class Added:
    """The outcome of one capture.

    Parameters
    ----------
    name : str
        The capture, or the input that could not be read.
    stop_key : str
        Its stop; empty where there is none.
    fruit : int
        Number of fruit in it; 0 if it was saved before.
    new : bool
        Whether it was saved by this call.
    deleted : bool
        Whether it was saved before and deleted; undo the deletion to restore it.
    failure : Failure, optional
        Why not.
    note : str
        Why nothing was measured in a capture that was saved nevertheless.
    """

    name: str
    stop_key: str = ""
    fruit: int = 0
    new: bool = False
    deleted: bool = False
    failure: Failure | None = None
    note: str = ""


@dataclass(frozen=True, eq=False)
class RoundCapture(Listed):
    """A capture on its way into a round.

    Parameters
    ----------
    input, ref, name
        As in `Listed`.
    round_key, key : str
        The round, saved before, and the stop that it is or will be.
    place : Placed, optional
        Where a new one was taken.
    is_deleted : bool, optional
        Whether its stop was deleted; None if the round has no such stop.
    keep : bool
        Save it though nothing can be measured in it, or another stop is at its place.
    """

    round_key: str = ""
    key: str = ""
    place: Placed | None = None
    is_deleted: bool | None = None
    keep: bool = False

    @classmethod
    def to_add(
        cls,
        store: Store,
        round_key: str,
        capture: Capture,
        *,
        key: str = "",
        number: int = 0,
        place: Place | None = None,
        keep: bool = False,
    ) -> RoundCapture:
        """Return a capture with its state in the round.

        Parameters
        ----------
        store, round_key, key, keep
            As above; by default the key is one of the capture's content.
        capture : Capture
            The frame.
        number, place
            As for `Placed.of`.

        Raises
        ------
        CucumberVisionError
            If the store cannot be read, or a pose file has no line for the capture.
        """
        key = key or key_of(round_key, capture.name, capture_sha256(capture))
        is_deleted = store.stop_is_deleted(key)
        placed = Placed.of(capture, number, place) if is_deleted is None else None
        listed = Listed.of(capture if placed is None else placed.capture)
        return cls(
            input=listed.input,
            ref=listed.ref,
            name=listed.name,
            round_key=round_key,
            key=key,
            place=placed,
            is_deleted=is_deleted,
            keep=keep,
        )


class _New(ResultWorker):
    """Measures captures that are new in a round."""

    def read(self, item: Item) -> Outcome[CaptureResult] | ReadCapture:
        """Read a capture, unless the round has it, deleted or not."""
        if isinstance(item, RoundCapture) and item.place is None:
            return Outcome()
        return super().read(item)


def add_captures(
    store: Store,
    round_key: str,
    inputs: Sequence[Path],
    options: MeasureOptions,
    place: Place | None = None,
    report: Report | None = None,
    loop: LoopOptions | None = None,
) -> list[Added]:
    """Measure captures and save each as a stop of a round.

    A capture that the round has already, or that was deleted from it, stays as it is. One that
    cannot be read or measured, or lies where the same camera took another, is noted, and the others
    go on.

    Parameters
    ----------
    store : Store
        Where to.
    round_key : str
        The round, saved before.
    inputs : sequence of Path
        Folders and files that `open_source` knows.
    options : MeasureOptions
        How to measure.
    place : Place, optional
        Where they were taken.
    report : callable, optional
        Called after each capture; for progress bars.
    loop : LoopOptions, optional
        Options of the loop.

    Returns
    -------
    list of Added
        One a capture, in order; none for those before which the loop was stopped.

    Raises
    ------
    CucumberVisionError
        If nothing can be measured at all: a network or the calibration cannot be loaded.
    """
    measurer, done, loop = Measurer(options), list[Added](), loop or LoopOptions()

    def items() -> Iterator[RoundCapture | Failure]:
        for number, read in enumerate(read_captures(inputs, options.reading, loop.opener)):
            if isinstance(read, Failure):
                yield read
                continue
            failures: list[Failure] = []
            with Boundary(failures, read.source, read.name):
                yield RoundCapture.to_add(store, round_key, read, number=number, place=place)
            yield from failures

    for _, added in add_all(store, items(), measurer, loop.engine, loop.is_cancelled):
        done.append(added)
        if report is not None:
            report(added)
    return done


def add_all(
    store: Store,
    items: Iterable[RoundCapture | Failure],
    measurer: Measurer,
    engine: Engine = in_process,
    is_cancelled: Callable[[], bool] = never,
) -> Iterator[tuple[RoundCapture | Failure, Added]]:
    """Measure captures, save each as a stop, and yield it with its outcome, in order.

    Parameters
    ----------
    store : Store
        Where to.
    items : iterable of RoundCapture or Failure
        The captures; a failure among them is passed on in its turn.
    measurer : Measurer
        What measures.
    engine, is_cancelled
        As for `measure_all`; none is yielded for those before which the loop was stopped.

    Raises
    ------
    CucumberVisionError
        As `measure_all`.
    """
    for item, outcome in measure_all(items, _New(measurer), engine, is_cancelled):
        failures = list(outcome.failures) if outcome.value is None else []
        added = None
        if isinstance(item, RoundCapture) and not failures:
            with Boundary(failures, item.input, item.name):
                added = _added(store, item, outcome.value, measurer)
        if failures:
            added = Added(failures[0].capture or failures[0].input, failure=failures[0])
        if added is not None:  # None: stopped before its turn
            yield item, added


def require_store(added: Added) -> None:
    """Stop where the store was not there, which is no fault of the capture: it is kept for later.

    Raises
    ------
    StoreAwayError
        As it was said.
    """
    if added.failure is not None and added.failure.error == StoreAwayError.__name__:
        raise StoreAwayError(added.failure.message)


def _added(
    store: Store, item: RoundCapture, result: CaptureResult | None, measurer: Measurer
) -> Added | None:
    """Save the result of a capture, and return the outcome; None if it was not measured.

    Raises
    ------
    CucumberVisionError
        If nothing was measured, its place is taken, or it cannot be saved.
    """
    added = Added(item.name, item.key, deleted=bool(item.is_deleted))
    if item.place is None or result is None:
        return added if item.place is None else None
    if result.error is not None and not item.keep:
        raise result.error
    if store.stop_is_deleted(item.key) is not None:  # the same capture given twice
        return added
    if not item.keep:
        refuse_taken(store, item.place.unmeasured(item.round_key))
    stop = item.place.stop(result, measurer, store.images)
    new = store.save_stop(replace(stop, key=item.key, round_key=item.round_key)) is Saved.NEW
    note = "" if result.error is None else result.error.message
    return replace(added, fruit=len(result.fruit) if new else 0, new=new, note=note)


def capture_sha256(capture: Capture) -> str:
    """Return the SHA-256 of a capture's colour and depth, hexadecimal."""
    digest = hashlib.sha256(np.ascontiguousarray(capture.color).tobytes())
    digest.update(np.ascontiguousarray(capture.depth_m).tobytes())
    return digest.hexdigest()
