"""Make data sets from others or from a store: merged, masks drawn by SAM, another form.

Accepted, corrected and manually added detections become fruit, rejected detections become
background, and detections without a review become ignored labels.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.pictures import read_color
from cucumbervision.errors import DataSetError
from cucumbervision.fruit.instance import Instance
from cucumbervision.fruit.mask_codes import Rle
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision_greenhouse.store.images import DEPTH_UNIT_M
from cucumbervision_greenhouse.store.records import Verdict
from cucumbervision_lab.arrays import Progress
from cucumbervision_lab.data.coco import write_coco
from cucumbervision_lab.data.labels import (
    SPLITS,
    DataSet,
    Label,
    LabelledPicture,
    keep_classes,
    ticked,
)
from cucumbervision_lab.data.yolo import write_yolo

if TYPE_CHECKING:
    from collections.abc import Container, Iterator, Mapping, Sequence

    from cucumbervision.networks.find import NetworkSegmenter
    from cucumbervision_greenhouse.store.records import CaptureRecord, FruitRow, Round, StopRecord
    from cucumbervision_greenhouse.store.repository import Store


def merge_datasets(
    datasets: Sequence[DataSet], out: Path, *, progress: Progress | None = None
) -> DataSet:
    """Merge data sets and write the result in COCO format.

    Classes with the same name are merged. Scene names that occur in several sets are prefixed with
    the name of the set. Pictures without a source get the name of their set.

    Parameters
    ----------
    datasets : sequence of DataSet
        At least one.
    out : Path
        Output folder, different from those of the sets.
    progress : callable, optional
        Called with 1 after each picture.

    Returns
    -------
    DataSet
        The merged data set in `out`.

    Raises
    ------
    DataSetError
        If `datasets` is empty, `out` is the folder of one of them, or a file is missing.
    """
    if not datasets:
        raise DataSetError("nothing to merge", remedy="give the folders of data sets")
    if any(out.resolve() == d.folder.resolve() for d in datasets):
        raise DataSetError("is one of the sets to merge", source=out, remedy="give a new folder")
    # Picture names of the merged set are relative to the common parent folder.
    root = Path(os.path.commonpath([d.folder.resolve() for d in datasets]))
    names = list(dict.fromkeys(name for d in datasets for name in d.categories))
    taken: set[str] = set()
    pictures = []
    for number, dataset in enumerate(datasets, 1):
        prefix = dataset.folder.resolve().relative_to(root)
        title = dataset.folder.resolve().name
        scenes = {p.scene for p in dataset.pictures if p.scene}
        renamed = {s: f"{title}-{number}/{s}" if s in taken else s for s in scenes}
        taken |= set(renamed.values())
        for picture in dataset.pictures:
            depth = picture.depth_file
            pictures.append(
                replace(
                    picture,
                    file=(prefix / picture.file).as_posix(),
                    depth_file=None if depth is None else (prefix / depth).as_posix(),
                    scene=renamed.get(picture.scene, ""),
                    source=picture.source or title,
                    labels=tuple(
                        replace(x, category=names.index(dataset.categories[x.category]))
                        for x in picture.labels
                    ),
                )
            )
    merged = replace(
        datasets[0], folder=root, pictures=tuple(pictures), categories=tuple(names), refused=()
    )
    return write_coco(merged, out, progress=progress)


def add_pseudo_masks(
    dataset: DataSet, segmenter: NetworkSegmenter, progress: Progress | None = None
) -> tuple[DataSet, list[tuple[str, str]]]:
    """Add masks by SAM to all fruit that have only a box, except in the split 'test'.

    Parameters
    ----------
    dataset : DataSet
        Labels with masks and ignored labels are not changed.
    segmenter : NetworkSegmenter
        NetworkSegmenter, prompted with box and centre.
    progress : callable, optional
        Called with 1 after each picture.

    Returns
    -------
    dataset : DataSet
        The data set with masks.
    refused : list of (str, str)
        File and reason ('mask-off-box', ...) of each fruit whose mask was rejected. The fruit keeps
        its box and is ignored.

    Raises
    ------
    CaptureError
        If a picture cannot be read.
    """
    pictures: list[LabelledPicture] = []
    refused: list[tuple[str, str]] = []
    for picture in ticked(dataset.pictures, progress):
        if picture.split != "test":
            labels, faults = _draw(dataset, picture, segmenter)
            refused += [(picture.file, fault) for fault in faults]
            picture = replace(picture, labels=labels)
        pictures.append(picture)
    return replace(dataset, pictures=tuple(pictures)), refused


def _draw(
    dataset: DataSet, picture: LabelledPicture, segmenter: NetworkSegmenter
) -> tuple[tuple[Label, ...], list[str]]:
    missing = [k for k, x in enumerate(picture.labels) if x.mask_code is None and not x.ignore]
    if not missing:
        return picture.labels, []
    color = read_color(dataset.path(picture))
    boxes = [Instance(picture.labels[k].box) for k in missing]
    labels, faults = list(picture.labels), []
    for k, outline in zip(missing, segmenter.segment(color, boxes), strict=True):
        if outline.mask is None:
            faults.append(outline.mask_failure)
            labels[k] = replace(labels[k], ignore=True)
        else:
            labels[k] = replace(labels[k], mask_code=Rle.of(outline.mask), pseudo=True)
    return tuple(labels), faults


_TASKS = {"coco": "", "yolo-seg": "segment", "yolo-pose": "pose", "yolo-detect": "detect"}
"""Formats, with the task of YOLO's."""


