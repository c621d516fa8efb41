"""The measurer that all viewers share: captures, and single fruit with a corrected mask."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace

import cv2
import numpy as np

from cucumbervision.arrays import Array, Mask
from cucumbervision.capture.frames import Capture, valid_depth
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import InstancesError
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.fruit.mask_codes import decode_rle
from cucumbervision.fruit.masks import box_of_mask, mask_iou
from cucumbervision.methods.flags import Flag
from cucumbervision.methods.result import Fruit
from cucumbervision.networks.find import NetworkSegmenter
from cucumbervision.networks.registry import Registry
from cucumbervision.run.measurer import Measurer
from cucumbervision.run.options import MeasureOptions
from cucumbervision_greenhouse.rounds import adding
from cucumbervision_greenhouse.rounds.walking import stored_pose
from cucumbervision_greenhouse.store.records import (
    DetectionDetail,
    FruitRow,
    Point,
    StopRecord,
    Verdict,
)
from cucumbervision_greenhouse.store.repository import Store


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
        self._segmenter: NetworkSegmenter | None = None
        self._masks: dict[str, tuple[object, Mask]] = {}

    def with_options(self, options: MeasureOptions) -> Measurer:
        """Return a measurer with these options, and the calibration as its file is now.

        Raises
        ------
        CalibrationError
            If it cannot be read.
        """
        fresh = Measurer(options, self._registry)
        site = fresh.site
        with self._lock:
            loaded = self._with_networks_of(options) or fresh
            if (loaded.options, loaded.site) != (options, site):
                loaded = loaded.calibrated_by(site, options.calibration)
            self._loaded = loaded
        return loaded

    def _with_networks_of(self, options: MeasureOptions) -> Measurer | None:
        """Return the loaded measurer if it differs from these options by its calibration only."""
        loaded = self._loaded
        if loaded and replace(loaded.options, calibration=options.calibration) == options:
            return loaded
        return None

    def _outlined(
        self,
        store: Store,
        stop: StopRecord,
        capture: Capture,
        mask: Mask,
        options: MeasureOptions,
        before: FruitRow,
    ) -> tuple[Fruit, FruitRow]:
        """Measure a fruit of a stored capture in this mask, and return it with its row.

        With the calibration that the depth has already: the one in the options may be another
        camera's, or newer.
        """
        _refuse_copy(store, stop, capture, mask, but=before.fruit)
        keypoints = _kept_keypoints(before.keypoints, mask)
        box, source = box_of_mask(mask), MaskSource.SAM
        instance = Instance(box, before.score, before.label, mask, source, keypoints=keypoints)
        plain = replace(options, calibration=None)
        measurer = self._with_networks_of(options) or self.with_options(plain)
        measurer = measurer.calibrated_by(adding.stored_calibration(stop))
        fruit = measurer.measure_instance(capture, instance)
        pose = stored_pose(stop.pose, stop.side)
        return fruit, adding.fruit_record(capture, before.fruit, fruit, pose)

    def warm_up(self, options: MeasureOptions) -> None:
        """Load the networks, and run each once, since the first run takes much longer."""
        first = next(iter(open_source(example_captures()))).load()
        # Without its own masks, which would replace the networks' detections.
        self.with_options(options).measure(replace(first, masks=()))
        with suppress(InstancesError):  # the result is ignored
            self.mask_of(first, (first.width / 2, first.height / 2))

    def prepare(self, capture: Capture) -> None:
        """Compute what outlining needs of an image, before somebody taps into it."""
        self._sam().mask_at(capture.color, capture.width / 2, capture.height / 2)

    def draft_of(
        self, capture: Capture, point: Sequence[float] | None, box: Sequence[float] | None
    ) -> Mask:
        """Return what is shown at once of a point or a box, before `mask_of` is measured.

        Of a point that is the narrower mask of the point alone, which takes half the time.

        Raises
        ------
        InstancesError
            If there is none.
        """
        if not point:
            return self.mask_of(capture, None, box)
        return self._last(
            "draft", capture, point, lambda: self._sam().mask_at(capture.color, *point)
        )

    def mask_of(
        self,
        capture: Capture,
        point: Sequence[float] | None = None,
        box: Sequence[float] | None = None,
    ) -> Mask:
        """Return the mask of the fruit at a point, or in a box where none is given.

        The mask of a point comes from the box of what is segmented there, as for all other fruit:
        the mask of a point alone is narrower, so that visible ends seem hidden.

        Raises
        ------
        InstancesError
            If there is none.
        """
        return self._last(
            "whole", capture, point or box or (), lambda: self._draw(capture, point, box)
        )

    def _draw(
        self, capture: Capture, point: Sequence[float] | None, box: Sequence[float] | None
    ) -> Mask:
        if not point:
            x1, y1, x2, y2 = (float(value) for value in box or ())
            edges = np.array([min(x1, x2), min(y1, y2), max(x1, x2), max(y1, y2)])
            (segmented,) = self._sam().segment(capture.color, [Instance(edges)])
            return _some(segmented.mask)
        draft = self.draft_of(capture, point, None)
        try:
            drawn = self._draw(capture, None, box_of_mask(draft).tolist())
        except InstancesError:
            return draft
        return drawn if mask_iou(drawn, draft) > _SAME_IOU else draft

    def _last(
        self, kind: str, capture: Capture, prompt: Sequence[float], draw: Callable[[], Mask | None]
    ) -> Mask:
        """Return the mask of a prompt: the last one of its kind if that was the same.

        A mask is shown as an outline first, and measured then.
        """
        key = adding.capture_sha256(capture), *map(float, prompt)
        if kind not in self._masks or self._masks[kind][0] != key:
            self._masks[kind] = key, _some(draw())
        return self._masks[kind][1]

    def correct(
        self,
        store: Store,
        detail: DetectionDetail,
        capture: Capture,
        mask: Mask,
        options: MeasureOptions,
    ) -> int:
        """Measure a stored fruit again with this mask, and save the result as a correction; logged.

        `capture` is the fruit's, as `stored_capture` gives it.

        Raises
        ------
        InstancesError
            If the mask is another fruit's.
        """
        _, row = self._outlined(store, detail.stop, capture, mask, options, detail.view)
        return store.correct(detail.view.key, row)

    def add(
        self, store: Store, stop: StopRecord, capture: Capture, mask: Mask, options: MeasureOptions
    ) -> str:
        """Measure a missed fruit, add it to its capture, and return its key; logged.

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

        Raises
        ------
        InstancesError
            If the mask is another fruit's, or no fruit can be so large.

        Notes
        -----
        A measurement that does not look like a fruit (`is_doubtful`) is flagged, and not accepted.
        """
        if mask.mean() > _LARGEST_SHARE:
            raise InstancesError(
                "no fruit was found there: the outline takes most of the picture",
                remedy="tap its middle or draw a closer box",
            )
        measured, fruit = self._outlined(store, stop, capture, mask, options, FruitRow(0))
        if is_doubtful(measured, capture):
            flags = f"{fruit.flags} {Flag.DOUBTFUL}".strip()
            fruit = fruit.with_(flags=flags, score=_DOUBTFUL_SCORE)
        return store.add_fruit(stop.key, capture.name, fruit)

    def _sam(self) -> NetworkSegmenter:
        with self._lock:
            if self._segmenter is None:
                from cucumbervision.networks.find import open_segmenter

                self._segmenter = open_segmenter(prompt="box", registry=self._registry)
            return self._segmenter


_SAME_IOU = 0.7  # overlap above which two outlines at one point are of the same object
_LARGEST_SHARE = 0.5  # of the image
_DOUBTFUL_SCORE = 0.25  # a detection of low confidence
_RING_PX = 12  # width of the surroundings that are examined
# Share of the surroundings that must lie this much farther.
_STANDS_OUT_M, _STANDS_OUT_SHARE = 0.01, 0.2
# Limits as shares of the length: the interval's lower side; the diameter.
_UNSURE, _STOUT = 0.15, 0.5


def is_doubtful(fruit: Fruit, capture: Capture) -> bool:
    """Return whether a measurement may not be of a fruit, by its shape and the depth around it.

    A fruit is a tube (M6) that fits well, is no thicker than half its length, has an interval that
    reaches at most 15 % below the length, and stands out from part of its surroundings.

    Parameters
    ----------
    fruit : Fruit
        As it was measured.
    capture : Capture
        Where.
    """
    tube, length = fruit.selected, fruit.length
    if tube is None or tube.fit is None or length is None or length.low_m is None:
        return True
    if {Flag.POOR_FIT, Flag.UNCERTAIN, Flag.END_ON} & set(fruit.flags):
        return True
    unsure = length.value_m - length.low_m > _UNSURE * length.value_m
    if unsure or tube.fit.traits.diameter_max_m > _STOUT * length.value_m:
        return True
    return not _is_raised(fruit.mask, capture)


def _is_raised(mask: Mask | None, capture: Capture) -> bool:
    """Return whether part of a mask's surroundings lies farther away than the mask."""
    if mask is None:
        return False
    size = 2 * _RING_PX + 1
    widened = cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
    valid = valid_depth(capture.depth_m)
    inside_m, around_m = capture.depth_m[mask & valid], capture.depth_m[widened & ~mask & valid]
    if not len(inside_m) or not len(around_m):
        return False
    farther = around_m > float(np.median(inside_m)) + _STANDS_OUT_M
    return bool(farther.mean() > _STANDS_OUT_SHARE)


