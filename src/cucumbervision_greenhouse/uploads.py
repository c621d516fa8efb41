"""Uploads: files arrive in parts, and their captures wait to be measured like others."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PlainSerializer, PlainValidator

from cucumbervision import errors
from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.frames import LONGEST_ROW_M, Capture, Stop
from cucumbervision.capture.intrinsics import Intrinsics, Stream
from cucumbervision.capture.pictures import COLOR_SUFFIXES, read_color
from cucumbervision.capture.source import CaptureSource, ReadOptions, fail
from cucumbervision.capture.uploads import AcceptedSource, AcceptedUploads, Limits, accept_uploads
from cucumbervision.names import LONGEST_NAME
from cucumbervision_greenhouse.rounds import walking
from cucumbervision_greenhouse.rounds.adding import RoundCapture
from cucumbervision_greenhouse.settings import replace_text
from cucumbervision_greenhouse.store.records import key_of
from cucumbervision_greenhouse.store.repository import Store
from cucumbervision_greenhouse.store.waiting import WaitingCaptures

MOST_FILES = 1000
_ABOUT = "upload.json"
_KEPT = 20  # number of uploads whose outcomes are kept
_RESERVE_BYTES = 500_000_000  # disk space that is left for new captures

# Focal length divided by the image's shorter side, which is the sensor's height, also where the
# camera was mounted upright and its images were turned: nominal values of colour cameras.
CAMERAS = {"RealSense D435 / D435i": 1.283, "RealSense D415": 1.285, "RealSense D455": 0.894}


def _checked(place: walking.NextPlace) -> walking.NextPlace:
    """Refuse a place that no stop can have, before files are sent."""
    Stop(place.row or None, place.side, place.position_m)
    lengths = place.position_m, place.step_m
    if not all(0 <= length <= LONGEST_ROW_M for length in lengths):  # NaN is refused, too
        raise ValueError(place)
    return place


class _Frozen(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SentFile(_Frozen):
    """A file as announced: its name with its folders, its size in bytes, its last change."""

    name: Annotated[str, Field(max_length=500)]
    size: Annotated[int, Field(ge=0)]
    changed: Annotated[float, Field(allow_inf_nan=False)] = 0.0


class UploadOutcome(_Frozen):
    """The outcome of a file, or of a capture in it: by its sender's name, with place or reason."""

    name: str
    saved: bool
    words: Annotated[
        str, PlainValidator(errors.Message.from_json), PlainSerializer(errors.Message.as_json)
    ]


class Sending(_Frozen):
    """An upload as a browser announces it."""

    round: Annotated[str, Field(pattern=r"^[0-9a-f-]{36}$")]
    files: Annotated[tuple[SentFile, ...], Field(min_length=1, max_length=MOST_FILES)]
    place: Annotated[walking.NextPlace, AfterValidator(_checked)] = walking.NextPlace("")
    camera: Annotated[str, Field(max_length=LONGEST_NAME)] = ""

    @property
    def key(self) -> str:
        """Key of the upload: the same for the same files and round."""
        parts = (f"{file.name}/{file.size}/{file.changed}" for file in self.files)
        return key_of("upload", self.round, *parts)

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return sum(file.size for file in self.files)


class Upload(_Frozen):
    """An upload: what was announced and when, seconds since 1970, and what became of it.

    Once it is `done` its files are gone.
    """

    sending: Sending
    begun_s: float
    done: bool = False
    outcomes: tuple[UploadOutcome, ...] = ()


