"""What a request asks for, done: its files checked, its captures measured, one at a time."""

from __future__ import annotations

import shutil
import tempfile
import threading
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from cucumbervision.capture.files import read_photo
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.errors import CucumberVisionError, UploadError
from cucumbervision.intake.archives import clean_name
from cucumbervision.intake.file_checks import HEAD_BYTES, PICTURES, check_picture, file_kind
from cucumbervision.intake.uploads import accept_uploads
from cucumbervision.pipeline.detect import coco_fields
from cucumbervision.pipeline.measurer import Boundary, CaptureResult, Failure, Measurer
from cucumbervision.service.replies import (
    DetectReply,
    MeasureReply,
    NotRead,
    SeenPicture,
    measured_capture,
    not_read,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from cucumbervision.service.settings import ServiceSettings


class BusyError(CucumberVisionError):
    """More requests wait than the service takes."""


class Work:
    """The one measurer behind all requests: they wait for each other.

    Parameters
    ----------
    measurer : Measurer
        What measures; loaded with the first request that needs it.
    settings : ServiceSettings
        Limits.
    """

    def __init__(self, measurer: Measurer, settings: ServiceSettings) -> None:
        self.measurer, self.settings = measurer, settings
        self._lock = threading.Lock()
        self._room = threading.BoundedSemaphore(settings.waiting + 1)

    @contextmanager
    def turn(self) -> Iterator[None]:
        """Wait for the measurer.

        Raises
        ------
        BusyError
            If too many wait already.
        """
        if not self._room.acquire(blocking=False):
            raise BusyError("too many requests are waiting", remedy="send it again later")
        try:
            with self._lock:
                yield
        finally:
            self._room.release()

    def measure(self, files: Sequence[tuple[str, BinaryIO]]) -> MeasureReply:
        """Measure every capture of uploaded files.

        Raises
        ------
        CucumberVisionError
            If nothing can be taken at all: too many files, a full disk, no networks.
        """
        settings = self.settings
        results: list[CaptureResult] = []
        failures: list[Failure] = []
        with self.turn(), tempfile.TemporaryDirectory(prefix="cucumbervision-") as folder:
            self.measurer.load()
            given = accept_uploads(files, Path(folder), settings.limits, burst=settings.burst)
            for source in given.sources:
                with Boundary(failures, source.title):
                    for ref in source.open(self.measurer.options.reading):
                        with Boundary(failures, source.title, ref.name):
                            results.append(self.measurer.measure(ref.load()))
        failures += [failure for one in results for failure in one.failures]
        refused = [
            NotRead(name=one.name, error=one.error.code, message=str(one.error))
            for one in given.refused
        ]
        return MeasureReply(
            captures=[measured_capture(one) for one in results],
            failures=refused + [not_read(failure) for failure in failures],
            ignored=given.ignored,
            config_sha256=self.measurer.options.sha256,
        )

    def detect(self, files: Sequence[tuple[str, BinaryIO]]) -> DetectReply:
        """Find the fruit of uploaded pictures; no lengths.

        Raises
        ------
        CucumberVisionError
            As `measure`.
        """
        pictures: list[SeenPicture] = []
        failures: list[Failure] = []
        limits = self.settings.limits
        if len(files) > limits.files:
            raise UploadError(
                f"{len(files)} files were sent, at most {limits.files} are taken at once",
                remedy="send them in smaller parts",
            )
        with self.turn(), tempfile.TemporaryDirectory(prefix="cucumbervision-") as folder:
            self.measurer.load()
            for number, (name, stream) in enumerate(files):
                shown = clean_name(name)
                with Boundary(failures, shown):
                    pictures.append(self._look(Path(folder) / f"{number:04d}", shown, stream))
        return DetectReply(pictures=pictures, failures=[not_read(one) for one in failures])

    def _look(self, path: Path, shown: str, stream: BinaryIO) -> SeenPicture:
        with path.open("xb") as kept:
            shutil.copyfileobj(stream, kept)
        with path.open("rb") as head:
            kind = file_kind(head.read(HEAD_BYTES), shown)
        if kind not in PICTURES:
            raise UploadError("is no picture", source=shown, remedy="send JPEG, PNG, TIFF or WebP")
        if kind.value != ".webp":
            check_picture(path, kind, self.settings.limits.pixels, source=shown)
        try:
            color = read_photo(path)
        except CucumberVisionError as error:
            raise error.at(shown) from None
        finally:
            path.unlink()
        height, width = color.shape[:2]
        # Without a reading and with any lens: who finds fruit looks at the colours.
        nowhere = np.zeros((height, width), np.float32)
        lens = Intrinsics(width, height, float(width), float(width), width / 2, height / 2)
        found = self.measurer.detect(Capture(color, nowhere, lens, shown)).found
        fruit = [
            {**coco_fields(one, keypoints=one.keypoints is not None), "class": one.class_name}
            for one in found.instances
        ]
        return SeenPicture(name=shown, width=width, height=height, fruit=fruit)
