"""Check the files of a request, measure its captures one at a time, and build the reply."""

from __future__ import annotations

import shutil
import tempfile
import threading
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Literal

from pydantic import BaseModel, Field

from cucumbervision.capture.source import CaptureRef
from cucumbervision.errors import CucumberVisionError, UploadError
from cucumbervision.intake.uploads import accept_uploads, clean_name
from cucumbervision.measurement.pose import FruitPose
from cucumbervision.pipeline.batch import ResultWorker, measure_all, never
from cucumbervision.pipeline.detect import DetectedPicture, PictureWorker, read_picture
from cucumbervision.pipeline.fields import FIELDS, row_model
from cucumbervision.pipeline.inputs import Listed, list_source
from cucumbervision.pipeline.measurer import CaptureResult, Failure, Measurer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from cucumbervision.capture.frames import Capture
    from cucumbervision.service.server import ServiceSettings


FruitRow: Any = row_model("FruitRow", FIELDS, pose=(FruitPose | None, None))
"""One fruit: the columns of the tables, in their units, and its pose."""


class NotRead(BaseModel):
    """A file or capture that could not be read or measured."""

    name: str
    error: str = Field(description="Stable name, a class of cucumbervision.errors.")
    message: str


class MeasuredCapture(BaseModel):
    """One capture and its fruit."""

    name: str
    width: int
    height: int
    simulated: bool
    fruit: list[FruitRow]


class MeasureReply(BaseModel):
    """The results of one request."""

    version: Literal[1] = 1
    captures: list[MeasuredCapture]
    failures: list[NotRead]
    ignored: list[str] = Field(description="Files that are not needed.")
    config_sha256: str = Field(description="Hash of the options that were measured with.")


class SeenPicture(BaseModel):
    """One picture and the fruit found in it."""

    name: str
    width: int
    height: int
    fruit: list[dict[str, Any]] = Field(
        description="As COCO's results: bbox, score, segmentation, keypoints; and the class name."
    )


class DetectReply(BaseModel):
    """The detections in the pictures of one request."""

    version: Literal[1] = 1
    pictures: list[SeenPicture]
    failures: list[NotRead]


class Health(BaseModel):
    """Status and version of the service."""

    status: str
    software: str
    licence: str
    source: str
    models: list[str] = Field(description="Networks that are loaded so far.")


class Problem(BaseModel):
    """Why a request was rejected."""

    error: str
    message: str


def measured_capture(result: CaptureResult) -> MeasuredCapture:
    """Return a result as a capture of a reply."""
    capture = result.capture
    return MeasuredCapture(
        name=capture.name,
        width=capture.width,
        height=capture.height,
        simulated=capture.simulated,
        fruit=[
            FruitRow(**row, pose=fruit.pose)
            for row, fruit in zip(result.rows(), result.fruit, strict=True)
        ],
    )


def not_read(failure: Failure) -> NotRead:
    """Return a failure of a reply."""
    name = failure.capture or failure.input
    return NotRead(name=name, error=failure.error, message=failure.message)


class BusyError(CucumberVisionError):
    """Too many requests are waiting."""


class LeftError(CucumberVisionError):
    """The client has closed the connection before its turn."""


class Work:
    """The measurer of all requests, used by one at a time.

    Parameters
    ----------
    measurer : Measurer
        The measurer; loaded with the first request that needs it.
    settings : ServiceSettings
        Limits.
    """

    def __init__(self, measurer: Measurer, settings: ServiceSettings) -> None:
        self.measurer, self.settings = measurer, settings
        self._lock = threading.Lock()
        self._room = threading.BoundedSemaphore(settings.waiting + 1)

    @contextmanager
    def place(self) -> Iterator[None]:
        """Hold a place in the queue, from before the body is read until the answer.

        Raises
        ------
        BusyError
            If too many requests are waiting.
        """
        if not self._room.acquire(blocking=False):
            raise BusyError("too many requests are waiting", remedy="send it again later")
        try:
            yield
        finally:
            self._room.release()

    @contextmanager
    def turn(self, has_left: Callable[[], bool] = never) -> Iterator[None]:
        """Wait for the measurer.

        Raises
        ------
        LeftError
            If the client has left meanwhile.
        """
        with self._lock:
            if has_left():
                raise LeftError("the client has left")
            yield

    def measure(
        self, files: Sequence[tuple[str, BinaryIO]], has_left: Callable[[], bool] = never
    ) -> MeasureReply:
        """Measure every capture of uploaded files; stop if the client has left.

        Raises
        ------
        CucumberVisionError
            If no file can be processed: too many files, a full disk, no networks.
        """
        limits, results, failures = self.settings.limits, list[CaptureResult](), list[Failure]()
        with self.turn(has_left), tempfile.TemporaryDirectory(prefix="cucumbervision-") as folder:
            self.measurer.load()
            reading = self.measurer.options.reading
            uploads = accept_uploads(files, Path(folder), limits)
            listed = chain.from_iterable(
                list_source(upload.title, partial(upload.open, reading))
                for upload in uploads.sources
            )
            for _, outcome in measure_all(
                listed, ResultWorker(self.measurer), is_cancelled=has_left
            ):
                failures += outcome.failures
                if outcome.value is not None and outcome.value.error is None:
                    results.append(outcome.value)
        refused = [
            NotRead(name=error.source, error=error.code, message=str(error))
            for error in uploads.refused
        ]
        return MeasureReply(
            captures=[measured_capture(result) for result in results],
            failures=refused + [not_read(failure) for failure in failures],
            ignored=uploads.ignored,
            config_sha256=self.measurer.options.sha256,
        )

    def detect(
        self, files: Sequence[tuple[str, BinaryIO]], has_left: Callable[[], bool] = never
    ) -> DetectReply:
        """Find the fruit in uploaded pictures, without lengths; stop if the client has left.

        Raises
        ------
        CucumberVisionError
            As `measure`.
        """
        pictures: list[DetectedPicture] = []
        failures: list[Failure] = []
        limits = self.settings.limits
        if len(files) > limits.files:
            raise UploadError(
                "{files} files were sent, at most {limit} are taken at once",
                remedy="send them in smaller parts",
                files=len(files),
                limit=limits.files,
            )
        with self.turn(has_left), tempfile.TemporaryDirectory(prefix="cucumbervision-") as folder:
            self.measurer.load()
            listed = (
                _picture(Path(folder) / f"{number:04d}", clean_name(name), stream)
                for number, (name, stream) in enumerate(files)
            )
            for _, outcome in measure_all(
                listed, PictureWorker(self.measurer), is_cancelled=has_left
            ):
                failures += outcome.failures
                if outcome.value is not None:
                    pictures.append(outcome.value)
        return DetectReply(
            pictures=[
                SeenPicture(
                    name=picture.name,
                    width=picture.width,
                    height=picture.height,
                    fruit=picture.entries,
                )
                for picture in pictures
            ],
            failures=[not_read(failure) for failure in failures],
        )


def _picture(path: Path, name: str, stream: BinaryIO) -> Listed:
    """Return an uploaded picture; it is stored under a generated name until it is read."""
    return Listed(name, CaptureRef(name, 0, partial(_read, path, name, stream)), name)


def _read(path: Path, name: str, stream: BinaryIO) -> Capture:
    try:
        with path.open("xb") as copy:
            shutil.copyfileobj(stream, copy)
        return replace(read_picture(path, name), source=name)
    except CucumberVisionError as error:
        raise error.at(name) from None
    finally:
        path.unlink(missing_ok=True)
