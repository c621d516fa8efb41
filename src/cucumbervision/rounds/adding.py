"""Captures into a round: measured, placed along the row, saved one stop each."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.frames import Stop
from cucumbervision.errors import RoundError
from cucumbervision.pipeline.inputs import read_captures
from cucumbervision.pipeline.measurer import Boundary, Failure, Measurer
from cucumbervision.rounds.poses import (
    MIDDLE_SD_M,
    PoseLine,
    placed_fruit,
    pose_matrix,
    sign_of_side,
)
from cucumbervision.rounds.remeasuring import measure_stop_again
from cucumbervision.rounds.stop_records import holds_still, stop_record
from cucumbervision.rounds.walking import refuse_taken
from cucumbervision.store.records import Saved, key_of
from cucumbervision.store.views import CameraAt

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision.pipeline.measurer import CaptureResult
    from cucumbervision.pipeline.options import MeasureOptions
    from cucumbervision.store.images import ImageStore
    from cucumbervision.store.records import StopRecord
    from cucumbervision.store.repository import Store

Report: TypeAlias = Callable[["Added"], None]


_TURNED = ("height_m", "yaw_deg", "pitch_deg", "roll_deg")


@dataclass(frozen=True)
class Place:
    """Where captures were taken, unless their own files or a pose file say so.

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
        `poses.sign_of_side` says of the side.
    poses : mapping of str to PoseLine
        By the capture's name; what they say comes first.
    """

    row: str | None = None
    side: str | None = None
    position_m: float | None = None
    spacing_m: float | None = None
    position_sd_m: float = MIDDLE_SD_M
    sign: int | None = None
    poses: Mapping[str, PoseLine] = field(default_factory=dict)


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
        How many fruit it shows; 0 where it was there already.
    new : bool
        Whether it was saved now.
    deleted : bool
        Whether it was there already and somebody deleted it: undo that to have it back.
    again : bool
        Whether it was there already, and measured again: from other intrinsics, with another
        calibration or other options.
    failure : Failure, optional
        Why not.
    """

    name: str
    stop_key: str = ""
    fruit: int = 0
    new: bool = False
    deleted: bool = False
    again: bool = False
    failure: Failure | None = None


def add_captures(
    store: Store,
    round_key: str,
    inputs: Sequence[Path],
    options: MeasureOptions,
    place: Place | None = None,
    report: Report | None = None,
) -> list[Added]:
    """Measure captures and save each as a stop of a round.

    A capture that is in the round already is measured again where what it was measured from has
    changed: its intrinsics, the calibration or the options. One that was deleted is not. One that
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

    Raises
    ------
    CucumberVisionError
        If nothing can be measured at all: a network or the calibration cannot be loaded.
    """
    place = place or Place()
    measurer = Measurer(options)
    done = []
    for number, read in enumerate(read_captures(inputs, options.reading)):
        if isinstance(read, Failure):
            added = Added(read.capture or read.input, failure=read)
        else:
            added = Added(read.name, key_of(round_key, read.name, capture_sha256(read)))
            deleted = store.stop_is_deleted(added.stop_key)
            added = replace(added, deleted=bool(deleted))
            failures: list[Failure] = []
            if deleted is None:
                measurer.load()
                with Boundary(failures, read.source, read.name):
                    refuse_taken(store, round_key, *spot_and_camera(read, number, place))
                    result, stop = measured_stop(read, number, place, measurer, store.images)
                    failures += () if result.error is None else result.failures
                    if not failures:
                        stop = replace(stop, key=added.stop_key, round_key=round_key)
                        new = store.save_stop(stop) is Saved.NEW
                        added = replace(added, fruit=len(result.fruit) if new else 0, new=new)
            elif not deleted:
                with Boundary(failures, read.source, read.name):
                    fruit = measured_otherwise(store, added.stop_key, read, measurer)
                    added = replace(added, fruit=fruit or 0, again=fruit is not None)
            if failures:
                added = Added(read.name, failure=failures[0])
        done.append(added)
        if report is not None:
            report(added)
    return done


def measured_otherwise(
    store: Store, stop_key: str, capture: Capture, measurer: Measurer
) -> int | None:
    """Measure a stop again where what it was measured from has changed; its place stays.

    Returns
    -------
    int or None
        How many fruit it shows; None where nothing has changed, and nothing was measured.

    Raises
    ------
    CucumberVisionError
        If it cannot be measured; the stop is then as it was.
    """
    if holds_still(store.stop(stop_key).artifacts, capture, measurer):
        return None
    return measure_stop_again(store, stop_key, [capture], measurer)


def capture_sha256(capture: Capture) -> str:
    """Return the SHA-256 of a capture's colour and depth, hexadecimal."""
    digest = hashlib.sha256(np.ascontiguousarray(capture.color).tobytes())
    digest.update(np.ascontiguousarray(capture.depth_m).tobytes())
    return digest.hexdigest()


def measured_stop(
    capture: Capture, number: int, place: Place, measurer: Measurer, images: ImageStore | None
) -> tuple[CaptureResult, StopRecord]:
    """Measure a capture as a stop of a round.

    Parameters
    ----------
    capture : Capture
        The frame.
    number : int
        How many came before it, for its position and step where nothing else says them.
    place : Place
        Where it was taken.
    measurer : Measurer
        What measures.
    images : ImageStore, optional
        Takes the pictures.

    Returns
    -------
    result : CaptureResult
        Its `error` says why nothing was measured.
    stop : StopRecord
        With the fruit's offsets along the row; the failure where nothing was measured. It has no
        key and no round yet.

    Raises
    ------
    RoundError
        If a pose file has no line for it.
    StoreError
        If a picture cannot be written.
    """
    spot, sd_m, pose = _spot(capture, number, place)
    result = measurer.attempt(replace(capture, stop=spot))
    stop = stop_record("", [result], measurer, key="", position_sd_m=sd_m, images=images)
    captures = tuple(
        replace(one, fruit=tuple(placed_fruit(fruit, pose) for fruit in one.fruit))
        for one in stop.captures
    )
    return result, replace(stop, captures=captures, pose=tuple(pose.round(9).ravel().tolist()))


def spot_and_camera(capture: Capture, number: int, place: Place) -> tuple[Stop, CameraAt]:
    """Return where a capture was taken and by what, as its stop will say."""
    spot, _, pose = _spot(capture, number, place)
    camera = CameraModel.of(capture.intrinsics).model_dump(mode="json")
    return spot, CameraAt(pose.ravel().tolist(), {}, camera)


def _spot(
    capture: Capture, number: int, place: Place
) -> tuple[Stop, float | None, NDArray[np.float64]]:
    """Return row, side, position and step; how sure the position is; and the camera's pose."""
    own, line = capture.stop, place.poses.get(capture.name)
    if place.poses and line is None:
        raise RoundError(
            "the pose file has no line for this capture",
            source=capture.name,
            remedy="add one, or leave the pose file out",
        )
    position = own.position_m
    if place.position_m is not None:
        position = place.position_m + number * (place.spacing_m or 0.0)
    row, side = place.row or own.row, place.side or own.side
    step = number + 1 if own.step is None else own.step
    sd, turned = place.position_sd_m, {}
    if line is not None:
        row, side, position = line.row or row, line.side or side, line.position_m
        sd = line.position_sd_m
        turned = {name: getattr(line, name) or 0.0 for name in _TURNED}
    sign = sign_of_side(side) if place.sign is None else place.sign
    pose = pose_matrix(position or 0.0, sign, **turned)
    return Stop(row, side, position, step), None if position is None else sd, pose
