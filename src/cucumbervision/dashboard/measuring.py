"""Measure captures and uploads into the store, and a fruit again with a corrected mask."""

from __future__ import annotations

import tempfile
import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.errors import CucumberVisionError, InstancesError
from cucumbervision.intake.uploads import accept_uploads
from cucumbervision.perception.instances import Instance, MaskSource
from cucumbervision.perception.masks import box_of_mask
from cucumbervision.pipeline.fields import SeenFruit
from cucumbervision.pipeline.measurer import Measurer
from cucumbervision.rounds.adding import Place, measured_stop, placed_fruit
from cucumbervision.rounds.poses import stored_pose
from cucumbervision.store.images import DEPTH_UNIT_M
from cucumbervision.store.records import new_key
from cucumbervision.store.results import AS_READ, fruit_record

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from cucumbervision.capture.source import CaptureRef
    from cucumbervision.dashboard.jobs import Job
    from cucumbervision.intake.staging import AcceptedUploads
    from cucumbervision.perception.registry import Registry
    from cucumbervision.perception.sam import Segmenter
    from cucumbervision.pipeline.measurer import CaptureResult
    from cucumbervision.pipeline.options import MeasureOptions
    from cucumbervision.store.images import ImageStore
    from cucumbervision.store.records import CaptureRecord, DetectionRecord, StopRecord
    from cucumbervision.store.repository import Store
    from cucumbervision.store.views import DetectionDetail

__all__ = ["SharedMeasurer", "TakenStop", "measure_uploads", "stored_capture"]

SEGMENTER = "mobile-sam"


@dataclass(frozen=True, eq=False)
class TakenStop:
    """A stop that is in the store, and what was measured there."""

    key: str
    result: CaptureResult

    @property
    def note(self) -> str:
        """Why nothing was measured, for people; its remedy is for the command line."""
        return "" if self.result.error is None else self.result.error.message


class SharedMeasurer:
    """The measurer of all viewers: loaded once, and again only when the options change.

    Parameters
    ----------
    registry : Registry
        Where the networks lie.
    """

    def __init__(self, registry: Registry) -> None:
        self._registry = registry
        self._lock = threading.Lock()
        self._loaded: Measurer | None = None
        self._segmenter: Segmenter | None = None

    def with_options(self, options: MeasureOptions) -> Measurer:
        """Return what measures with these options."""
        with self._lock:
            if self._loaded is None or self._loaded.options != options:
                self._loaded = Measurer(options, self._registry)
            return self._loaded

    def take_stop(
        self,
        store: Store,
        round_key: str,
        capture: Capture,
        options: MeasureOptions,
        *,
        key: str | None = None,
    ) -> TakenStop:
        """Measure a capture and save it as a stop of a round; its own `stop` says where it is.

        A capture in which nothing can be measured is saved with the reason, so that no capture
        is lost.

        Parameters
        ----------
        store : Store
            Where to.
        round_key : str
            The round, saved before.
        capture : Capture
            The frame.
        options : MeasureOptions
            How to measure.
        key : str, optional
            The stop's own; a new one by default.

        Raises
        ------
        CucumberVisionError
            If it cannot be saved.
        """
        measurer = self.with_options(options)
        result, stop = measured_stop(capture, 0, Place(), measurer, store.images)
        stop = replace(stop, key=key or new_key(), round_key=round_key)
        store.save_stop(stop)
        return TakenStop(stop.key, result)

    def mask_from_click(self, capture: Capture, at_px: tuple[float, float]) -> NDArray[np.bool_]:
        """Return the mask of the fruit at a point.

        Raises
        ------
        InstancesError
            If there is none.
        """
        return _some(self._sam().mask_at(capture.color, *at_px))

    def mask_from_box(
        self, capture: Capture, box_px: tuple[float, float, float, float]
    ) -> NDArray[np.bool_]:
        """Return the mask of the fruit in a box.

        Raises
        ------
        InstancesError
            If there is none.
        """
        x1, y1, x2, y2 = box_px
        box = np.array([min(x1, x2), min(y1, y2), max(x1, x2), max(y1, y2)])
        (found,) = self._sam().segment(capture.color, [Instance(box)])
        return _some(found.mask)

    def correct(
        self,
        store: Store,
        detail: DetectionDetail,
        mask: NDArray[np.bool_],
        options: MeasureOptions,
    ) -> int:
        """Measure a fruit of the store anew with this mask, and let that stand; logged."""
        capture = stored_capture(store.images, detail.capture, detail.stop)
        record = detail.view.record
        keypoints = np.array(record.keypoints, np.float64) if record.keypoints else None
        instance = Instance(
            box_of_mask(mask), record.score, record.label, mask, MaskSource.SAM, None, keypoints
        )
        corrected = self._placed(capture, detail.stop, instance, record.number, options)
        return store.correct(detail.view.key, corrected)

    def add(
        self,
        store: Store,
        stop: StopRecord,
        capture: Capture,
        mask: NDArray[np.bool_],
        options: MeasureOptions,
    ) -> str:
        """Measure a fruit that was not found, add it to its capture's, and return its key; logged.

        Parameters
        ----------
        store : Store
            Where the stop is.
        stop : StopRecord
            The stop.
        capture : Capture
            One of its captures, as `stored_capture` gives it.
        mask : ndarray of bool, shape (H, W)
            The fruit.
        options : MeasureOptions
            How to measure.
        """
        instance = Instance(box_of_mask(mask), mask=mask, mask_source=MaskSource.SAM)
        fruit = self._placed(capture, stop, instance, 1, options)
        return store.add_fruit(stop.key, capture.name, fruit)

    def _placed(
        self,
        capture: Capture,
        stop: StopRecord,
        instance: Instance,
        number: int,
        options: MeasureOptions,
    ) -> DetectionRecord:
        """Measure a fruit of a stored capture, with its offset along the row."""
        fruit = self.with_options(options).measure_instance(capture, instance)
        record = fruit_record(SeenFruit(capture, number, fruit))
        return placed_fruit(record, stored_pose(stop.pose, stop.side))

    def _sam(self) -> Segmenter:
        with self._lock:
            if self._segmenter is None:
                from cucumbervision.perception.sam import Segmenter

                files = self._registry.resolve(SEGMENTER)
                self._segmenter = Segmenter((files["encoder"], files["decoder"]), prompt="box")
            return self._segmenter


