"""Uploads into a round: each capture at its place, and the outcome of each file."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.intrinsics import Intrinsics, Stream
from cucumbervision.capture.pictures import COLOR_SUFFIXES, read_color
from cucumbervision.dashboard.uploads import MOST_TRIES, UploadOutcome
from cucumbervision.errors import CucumberVisionError, IntrinsicsError, UploadError
from cucumbervision.intake.limits import Limits
from cucumbervision.intake.uploads import accept_uploads
from cucumbervision.rounds.adding import (
    Placed,
    capture_sha256,
    measured_otherwise,
    round_for_capture,
)
from cucumbervision.rounds.walking import last_step, refuse_taken
from cucumbervision.store.records import key_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from cucumbervision.capture.frames import Capture
    from cucumbervision.capture.source import CaptureRef, CaptureSource, ReadOptions
    from cucumbervision.dashboard.jobs import Job
    from cucumbervision.dashboard.measuring import SharedMeasurer
    from cucumbervision.dashboard.uploads import Uploads
    from cucumbervision.intake.uploads import AcceptedSource
    from cucumbervision.pipeline.options import MeasureOptions
    from cucumbervision.rounds.walking import NextPlace
    from cucumbervision.store.repository import Store

# Focal length over the picture's height, of colour cameras as their makers give them.
CAMERAS = {"RealSense D435 / D435i": 1.283, "RealSense D415": 1.285, "RealSense D455": 0.894}


def _usual_intrinsics(camera: str, width: int, height: int) -> Intrinsics:
    """Return a camera's usual intrinsics at a picture's size; each single one differs by 1 to 2 %.

    Examples
    --------
    >>> round(_usual_intrinsics("RealSense D435 / D435i", 1280, 720).fx_px)
    924
    """
    focal_px = CAMERAS[camera] * height
    middle = (width - 1) / 2, (height - 1) / 2
    return Intrinsics(width, height, focal_px, focal_px, *middle, Stream.COLOR)


def measure_upload(
    uploads: Uploads,
    key: str,
    measurer: SharedMeasurer,
    store: Store,
    options: MeasureOptions,
    job: Job,
) -> None:
    """Check an upload and save its captures as stops of its round; a bad one costs only itself.

    Each outcome is kept as it comes: refused files first, then as the files were sorted into
    captures. Simulated captures go into the demonstration instead.

    Parameters
    ----------
    uploads : Uploads
        Where it is.
    key : str
        Which one.
    job : Job
        Gets a step a file that is checked, and a step a capture that is measured.
    """
    upload = uploads.try_once(key)
    sending, outcomes = upload.sending, list[UploadOutcome]()
    if upload.tries >= MOST_TRIES:
        words = "ended the program each time it was measured"
        outcomes = [UploadOutcome(name=one.name, saved=False, words=words) for one in sending.files]
        uploads.note(key, outcomes, done=True)
        return
    files, place = uploads.files(key), sending.place.next_place
    limits = replace(Limits(), file_bytes=max(sending.size, 1), total_bytes=max(sending.size, 1))
    job.total = len(files)
    with tempfile.TemporaryDirectory(prefix="cucumbervision-", dir=uploads.folder) as folder:
        try:
            accepted = accept_uploads(files, Path(folder), limits, report=lambda *_: job.step())
        except UploadError as error:
            outcomes = [_failed(one.name, error.message) for one in sending.files]
            uploads.note(key, outcomes, done=True)
            return
        outcomes += [_failed(str(one.source), one.message) for one in accepted.refused]
        for source in accepted.sources:
            for read in _captures(source, options.reading, sending.camera):
                job.total = max(job.total, job.done + 1)
                if isinstance(read, UploadOutcome):
                    outcomes.append(read)
                else:
                    read, place = _placed(read, place)
                    outcomes.append(_saved(read, measurer, store, sending.round, options))
                job.step()
                uploads.note(key, outcomes)
    uploads.note(key, outcomes, done=True)


def _failed(name: str, words: str) -> UploadOutcome:
    return UploadOutcome(name=name, saved=False, words=words)


def _captures(
    source: AcceptedSource, reading: ReadOptions, camera: str
) -> Iterator[Capture | UploadOutcome]:
    """Yield a source's captures, and why a part of it is none, by the sender's names."""
    try:
        refs: Iterator[CaptureRef] = iter(_open(source, reading, camera))
    except CucumberVisionError as error:
        yield _failed(str(error.source or source.title), f"{error.message}; {error.remedy}")
        return
    while True:
        try:
            ref = next(refs, None)
            if ref is None:
                return
            yield ref.load()
        except CucumberVisionError as error:
            yield _failed(str(error.source or source.title), error.message)


def _open(source: AcceptedSource, reading: ReadOptions, camera: str) -> CaptureSource:
    """Open a source with the camera's usual intrinsics where pictures bring none."""
    try:
        return source.open(reading)
    except IntrinsicsError:
        pictures = sorted(p for p in source.path.rglob("*") if p.suffix.lower() in COLOR_SUFFIXES)
        if not camera or reading.intrinsics or not pictures:
            raise
    height, width = read_color(pictures[0]).shape[:2]
    model = CameraModel.of(_usual_intrinsics(camera, width, height)).model_dump(mode="json")
    path = source.path.with_name(f"{source.path.name}-camera.json")
    path.write_text(json.dumps(model), encoding="utf-8")
    return source.open(replace(reading, intrinsics=path))


def _placed(capture: Capture, place: NextPlace) -> tuple[Capture, NextPlace]:
    """Return a capture with its place, its own first, and where the next one is."""
    own = capture.stop
    if own.position_m is None:
        own, place = replace(own, position_m=place.position_m), place.onward()
    own = replace(own, row=own.row or place.row or None, side=own.side or place.side)
    return replace(capture, stop=own), place


def _saved(
    capture: Capture,
    measurer: SharedMeasurer,
    store: Store,
    round_key: str,
    options: MeasureOptions,
) -> UploadOutcome:
    """Measure and save a capture; the same one sent again is there already."""
    name = capture.source or capture.name
    try:
        home = round_for_capture(store, round_key, simulated=capture.simulated)
        stop = capture.stop
        if stop.step is None:
            stop = replace(stop, step=last_step(store.stops(home)) + 1)
        key = key_of(home, capture.name, capture_sha256(capture))
        deleted = store.stop_is_deleted(key)
        if deleted:
            return _failed(name, "was deleted: undo that to have it back")
        if deleted is not None:
            fruit = measured_otherwise(store, key, capture, measurer.with_options(options))
            again = "was there already, and is measured again: its intrinsics or options changed"
            words = "is in the round already" if fruit is None else again
            return UploadOutcome(name=name, saved=fruit is not None, words=words)
        capture = replace(capture, stop=stop)
        refuse_taken(store, home, *Placed.of(capture).spot_and_camera)
        taken = measurer.take_stop(store, home, capture, options, key=key)
    except CucumberVisionError as error:
        return _failed(name, error.message)
    many = len(taken.result.fruit)
    at = f"row {stop.row or '?'}, {stop.side}, {stop.position_m:.2f} m"
    moved = "; computer-made, so in the round 'Demonstration'" if home != round_key else ""
    words = taken.note or f"{many} fruit"
    return UploadOutcome(name=name, saved=True, words=f"{words} ({at}{moved})")
