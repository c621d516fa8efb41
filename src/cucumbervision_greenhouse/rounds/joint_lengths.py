"""Measure fruit that several stops show from all these views together.

One tube is fitted to the stored depth and outlines. The result is kept for each set of views; a set
that changes (another view, a corrected mask, a moved stop) is measured again. Without a reliable
joint fit, the fruit has the pooled length of its views (`matching.pooled_length`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from cucumbervision.calibration.calibration_file import calibrated_fruit
from cucumbervision.errors import InstancesError, StoredImageError
from cucumbervision.measurement.flags import Flag
from cucumbervision.measurement.matching import ALONG
from cucumbervision.measurement.result import LengthDefinition
from cucumbervision.measurement.views import FruitView, measure_views
from cucumbervision.pipeline.measurer import Boundary, Failure
from cucumbervision_greenhouse.rounds.from_store import joint_groups, read_round
from cucumbervision_greenhouse.rounds.poses import MIDDLE_SD_M, stored_pose
from cucumbervision_greenhouse.rounds.stop_records import (
    fruit_record,
    instance_of,
    stored_calibration,
    stored_capture,
)
from cucumbervision_greenhouse.store.records import JointRecord

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cucumbervision.calibration.calibration_file import SiteCalibration
    from cucumbervision.capture.frames import Capture
    from cucumbervision.measurement.views import JointFruit
    from cucumbervision_greenhouse.rounds.from_store import RoundContent
    from cucumbervision_greenhouse.store.records import DetectionRecord, StopRecord
    from cucumbervision_greenhouse.store.repository import Store
    from cucumbervision_greenhouse.store.views import DetectionSummary

Report: TypeAlias = Callable[[int, int], None]

_SAVED_AT_ONCE = 20  # saved in batches, so that a program that ends loses little
_STOPS_KEPT = 24  # in memory, with their pictures

_ENDED, _NOT_MEASURED, _NO_PICTURE = "end-hidden", "not-measured", "no-picture"
_MIXED = "measured-differently"


@dataclass(frozen=True)
class JointRun:
    """The joint measurements of one run.

    Parameters
    ----------
    fruit : int
        Number of fruit that were processed.
    failures : tuple of Failure
        What went wrong with some of them; they are looked at again the next time.
    """

    fruit: int = 0
    failures: tuple[Failure, ...] = ()


def measure_jointly(
    store: Store,
    round_key: str,
    report: Report | None = None,
    interrupted: Callable[[], bool] | None = None,
) -> JointRun:
    """Measure the fruit of a merged round that several stops show, as far as it is not done.

    Parameters
    ----------
    store : Store
        Where the round is; without a folder of pictures nothing is measured.
    round_key : str
        The round.
    report : callable, optional
        Given how many of how many are done; for progress bars.
    interrupted : callable, optional
        Asked before each fruit; if true, the rest is left for the next call.

    Returns
    -------
    JointRun
        What was done now.

    Raises
    ------
    StoreError
        If the round is not there.
    """
    if not store.has_images:
        return JointRun()
    content = read_round(store, round_key)
    groups = joint_groups(content)
    waiting = [(key, views) for key, views in groups.items() if key not in content.joint]
    waiting.sort(key=lambda fruit: (fruit[1][0].row or "", fruit[1][0].along_m or 0.0))
    source = _Source(store, content)
    done: list[JointRecord] = []
    failures: list[Failure] = []
    count = 0
    for key, views in waiting:
        if interrupted is not None and interrupted():
            break
        count += 1
        # An error of one fruit leaves its views' lengths, and the loop continues.
        with Boundary(failures, store.name, f"fruit {views[0].key[:8]} in {len(views)} views"):
            done.append(source.measured(key, views))
        if report is not None:
            report(count, len(waiting))
        if len(done) == _SAVED_AT_ONCE:
            store.save_joint(round_key, done, groups.keys())
            done = []
    if done or content.joint.keys() - groups.keys():
        store.save_joint(round_key, done, groups.keys())
    return JointRun(count, tuple(failures))


@dataclass(frozen=True, eq=False)
class _StoredView:
    """One view with all its stored data."""

    view: DetectionSummary
    record: DetectionRecord
    stop: StopRecord
    capture: Capture

    def as_seen(self, pose: NDArray[np.float64]) -> FruitView:
        instance = instance_of(self.record, (self.capture.height, self.capture.width))
        return FruitView(self.capture, instance, pose, shift_sd_m=MIDDLE_SD_M)

    @property
    def site(self) -> SiteCalibration | None:
        """The site's calibration that it was measured with."""
        return stored_calibration(self.stop)

    @property
    def definition(self) -> LengthDefinition:
        """The definition of length that was configured."""
        options = [
            artifact.details for artifact in self.stop.artifacts if artifact.kind == "config"
        ]
        asked = options[0].get("length") if options else None
        kind = self.record.length and self.record.length.kind
        return LengthDefinition(asked or kind or LengthDefinition.CENTRELINE)