class Uploads:
    """A folder of uploads, created with the first.

    Parameters
    ----------
    folder : Path
        The folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._lock = threading.Lock()

    def begin(self, sending: Sending, limit_bytes: int) -> list[int]:
        """Begin or resume an upload; return how many bytes of each file have arrived.

        Raises
        ------
        UploadError
            If it is larger than the limit, or than the disk has room for; nothing is kept.
        """
        if sending.size > limit_bytes:
            raise errors.UploadError(
                "{size:.0f} MB are more than the {limit:.0f} MB that are taken",
                remedy="send it in smaller parts, or change the limit in 'Settings'",
                size=sending.size / 1e6,
                limit=limit_bytes / 1e6,
            )
        with self._lock:
            upload = self.read(sending.key)
            if upload is None or upload.done:
                self.folder.mkdir(parents=True, exist_ok=True)
                free = shutil.disk_usage(self.folder).free - _RESERVE_BYTES
                if sending.size > free:
                    fault, size = "the disk has room for {size:.0f} MB", max(free, 0) / 1e6
                    raise errors.UploadError(fault, remedy="free some space on the disk", size=size)
                shutil.rmtree(self.folder / sending.key, ignore_errors=True)
                self._write(Upload(sending=sending, begun_s=time.time()))
        return self.received(sending.key)

    def received(self, key: str) -> list[int]:
        """Return how many bytes of each file have arrived.

        Raises
        ------
        UploadError
            If there is no such upload.
        """
        paths = [self._part(key, number) for number in range(len(self._known(key).files))]
        return [path.stat().st_size if path.exists() else 0 for path in paths]

    def append(self, key: str, number: int, offset: int, data: bytes) -> int:
        """Append a part to a file unless it has arrived before; return the file's size.

        Raises
        ------
        UploadError
            If there is no such file, or it would be larger than it was announced.
        """
        files, remedy = self._known(key).files, "choose the files again"
        if not 0 <= number < len(files):
            raise errors.UploadError("there is no such file", remedy=remedy)
        with self._lock, self._part(key, number).open("ab") as stream:
            received = stream.tell()
            if received != offset:  # a part that is sent again
                return received
            if received + len(data) > files[number].size:
                fault = "is larger than it was"
                raise errors.UploadError(fault, source=files[number].name, remedy=remedy)
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
            return stream.tell()

    def is_whole(self, key: str) -> bool:
        """Return whether every file has arrived."""
        return self.received(key) == [file.size for file in self._known(key).files]

    def whole(self) -> list[str]:
        """Return the complete uploads whose captures do not wait yet, the oldest first."""
        keys = [upload.sending.key for upload in reversed(self.all()) if not upload.done]
        return [key for key in keys if self.is_whole(key)]

    def all(self, round_key: str | None = None) -> list[Upload]:
        """Return the uploads, or those into a round, the newest first."""
        uploads = [self.read(path.parent.name) for path in self.folder.glob(f"*/{_ABOUT}")]
        asked = [x for x in uploads if x and round_key in (None, x.sending.round)]
        return sorted(asked, key=lambda upload: upload.begun_s, reverse=True)

    def read(self, key: str) -> Upload | None:
        """Return an upload; None if there is none of that key."""
        try:
            text = (self.folder / key / _ABOUT).read_text(encoding="utf-8")
            return Upload.model_validate_json(text)
        except (OSError, ValueError):  # a ValidationError is a ValueError
            return None

    def queue(self, key: str, waiting: WaitingCaptures, store: Store, reading: ReadOptions) -> None:
        """Check a complete upload, and let its captures wait to be measured.

        A bad file affects no other. Simulated captures go into the demonstration instead of the
        upload's round.

        Raises
        ------
        UploadError, DiskFullError, StoreAwayError
            If nothing can be kept now; the files stay, and what waits already is not queued twice.
        """
        sending, outcomes = self._known(key), list[UploadOutcome]()
        paths = [self._part(key, number) for number in range(len(sending.files))]
        for path in paths:
            path.touch()  # an empty file has no parts
        files = [(file.name, path) for file, path in zip(sending.files, paths, strict=True)]
        # Of the files themselves no more arrives than was announced.
        limits = Limits(files=MOST_FILES, total_bytes=max(sending.size, Limits().total_bytes))
        walk = sending.place
        with tempfile.TemporaryDirectory(dir=self.folder) as folder:
            accepted = accept_uploads(files, Path(folder), limits)
            for name, load in _captures(accepted, sending.camera, reading):
                try:
                    capture = load()
                    stop, name = capture.stop, capture.source or capture.name
                    if stop.position_m is None:
                        stop, walk = replace(stop, position_m=walk.position_m), walk.onward()
                    row, side = stop.row or walk.row or None, stop.side or walk.side
                    capture = replace(capture, stop=replace(stop, row=row, side=side))
                    words = _kept(capture, sending.round, waiting, store)
                    outcomes.append(UploadOutcome(name=name, saved=True, words=words))
                except (errors.DiskFullError, errors.StoreAwayError):
                    raise
                except errors.CucumberVisionError as error:
                    name, words = str(error.source or name), errors.Message(error.at(None).line)
                    outcomes.append(UploadOutcome(name=name, saved=False, words=words))
        with self._lock:
            upload = self.read(key)
            if upload is not None:
                done = {"outcomes": tuple(outcomes), "done": True}
                self._write(upload.model_copy(update=done))
            for path in paths:
                path.unlink(missing_ok=True)
            for old in self.all()[_KEPT:]:
                shutil.rmtree(self.folder / old.sending.key, ignore_errors=True)

    def _known(self, key: str) -> Sending:
        upload = self.read(key)
        if upload is None:
            raise errors.UploadError("this upload is gone", remedy="choose the files again")
        return upload.sending

    def _part(self, key: str, number: int) -> Path:
        return self.folder / key / f"{number:04d}"

    def _write(self, upload: Upload) -> None:
        replace_text(self.folder / upload.sending.key / _ABOUT, upload.model_dump_json())


def _captures(
    accepted: AcceptedUploads, camera: str, reading: ReadOptions
) -> Iterator[tuple[str, Callable[[], Capture]]]:
    """Yield what loads each capture, or raises why there is none, with its sender's name."""
    for refusal in accepted.refused:
        yield str(refusal.source), partial(fail, refusal)
    for source in accepted.sources:
        try:
            refs = list(_opened(source, reading, camera))
        except errors.CucumberVisionError as error:
            yield source.title, partial(fail, error)
        else:
            yield from ((source.title, ref.load) for ref in refs)


