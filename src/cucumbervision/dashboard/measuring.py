"""Measure captures into the store, and measure a fruit anew with a corrected mask."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.errors import CucumberVisionError, InstancesError
from cucumbervision.measurement.selector import measure_fruit
from cucumbervision.perception.instances import Instance, MaskSource
from cucumbervision.perception.masks import box_of_mask
from cucumbervision.pipeline.finders import make_finder
from cucumbervision.pipeline.results import Failure
from cucumbervision.pipeline.run import capture_rows, measure_capture
from cucumbervision.rounds.adding import placed_fruit, placed_stop
from cucumbervision.rounds.poses import MIDDLE_SD_M, pose_matrix, sign_of_side
from cucumbervision.store.images import DEPTH_UNIT_M
from cucumbervision.store.records import new_key
from cucumbervision.store.results import (
    MeasuredCapture,
    artifact_records,
    fruit_record,
    records_from_result,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cucumbervision.calibration.calibration_file import SiteCalibration
    from cucumbervision.perception.registry import Registry
    from cucumbervision.perception.sam import Segmenter
    from cucumbervision.pipeline.finders import Finder
    from cucumbervision.pipeline.options import MeasureOptions
    from cucumbervision.store.images import ImageStore
    from cucumbervision.store.records import CaptureRecord, StopRecord
    from cucumbervision.store.repository import Store
    from cucumbervision.store.views import DetectionDetail

__all__ = ["Measurer", "TakenStop", "stored_capture"]

SEGMENTER = "mobile-sam"


@dataclass(frozen=True, eq=False)
class TakenStop:
    """A stop that is in the store, and what was measured there."""

    key: str
    measured: MeasuredCapture
    note: str = ""


class Measurer:
    """Measures with networks that are loaded once, and again only when the options change.

    Parameters
    ----------
    registry : Registry
        Where the networks lie.
    """

    def __init__(self, registry: Registry) -> None:
        self._registry = registry
        self._lock = threading.Lock()
        self._loaded: tuple[str, Finder, SiteCalibration | None] | None = None
        self._segmenter: Segmenter | None = None

    def measure(self, capture: Capture, options: MeasureOptions) -> MeasuredCapture:
        """Find and measure the fruit of one capture.

        Raises
        ------
        CucumberVisionError
            If a network or the calibration cannot be loaded, or belongs to another camera.
        """
        return self._measured(capture, options)[0]

    def _measured(
        self, capture: Capture, options: MeasureOptions
    ) -> tuple[MeasuredCapture, tuple[CucumberVisionError, ...]]:
        """Give what was measured, and what was refused as no fruit of this picture."""
        finder, site = self._tools(options)
        if site is not None:
            from cucumbervision.pipeline.calibrated import calibrated_capture

            capture = calibrated_capture(capture, site)
        fruit, refused = measure_capture(capture, finder, options)
        rows = capture_rows(capture, fruit, options, site)
        return MeasuredCapture(capture, fruit, rows), refused

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
        StoreError
            If it cannot be saved.
        """
        note = ""
        try:
            measured, errors = self._measured(capture, options)
        except CucumberVisionError as error:
            measured, errors = MeasuredCapture(capture, (), ()), (error,)
            note = error.message  # its remedy is for the command line
        failures = [Failure(capture.source, capture.name, e.code, str(e)) for e in errors]
        record = self._record(store, round_key, measured, options, failures)
        record = replace(record, key=key or new_key())
        store.save_stop(record)
        return TakenStop(record.key, measured, note)

    def _record(
        self,
        store: Store,
        round_key: str,
        measured: MeasuredCapture,
        options: MeasureOptions,
        failures: Sequence[Failure],
    ) -> StopRecord:
        loaded, stop = self._loaded, measured.capture.stop
        models = [] if loaded is None else loaded[1].models
        record = records_from_result(
            round_key,
            [measured],
            position_sd_m=MIDDLE_SD_M,
            images=store.images,
            artifacts=artifact_records(options, models, loaded[2] if loaded else None),
            failures=failures,
            length=options.length,
        )
        pose = pose_matrix(stop.position_m or 0.0, sign_of_side(stop.side))
        return placed_stop(record, pose)

    def mask_from_click(self, capture: Capture, at_px: tuple[float, float]) -> NDArray[np.bool_]:
        """Draw the mask of the fruit that somebody pointed at.

        Raises
        ------
        InstancesError
            If there is none.
        """
        return _some(self._sam().mask_at(capture.color, *at_px))

    def mask_from_box(
        self, capture: Capture, box_px: tuple[float, float, float, float]
    ) -> NDArray[np.bool_]:
        """Draw the mask of the fruit that somebody drew a box around.

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
        _, site = self._tools(options)
        record = detail.view.record
        keypoints = np.array(record.keypoints, np.float64) if record.keypoints else None
        instance = Instance(
            box_of_mask(mask), record.score, record.label, mask, MaskSource.SAM, None, keypoints
        )
        fruit = measure_fruit(capture, instance, options.methods, options.selector)
        (row,) = capture_rows(capture, [fruit], options, site)
        corrected = fruit_record(capture, record.number, fruit, row, options.length)
        stop = detail.stop
        pose = pose_matrix(stop.position_m or 0.0, sign_of_side(stop.side))
        return store.correct(detail.view.key, placed_fruit(corrected, pose))

    def _tools(self, options: MeasureOptions) -> tuple[Finder, SiteCalibration | None]:
        with self._lock:
            if self._loaded is None or self._loaded[0] != options.sha256:
                site = None
                if options.calibration is not None:
                    from cucumbervision.calibration.calibration_file import read_site_calibration

                    site = read_site_calibration(options.calibration)
                finder = make_finder(options, self._registry)
                self._loaded = (options.sha256, finder, site)
            return self._loaded[1:]

    def _sam(self) -> Segmenter:
        with self._lock:
            if self._segmenter is None:
                from cucumbervision.perception.sam import Segmenter

                files = self._registry.resolve(SEGMENTER)
                self._segmenter = Segmenter((files["encoder"], files["decoder"]), prompt="box")
            return self._segmenter


def stored_capture(images: ImageStore, record: CaptureRecord, stop: StopRecord) -> Capture:
    """Give a capture of the store as a frame again.

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
        record.name,
        frame=record.frame,
        burst_frame=record.burst_frame,
        burst_size=record.burst_size,
        stop=Stop(stop.row, stop.side, stop.position_m, stop.step),
        timestamp_s=record.timestamp_s,
        simulated=record.simulated,
        source=record.source,
        provenance=dict[str, Any](record.provenance),
    )


def _some(mask: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    if mask is None or np.count_nonzero(mask) < 100:
        raise InstancesError(
            "there is no fruit to be seen there", remedy="point at its middle or draw a closer box"
        )
    return mask