def measure_uploads(
    files: Sequence[tuple[str, BinaryIO | Path]],
    measurer: SharedMeasurer,
    store: Store,
    round_key: str,
    options: MeasureOptions,
    spacing_m: float,
    job: Job,
) -> int:
    """Check uploads and save their captures as stops of a round; return how many were saved.

    Parameters
    ----------
    files : sequence of (name, stream or Path)
        As for `intake.uploads.accept_uploads`.
    spacing_m : float
        From one capture to the next, for captures that bring no position.
    job : Job
        Gets a step a file, and a note for each file or capture that could not be measured.
    """
    job.total, saved = len(files), 0
    with tempfile.TemporaryDirectory(prefix="cucumbervision-") as folder:
        accepted = accept_uploads(
            files, Path(folder), burst=options.reading.burst, report=lambda *_: job.step()
        )
        job.notes += [str(refused.error) for refused in accepted.refused]
        for ref in _references(accepted, options, job):
            try:
                capture = ref.load()
            except CucumberVisionError as error:
                job.notes.append(str(error))
                continue
            stop = capture.stop
            if stop.position_m is None:
                stop = replace(stop, position_m=round(saved * spacing_m, 2), step=saved + 1)
            taken = measurer.take_stop(store, round_key, replace(capture, stop=stop), options)
            saved += 1
            if taken.note:
                job.notes.append(f"{capture.name}: {taken.note}")
    return saved


def _references(
    accepted: AcceptedUploads, options: MeasureOptions, job: Job
) -> Iterator[CaptureRef]:
    for source in accepted.sources:
        try:
            yield from source.open(options.reading)
        except CucumberVisionError as error:
            job.notes.append(str(error))


def stored_capture(images: ImageStore, record: CaptureRecord, stop: StopRecord) -> Capture:
    """Return a capture of the store as a frame again.

    Its depth is as it was measured from: already scaled by the site's calibration.

    Raises
    ------
    StoredImageError
        If a picture is missing or damaged.
    InstancesError
        If it was kept without pictures.
    """
    if record.color is None or record.depth is None:
        raise InstancesError(
            "the pictures of this capture were not kept",
            source=record.name,
            remedy="measure the capture again",
        )
    return Capture(
        images.read_color(record.color),
        images.read_depth(record.depth, record.depth_unit_m or DEPTH_UNIT_M),
        CameraModel.model_validate(dict(record.camera)).intrinsics,
        stop=Stop(stop.row, stop.side, stop.position_m, stop.step),
        provenance=dict[str, Any](record.provenance),
        **{name: getattr(record, name) for name in AS_READ},
    )


def _some(mask: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    if mask is None or np.count_nonzero(mask) < 100:
        raise InstancesError(
            "no fruit was found there", remedy="tap its middle or draw a closer box"
        )
    return mask