def _kept(
    capture: Capture, round_key: str, waiting: WaitingCaptures, store: Store
) -> errors.Message:
    """Let a capture wait at its place; return the words for it.

    Raises
    ------
    CucumberVisionError
        If the round has it, the same camera took another at its place, or it cannot be kept.
    """
    home = walking.round_for_capture(store, round_key, simulated=capture.simulated)
    queued = [other for other in waiting.captures() if other.round_key == home]
    if capture.stop.step is None:
        step = walking.last_step([*store.stops(home), *(other.stop for other in queued)]) + 1
        capture = replace(capture, stop=replace(capture.stop, step=step))
    item = RoundCapture.to_add(store, home, capture)
    if item.is_deleted:
        raise errors.UploadError("was deleted: undo that to have it back")
    if item.is_deleted is not None or waiting.holds(item.stop.key):
        raise errors.UploadError("is in the round already")
    walking.refuse_taken(store, item.stop)
    stop = capture.stop
    for other in queued:
        is_there = replace(other.stop, step=stop.step) == stop
        if is_there and other.load().intrinsics == capture.intrinsics:
            raise errors.UploadError("another photo of this camera waits at its place")
    waiting.put(capture, item.stop.key, home, time.time())
    template = "{words} (row {row}, {side}, {position:.2f} m)"
    if home != round_key:
        template = (
            "{words} (row {row}, {side}, {position:.2f} m; computer-made, so in the round "
            "'Demonstration')"
        )
    parts = {"row": stop.row or "?", "side": errors.Message(stop.side or "")}
    at_m = stop.position_m or 0.0
    return errors.Message(template, words=errors.Message("saved"), position=at_m, **parts)


def _opened(source: AcceptedSource, reading: ReadOptions, camera: str) -> CaptureSource:
    """Open a source; images without intrinsics get the camera's nominal ones."""
    try:
        return source.open(reading)
    except errors.IntrinsicsError:
        images = sorted(p for p in source.path.rglob("*") if p.suffix.lower() in COLOR_SUFFIXES)
        if not camera or reading.intrinsics or not images:
            raise
    height, width = read_color(images[0]).shape[:2]
    focal_px, middle = CAMERAS[camera] * min(width, height), ((width - 1) / 2, (height - 1) / 2)
    lens = Intrinsics(width, height, focal_px, focal_px, *middle, Stream.COLOR)
    path = source.path.with_name(f"{source.path.name}-camera.json")
    path.write_text(json.dumps(CameraModel.of(lens).model_dump(mode="json")), encoding="utf-8")
    return source.open(replace(reading, intrinsics=path))