def parse_keep(words: Sequence[str]) -> dict[str, str]:
    """Parse 'old=new' pairs of class names.

    Raises
    ------
    DataSetError
        If a pair is incomplete.

    Examples
    --------
    >>> parse_keep(["0=cucumber", "zucchini=cucumber"])
    {'0': 'cucumber', 'zucchini': 'cucumber'}
    """
    renames: dict[str, str] = {}
    for word in words:
        old, sign, new = word.partition("=")
        if not (sign and old.strip() and new.strip()):
            raise DataSetError(f"invalid class mapping {word!r}", remedy="give OLD=NEW")
        renames[old.strip()] = new.strip()
    return renames


def convert_dataset(
    dataset: DataSet,
    out: Path,
    form: str,
    *,
    keep: Mapping[str, str] | None = None,
    source: str = "",
    licence: str = "",
    splits: Sequence[str] = SPLITS,
    progress: Progress | None = None,
) -> str:
    """Write a data set in another format.

    Parameters
    ----------
    dataset : DataSet
        Data set to convert.
    out : Path
        New output folder.
    form : str
        'coco', 'yolo-seg', 'yolo-pose' or 'yolo-detect'.
    keep : mapping of int or str to str, optional
        Class mapping, see `keep_classes`; by default all classes are kept.
    source, licence : str
        Defaults for pictures without source or licence.
    splits, progress
        See `write_yolo`.

    Returns
    -------
    str
        Summary in one line.

    Raises
    ------
    DataSetError
        If the format is unknown, or as in `write_coco` and `write_yolo`.
    """
    if form not in _TASKS:
        raise DataSetError(f"unknown format {form!r}", remedy=f"use one of {', '.join(_TASKS)}")
    if out.resolve() == dataset.folder.resolve():
        raise DataSetError("is the folder of the input", source=out, remedy="give a new folder")
    pictures = tuple(
        replace(p, source=p.source or source, licence=p.licence or licence)
        for p in dataset.pictures
    )
    dataset = replace(dataset, pictures=pictures)
    if keep:
        dataset = keep_classes(dataset, keep)
    if form == "coco":
        written = write_coco(dataset, out, progress=progress)
        labels = sum(len(p.labels) for p in written.pictures)
        return f"{len(written.pictures)} pictures, {labels} labels in {out}"
    counts, lines = write_yolo(dataset, out, _TASKS[form], splits=splits, progress=progress)
    parts = ", ".join(f"{count} {split}" for split, count in counts.items())
    return f"{parts}, {lines} labels; data file for Ultralytics: {out / 'data.yaml'}"


