"""Uploads into a round: each capture at its place, and the outcome of each file."""

from __future__ import annotations

import itertools
import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.intrinsics import Intrinsics, Stream
from cucumbervision.capture.pictures import COLOR_SUFFIXES, read_color
from cucumbervision.errors import (
    CucumberVisionError,
    DiskFullError,
    IntrinsicsError,
    Message,
    StoreAwayError,
    UploadError,
)
from cucumbervision.intake.uploads import Limits, accept_uploads
from cucumbervision.pipeline.batch import in_turn
from cucumbervision_greenhouse.backend.uploads import MOST_TRIES, UploadOutcome
from cucumbervision_greenhouse.rounds.adding import Added, RoundCapture, add_all, require_store
from cucumbervision_greenhouse.rounds.demonstration import round_for_capture
from cucumbervision_greenhouse.rounds.walking import last_step, refuse_taken

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from cucumbervision.capture.frames import Capture
    from cucumbervision.capture.source import CaptureSource, ReadOptions
    from cucumbervision.intake.uploads import AcceptedSource
    from cucumbervision.pipeline.options import MeasureOptions
    from cucumbervision_greenhouse.backend.measuring import SharedMeasurer
    from cucumbervision_greenhouse.backend.uploads import Sending, Uploads
    from cucumbervision_greenhouse.rounds.walking import NextPlace
    from cucumbervision_greenhouse.store.repository import Store

    _Opened: TypeAlias = tuple[AcceptedSource, CaptureSource]

# Focal length divided by the picture's shorter side, which is the sensor's height, also where the
# camera was mounted upright and its pictures were turned: nominal values of colour cameras.
CAMERAS = {"RealSense D435 / D435i": 1.283, "RealSense D415": 1.285, "RealSense D455": 0.894}


def _usual_intrinsics(camera: str, width: int, height: int) -> Intrinsics:
    """Return a camera's nominal intrinsics at a picture's size; units differ by 1 to 2 %.

    Examples
    --------
    >>> round(_usual_intrinsics("RealSense D435 / D435i", 1280, 720).fx_px)
    924
    >>> round(_usual_intrinsics("RealSense D435 / D435i", 720, 1280).fx_px)
    924
    """
    focal_px = CAMERAS[camera] * min(width, height)
    middle = (width - 1) / 2, (height - 1) / 2
    return Intrinsics(width, height, focal_px, focal_px, *middle, Stream.COLOR)


def measure_upload(
    uploads: Uploads,
    key: str,
    measurer: SharedMeasurer,
    store: Store,
    options: MeasureOptions,
) -> None:
    """Check an upload and save its captures as stops of its round; a bad one affects no other.

    Each outcome is saved at once, with the number of captures and of finished ones: refused files
    first, then the captures in order. Simulated captures go into the demonstration instead.

    Parameters
    ----------
    uploads : Uploads
        Where it is.
    key : str
        Which one.

    Notes
    -----
    If a network or the calibration cannot be loaded, the disk is full, or the store is
    away, that is the outcome of all files, and the upload is measured later.
    """
    files, outcomes = uploads.files(key), list[UploadOutcome]()
    measures = measurer.with_options(options)

    def note(*new: UploadOutcome, done: bool = False, **counts: int) -> None:
        outcomes.extend(new)
        uploads.note(key, outcomes, done=done, **counts)

    try:
        measures.load()
    except CucumberVisionError as error:
        note(*(_failed(name, error.line) for name, _ in files))
        return
    upload = uploads.try_once(key)
    sending = upload.sending
    if upload.tries >= MOST_TRIES:
        words = Message("ended the program each time it was measured")
        note(*(_failed(name, words) for name, _ in files), done=True)
        return
    limits = replace(Limits(), file_bytes=max(sending.size, 1), total_bytes=max(sending.size, 1))
    measured = itertools.count(1)

    def items(sources: Iterable[_Opened]) -> Iterator[RoundCapture]:
        for item in _round_captures(sources, sending, store):
            if isinstance(item, RoundCapture):
                yield item
            else:
                note(item, measured=next(measured))

    try:
        with tempfile.TemporaryDirectory(prefix="cucumbervision-", dir=uploads.folder) as folder:
            accepted = accept_uploads(files, Path(folder), limits)
            opened = [_open(source, options.reading, sending.camera) for source in accepted.sources]
            readable = [source for source in opened if not isinstance(source, UploadOutcome)]
            note(
                *(_failed(str(refusal.source), refusal.message) for refusal in accepted.refused),
                *(outcome for outcome in opened if isinstance(outcome, UploadOutcome)),
                captures=sum(source.total or 0 for _, source in readable),
            )
            for item, added in add_all(store, items(readable), measures, in_turn):
                require_store(added)
                if isinstance(item, RoundCapture):
                    note(_outcome(item, added, sending.round), measured=next(measured))
    except (DiskFullError, StoreAwayError) as error:  # measured later, and no reason to give it up
        note(*(_failed(name, error.message) for name, _ in files), tries=upload.tries)
    except UploadError as error:
        note(*(_failed(name, error.message) for name, _ in files), done=True)
    else:
        note(done=True)