_COPY_SHARE = 0.6  # share of the smaller of two masks above which both are one fruit


def _refuse_copy(store: Store, stop: StopRecord, capture: Capture, mask: Mask, but: int) -> None:
    """Refuse a mask that belongs to another fruit of the image; deleted fruit are ignored.

    Raises
    ------
    InstancesError
        Naming that fruit.
    """
    for view in store.detections(stop.round_key, stop.key, shapes=True):
        number, is_rejected = view.fruit, view.verdict is Verdict.REJECTED
        if view.capture != capture.name or number == but or is_rejected or view.mask is None:
            continue
        existing = decode_rle(view.mask, *mask.shape)
        shared, smaller = int((mask & existing).sum()), min(int(mask.sum()), int(existing.sum()))
        if shared > _COPY_SHARE * max(smaller, 1):
            raise InstancesError(
                "that is fruit {number}, which is there already",
                remedy="tap the fruit itself, or delete one of the two",
                number=number,
            )


def _kept_keypoints(keypoints: Sequence[Point], mask: Mask) -> Array | None:
    """Return a fruit's keypoints if its new mask contains them, else None."""
    if not keypoints:
        return None
    points = np.array(keypoints, np.float64)
    u, v = points[:, :2].round().astype(np.int64).T
    height, width = mask.shape
    inside = mask[v.clip(0, height - 1), u.clip(0, width - 1)]
    return points if inside.mean() >= 0.5 else None


def _some(mask: Mask | None) -> Mask:
    if mask is None or np.count_nonzero(mask) < 100:
        raise InstancesError(
            "no fruit was found there", remedy="tap its middle or draw a closer box"
        )
    return mask
