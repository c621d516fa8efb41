"""Export the reviewed stops of a store as a labelled set for fine-tuning the detector.

Accepted, corrected and manually added detections become fruit, rejected detections become
background, and detections without a review become ignored labels.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.errors import DataSetError
from cucumbervision.perception.mask_codes import Rle
from cucumbervision.perception.masks import box_of_mask
from cucumbervision.store.images import DEPTH_UNIT_M
from cucumbervision.store.views import Verdict
from cucumbervision_lab.datasets.coco import write_coco
from cucumbervision_lab.datasets.labels import (
    SPLITS,
    DataSet,
    Label,
    LabelledPicture,
)

if TYPE_CHECKING:
    from collections.abc import Container, Iterator, Sequence

    from cucumbervision.store.records import CaptureRecord, DetectionRecord, ImageRef, StopRecord
    from cucumbervision.store.repository import Store
    from cucumbervision.store.views import DetectionView, RoundView

_SPLIT_SHARES = (0.6, 0.2, 0.2)
"""Shares of train, val and test; the latter are large because a greenhouse has few positions."""

_STRETCH_M = 1.0
"""Stops of one row within this distance show the same plants, on any day and from either side."""


@dataclass(frozen=True)
class ReviewCounts:
    """Number of detections by review outcome.

    Parameters
    ----------
    accepted, corrected, added, rejected, unjudged : int
        Numbers of detections. Corrected and added fruit are not counted as accepted.
    """

    accepted: int = 0
    corrected: int = 0
    added: int = 0
    rejected: int = 0
    unjudged: int = 0

    @property
    def corrections(self) -> int:
        """Number of manual corrections."""
        return self.corrected + self.added + self.rejected


@dataclass(frozen=True, eq=False)
class StoreSet:
    """A labelled set exported from a store.

    Parameters
    ----------
    dataset : DataSet
        The exported data set.
        judged : dict of str to ReviewCounts
        Review counts by split.
    without_picture : int
        Number of reviewed captures skipped because their pictures were not kept.
    """

    dataset: DataSet
    judged: dict[str, ReviewCounts]
    without_picture: int = 0


def dataset_from_store(
    store: Store,
    out: Path,
    *,
    licence: str = "",
    link: bool = True,
) -> StoreSet:
    """Export all captures with at least one reviewed detection in COCO format.

    Parameters
    ----------
    store : Store
        Store of rounds with pictures.
    out : Path
        Folder for `images/`, `depth/` and `annotations.json`. Pictures of an earlier export that
        are no longer used are not deleted.
    licence : str
        Licence of the pictures.
    link : bool
        Create hard links to the pictures if the file system supports them, instead of copies.

    Raises
    ------
    DataSetError
        If no detection has been reviewed, or a file is missing.
    StoreError
        If the store cannot be read.
    """
    pictures: list[LabelledPicture] = []
    counts: dict[str, Counter[str]] = {}
    lost = 0
    for one in store.rounds():
        for picture, outcomes in _reviewed_captures(store, one, licence):
            if picture is None:
                lost += 1
                continue
            pictures.append(picture)
            counts.setdefault(picture.split, Counter()).update(outcomes)
    if not pictures:
        raise DataSetError(
            "no detection whose picture was kept has been reviewed",
            source=str(store.engine.url.database),
            remedy="accept, reject, correct or add fruit in the dashboard first",
        )
    dataset = write_coco(DataSet(store.images.folder, tuple(pictures)), out, link=link)
    judged = {split: ReviewCounts(**counts[split]) for split in SPLITS if split in counts}
    return StoreSet(dataset, judged, lost)


def split_of_position(place: str, shares: Sequence[float] = _SPLIT_SHARES) -> str:
    """Return the split of a position from the hash of its name.

    The split does not depend on other positions, so it stays the same when data is added.

    Examples
    --------
    >>> [split_of_position(f"row 1, {metre} m") for metre in range(5)]
    ['train', 'train', 'test', 'val', 'train']
    """
    number = int.from_bytes(hashlib.sha256(place.encode()).digest()[:8], "big") / 2**64
    bounds = np.cumsum(shares) / np.sum(shares)
    return SPLITS[min(int(np.searchsorted(bounds, number, side="right")), len(SPLITS) - 1)]


def _position_name(house: str, stop: StopRecord) -> str:
    """Return a name shared by all stops that show the same plants."""
    if stop.row is None or stop.position_m is None:
        return f"stop {stop.key}"
    metre = np.floor(stop.position_m / _STRETCH_M) * _STRETCH_M
    return json.dumps([house, stop.row, float(metre)])


def _reviewed_captures(
    store: Store, one: RoundView, licence: str
) -> Iterator[tuple[LabelledPicture | None, Counter[str]]]:
    """Yield the reviewed captures of a round with their counts; None if the picture is missing."""
    corrected = store.corrected(one.key)
    added = {key for a in store.log(one.key, limit=None) if a.kind == "add" for key in a.fruit}
    of_stops: dict[str, dict[str, list[DetectionView]]] = {}
    for view in store.detections(one.key):
        of_stops.setdefault(view.stop_key, {}).setdefault(view.capture, []).append(view)
    for stop_key, of_captures in of_stops.items():
        if not any(_is_reviewed(view) for views in of_captures.values() for view in views):
            continue
        stop = store.stop(stop_key)
        place = _position_name(one.record.house, stop)
        for capture in stop.captures:
            views = of_captures.get(capture.name, [])
            if not any(map(_is_reviewed, views)):
                continue
            outcomes = Counter(_review_outcome(view, added) for view in views)
            if capture.color is None:
                yield None, outcomes
                continue
            first = {fruit.number: fruit for fruit in capture.fruit}
            labels = tuple(
                _label(corrected.get(view.key, first[view.record.number]), capture, view)
                for view in views
                if view.verdict is not Verdict.REJECTED
            )
            picture = LabelledPicture(
                _file(store, capture.color),
                capture.width_px,
                capture.height_px,
                labels,
                scene=place,
                split=split_of_position(place),
                source="synth" if capture.simulated else one.record.house or "own house",
                licence=licence,
                depth_file=None if capture.depth is None else _file(store, capture.depth),
                depth_unit_m=capture.depth_unit_m or DEPTH_UNIT_M,
                camera=CameraModel.model_validate(dict(capture.camera)).intrinsics,
                extras={"stop": stop_key, "capture": capture.name, **outcomes},
            )
            yield picture, outcomes


def _file(store: Store, ref: ImageRef) -> str:
    return store.images.path(ref).relative_to(store.images.folder).as_posix()


def _is_reviewed(view: DetectionView) -> bool:
    return view.verdict is not None or view.corrected


def _review_outcome(view: DetectionView, added: Container[str]) -> str:
    if view.verdict is Verdict.REJECTED:
        return "rejected"
    if view.key in added:
        return "added"
    if view.corrected:
        return "corrected"
    return "accepted" if view.verdict is Verdict.ACCEPTED else "unjudged"


def _label(record: DetectionRecord, capture: CaptureRecord, view: DetectionView) -> Label:
    box = np.array([record.box_x1_px, record.box_y1_px, record.box_x2_px, record.box_y2_px])
    code = None
    if record.mask is not None:
        code = Rle(capture.height_px, capture.width_px, record.mask)
        box = box_of_mask(code.decode())
    # A person has reviewed the mask, so it is not a pseudo-label.
    return Label(
        box,
        mask_code=code,
        cut_off="cut-by-frame" in record.flags.split(),
        ignore=not _is_reviewed(view),
    )
