"""Add captures to a round: measure each, place it along the row, and save it as a stop."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.frames import Stop
from cucumbervision.errors import RoundError, StoreAwayError
from cucumbervision.run.batch import (
    Engine,
    Item,
    LoopOptions,
    Outcome,
    ResultWorker,
    in_process,
    measure_all,
    never,
)
from cucumbervision.run.inputs import Listed, read_captures
from cucumbervision.run.measurer import Boundary, Failure, Measurer
from cucumbervision_greenhouse.rounds.poses import (
    MIDDLE_SD_M,
    PoseLine,
    placed_stop,
    pose_matrix,
    sign_of_side,
)
from cucumbervision_greenhouse.rounds.stop_records import stop_record
from cucumbervision_greenhouse.rounds.walking import refuse_taken
from cucumbervision_greenhouse.store.records import CaptureRecord, Saved, StopRecord, key_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision.run.measurer import CaptureResult
    from cucumbervision.run.options import MeasureOptions
    from cucumbervision_greenhouse.store.images import ImageStore
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
            **vars(listed),
            round_key=round_key,
            key=key,
            place=placed,
            is_deleted=is_deleted,
            keep=keep,
        )


class _New(ResultWorker):
    """Measures captures that are new in a round."""

    def read(self, item: Item) -> Outcome[CaptureResult] | tuple[Capture, str]:
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
        With the message of the failure.
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


_POSE_COLUMNS = ("height_m", "yaw_deg", "pitch_deg", "roll_deg")


@dataclass(frozen=True)
class Place:
    """Where captures were taken, unless their own files or a pose file give it.

    Parameters
    ----------
    row, side : str, optional
        Row of the house, and side of the row.
    position_m, spacing_m : float, optional
        Of the first capture along the row, and how far each next one is from the last.
    position_sd_m : float
        How sure positions are.
    sign : int, optional
        1 where positions get higher to the right in the picture, else -1; by default as
        `poses.sign_of_side` returns for the side.
    poses : mapping of str to PoseLine
        Poses by the capture's name; they take precedence.
    """

    row: str | None = None
    side: str | None = None
    position_m: float | None = None
    spacing_m: float | None = None
    position_sd_m: float = MIDDLE_SD_M
    sign: int | None = None
    poses: Mapping[str, PoseLine] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Placed:
    """A capture with its place in a house.

    Parameters
    ----------
    capture : Capture
        Its `stop` gives the place.
    position_sd_m : float, optional
        How sure the position is; None without one.
    pose : ndarray of float64, shape (4, 4)
        The camera's.
    """

    capture: Capture
    position_sd_m: float | None
    pose: NDArray[np.float64]

    @classmethod
    def of(cls, capture: Capture, number: int = 0, place: Place | None = None) -> Placed:
        """Place a capture.

        Parameters
        ----------
        capture : Capture
            The frame.
        number : int
            Number of earlier captures, for its position and step if nothing else gives them.
        place : Place, optional
            Where it was taken.

        Raises
        ------
        RoundError
            If a pose file has no line for it.
        """
        place, stop = place or Place(), capture.stop
        line = place.poses.get(capture.name)
        if place.poses and line is None:
            raise RoundError(
                "the pose file has no line for this capture",
                source=capture.name,
                remedy="add one, or leave the pose file out",
            )
        position = stop.position_m
        if place.position_m is not None:
            position = place.position_m + number * (place.spacing_m or 0.0)
        row, side = place.row or stop.row, place.side or stop.side
        step = number + 1 if stop.step is None else stop.step
        sd, turned = place.position_sd_m, {}
        if line is not None:
            row, side, position = line.row or row, line.side or side, line.position_m
            sd = line.position_sd_m
            turned = {name: getattr(line, name) or 0.0 for name in _POSE_COLUMNS}
        sign = sign_of_side(side) if place.sign is None else place.sign
        pose = pose_matrix(position or 0.0, sign, **turned)
        spot = Stop(row, side, position, step)
        return cls(replace(capture, stop=spot), None if position is None else sd, pose)

    def unmeasured(self, round_key: str) -> StopRecord:
        """Return the stop of this capture as far as it is known before it is measured."""
        camera = CameraModel.of(self.capture.intrinsics).model_dump(mode="json")
        captures = (CaptureRecord(self.capture.name, camera=camera),)
        pose = tuple(self.pose.ravel().tolist())
        return StopRecord("", round_key, **asdict(self.capture.stop), pose=pose, captures=captures)

    def stop(
        self, result: CaptureResult, measurer: Measurer, images: ImageStore | None
    ) -> StopRecord:
        """Return the stop of what was measured in it, with the fruit's offsets along the row.

        It has no key and no round yet. Where nothing was measured, it has the failure.

        Raises
        ------
        StoreError
            If a picture cannot be written.
        """
        sd_m = self.position_sd_m
        stop = stop_record("", [result], measurer, key="", position_sd_m=sd_m, images=images)
        pose = tuple(self.pose.round(9).ravel().tolist())
        return replace(placed_stop(stop, self.pose), pose=pose)