class _Source:
    """Reads the stored data of a round's views, each stop once."""

    def __init__(self, store: Store, content: RoundContent) -> None:
        self._corrected = store.corrected(content.key)
        self._content, self._images = content, store.images
        self._stops = content.stop_of
        self._read_stop = lru_cache(_STOPS_KEPT)(store.stop)
        self._read_capture = lru_cache(_STOPS_KEPT)(self._capture)

    def measured(self, key: str, views: Sequence[DetectionSummary]) -> JointRecord:
        """Return the joint measurement of some views, or why there is none."""
        first = views[0].key
        try:
            stored = [self._stored(view) for view in views]
            site, definition = stored[0].site, stored[0].definition
            if any((view.site, view.definition) != (site, definition) for view in stored):
                return JointRecord(key, first, 0, _MIXED)
            scale_known = site is not None and site.depth_scale is not None
            fruit_views = [view.as_seen(self._pose(view.view)) for view in stored]
            joint = measure_views(fruit_views, definition, scale_known=scale_known)
        except (StoredImageError, InstancesError):
            return JointRecord(key, first, 0, _NO_PICTURE)
        if joint is None or len(joint.poses) < 2 or joint.fruit.selected is None:
            return JointRecord(key, first, 0, _NOT_MEASURED)
        return _joint_record(key, stored, joint, site, definition)

    def _stored(self, view: DetectionSummary) -> _StoredView:
        stop = self._read_stop(view.stop_key)
        number, capture = view.record.number, self._read_capture(view.stop_key, view.capture)
        taken = next(capture for capture in stop.captures if capture.name == view.capture)
        original = next(fruit for fruit in taken.fruit if fruit.number == number)
        return _StoredView(view, self._corrected.get(view.key, original), stop, capture)

    def _capture(self, stop_key: str, name: str) -> Capture:
        stop = self._read_stop(stop_key)
        taken = next(capture for capture in stop.captures if capture.name == name)
        return stored_capture(self._images, taken, stop)

    def _pose(self, view: DetectionSummary) -> NDArray[np.float64]:
        """Return the camera's pose, put where merging found the stop to be."""
        stop = self._stops[view.stop_key]
        pose = stored_pose(self._content.cameras[view.stop_key].pose, view.side)
        at_m = stop.position_m if stop.fitted_m is None else stop.fitted_m
        if at_m is not None:
            pose[ALONG, 3] = at_m
        return pose


def _joint_record(
    key: str,
    stored: Sequence[_StoredView],
    joint: JointFruit,
    site: SiteCalibration | None,
    definition: LengthDefinition,
) -> JointRecord:
    fruit, first = joint.fruit, stored[joint.first]
    doubts = {doubt for view in stored for doubt in view.capture.doubts}
    fruit = fruit.flagged(*(Flag(doubt) for doubt in sorted(doubts)))
    if site is not None:
        fruit = calibrated_fruit(fruit, site, definition)
    record = fruit_record(first.capture, first.record.number, fruit)
    poses = {
        stored[k].view.key: tuple(pose.round(9).ravel().tolist()) for k, pose in joint.poses.items()
    }
    reason = _ENDED if record.partial else "ok"
    return JointRecord(
        key=key,
        first=first.view.key,
        views=len(poses),
        reason=reason,
        record=replace(record, mask=None, keypoints=()),
        poses=poses,
    )