def _round_captures(
    sources: Iterable[_Opened], sending: Sending, store: Store
) -> Iterator[RoundCapture | UploadOutcome]:
    """Yield the captures of an upload at their places, and why a part of it is none."""
    place = sending.place.next_place
    for capture in itertools.chain.from_iterable(map(_captures, sources)):
        if isinstance(capture, UploadOutcome):
            yield capture
            continue
        placed, place = _placed(capture, place)
        try:
            yield _to_add(placed, store, sending.round)
        except CucumberVisionError as error:
            yield _failed(placed.source or placed.name, error.message)


def _failed(name: str, words: str) -> UploadOutcome:
    return UploadOutcome(name=name, saved=False, words=Message(words))


def _open(source: AcceptedSource, reading: ReadOptions, camera: str) -> _Opened | UploadOutcome:
    """Return a source with its captures, or the reason why it has none, by the sender's names."""
    try:
        return source, _open_with(source, reading, camera)
    except CucumberVisionError as error:
        return _failed(str(error.source or source.title), error.at(None).line)


def _captures(opened: _Opened) -> Iterator[Capture | UploadOutcome]:
    """Yield a source's captures, and the faults of its unreadable parts."""
    source, refs = opened[0], iter(opened[1])
    while True:
        try:
            ref = next(refs, None)
            if ref is None:
                return
            yield ref.load()
        except CucumberVisionError as error:
            yield _failed(str(error.source or source.title), error.message)


def _open_with(source: AcceptedSource, reading: ReadOptions, camera: str) -> CaptureSource:
    """Open a source; pictures without intrinsics get the camera's nominal ones."""
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
    """Return a capture with its place, preferably its own, and the place of the next one."""
    stop = capture.stop
    if stop.position_m is None:
        stop, place = replace(stop, position_m=place.position_m), place.onward()
    stop = replace(stop, row=stop.row or place.row or None, side=stop.side or place.side)
    return replace(capture, stop=stop), place


def _to_add(capture: Capture, store: Store, round_key: str) -> RoundCapture:
    """Return a capture on its way into the round, or into the demonstration if it is simulated.

    Raises
    ------
    CucumberVisionError
        If the same camera took another at its place, or the store cannot be read.
    """
    home = round_for_capture(store, round_key, simulated=capture.simulated)
    if capture.stop.step is None:
        step = last_step(store.stops(home)) + 1
        capture = replace(capture, stop=replace(capture.stop, step=step))
    item = RoundCapture.to_add(store, home, capture, keep=True)
    if item.place is not None:
        refuse_taken(store, home, *item.place.spot_and_camera)
    return item


def _outcome(item: RoundCapture, added: Added, round_key: str) -> UploadOutcome:
    """Return the outcome of a capture for its sender; one sent again was saved before."""
    if added.failure is not None:
        return _failed(item.input, added.failure.message)
    if added.deleted:
        return _failed(item.input, Message("was deleted: undo that to have it back"))
    if item.place is None or not added.new:
        return _failed(item.input, Message("is in the round already"))
    stop = item.place.capture.stop
    template = "{words} (row {row}, {side}, {position:.2f} m)"
    if item.round_key != round_key:
        template = (
            "{words} (row {row}, {side}, {position:.2f} m; computer-made, so in the round "
            "'Demonstration')"
        )
    words = Message(
        template,
        words=Message(added.note) if added.note else Message("{n} fruit", n=added.fruit),
        row=stop.row or "?",
        side=Message(stop.side or ""),
        position=stop.position_m or 0.0,
    )
    return UploadOutcome(name=item.input, saved=True, words=words)