_SPLIT_SHARES = (0.6, 0.2, 0.2)
"""Shares of train, val and test; the latter are large because a greenhouse has few positions."""

_STRETCH_M = 1.0
"""Stops of one row within this distance show the same plants, on any day and from either side."""


def dataset_from_store(
    store: Store, out: Path, *, licence: str = ""
) -> tuple[DataSet, dict[str, Counter[str]], int]:
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

    Returns
    -------
    dataset : DataSet
        The exported data set.
    judged : dict of str to Counter
        Number of detections that were accepted, corrected, added, rejected and unjudged, by split.
    without_picture : int
        Number of reviewed captures skipped because their pictures were not kept.

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
    for round_summary in store.rounds():
        for picture, outcomes in _reviewed_captures(store, round_summary, licence):
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
    dataset = write_coco(DataSet(store.images.folder, tuple(pictures)), out)
    judged = {split: counts[split] for split in SPLITS if split in counts}
    return dataset, judged, lost


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
    store: Store, round_summary: Round, licence: str
) -> Iterator[tuple[LabelledPicture | None, Counter[str]]]:
    """Yield the reviewed captures of a round with their counts; None if the picture is missing."""
    added = {
        key for a in store.log(round_summary.key, limit=None) if a.kind == "add" for key in a.fruit
    }
    of_stops: dict[str, dict[str, list[FruitRow]]] = {}
    for view in store.detections(round_summary.key, shapes=True):
        of_stops.setdefault(view.stop_key, {}).setdefault(view.capture, []).append(view)
    for stop_key, of_captures in of_stops.items():
        if not any(_is_reviewed(view) for views in of_captures.values() for view in views):
            continue
        stop = store.stop(stop_key)
        place = _position_name(round_summary.house, stop)
        for capture in stop.captures:
            views = of_captures.get(capture.name, [])
            if not any(map(_is_reviewed, views)):
                continue
            outcomes = Counter(_review_outcome(view, added) for view in views)
            if capture.color is None:
                yield None, outcomes
                continue
            labels = tuple(
                _label(view, capture) for view in views if view.verdict is not Verdict.REJECTED
            )
            picture = LabelledPicture(
                _file(store, capture.color),
                capture.width_px,
                capture.height_px,
                labels,
                scene=place,
                split=split_of_position(place),
                source="synth" if capture.simulated else round_summary.house or "own house",
                licence=licence,
                depth_file=None if capture.depth is None else _file(store, capture.depth),
                depth_unit_m=capture.depth_unit_m or DEPTH_UNIT_M,
                camera=CameraModel.model_validate(dict(capture.camera)).intrinsics,
                extras={"stop": stop_key, "capture": capture.name, **outcomes},
            )
            yield picture, outcomes


def _file(store: Store, name: str) -> str:
    return store.images.path(name).relative_to(store.images.folder).as_posix()


def _is_reviewed(view: FruitRow) -> bool:
    return view.verdict is not None or view.corrected


def _review_outcome(view: FruitRow, added: Container[str]) -> str:
    if view.verdict is Verdict.REJECTED:
        return "rejected"
    if view.key in added:
        return "added"
    if view.corrected:
        return "corrected"
    return "accepted" if view.verdict is Verdict.ACCEPTED else "unjudged"


def _label(view: FruitRow, capture: CaptureRecord) -> Label:
    box = np.array([view.box_x1_px, view.box_y1_px, view.box_x2_px, view.box_y2_px])
    code = None
    if view.mask is not None:
        code = Rle(capture.height_px, capture.width_px, view.mask)
        box = box_of_mask(code.decode())
    # A person has reviewed the mask, so it is not a pseudo-label.
    return Label(
        box,
        mask_code=code,
        cut_off="cut-by-frame" in view.flags.split(),
        ignore=not _is_reviewed(view),
    )
