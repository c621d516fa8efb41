"""Merge data sets, add masks by SAM, and convert between formats."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from cucumbervision.capture.pictures import read_color
from cucumbervision.errors import DataSetError
from cucumbervision.perception.instances import Instance
from cucumbervision.perception.mask_codes import Rle
from cucumbervision_lab.datasets.coco import write_coco
from cucumbervision_lab.datasets.labels import SPLITS, keep_classes, ticked
from cucumbervision_lab.datasets.yolo import write_yolo

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from cucumbervision.perception.networks import Segmenter
    from cucumbervision_lab.datasets.labels import DataSet, Label, LabelledPicture


def merge_datasets(
    datasets: Sequence[DataSet],
    out: Path,
    *,
    link: bool = True,
    progress: Callable[[int], None] | None = None,
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
    link : bool
        Create hard links to the pictures if the file system supports them, instead of copies.
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
        again = {s: f"{title}-{number}/{s}" if s in taken else s for s in scenes}
        taken |= set(again.values())
        for picture in dataset.pictures:
            depth = picture.depth_file
            pictures.append(
                replace(
                    picture,
                    file=(prefix / picture.file).as_posix(),
                    depth_file=None if depth is None else (prefix / depth).as_posix(),
                    scene=again.get(picture.scene, ""),
                    source=picture.source or title,
                    labels=tuple(
                        replace(x, category=names.index(dataset.categories[x.category]))
                        for x in picture.labels
                    ),
                )
            )
    whole = replace(
        datasets[0], folder=root, pictures=tuple(pictures), categories=tuple(names), refused=()
    )
    return write_coco(whole, out, link=link, progress=progress)


@dataclass(frozen=True, eq=False)
class PseudoMasks:
    """Result of `add_pseudo_masks`.

    Parameters
    ----------
    dataset : DataSet
        The data set with masks.
    drawn : int
        Number of added masks.
    refused : tuple of (str, str)
        File and reason ('mask-off-box', ...) of each fruit whose mask was rejected. The fruit keeps
        its box and is ignored.
    """

    dataset: DataSet
    drawn: int
    refused: tuple[tuple[str, str], ...]


def add_pseudo_masks(
    dataset: DataSet,
    segmenter: Segmenter,
    progress: Callable[[int], None] | None = None,
) -> PseudoMasks:
    """Add masks by SAM to all fruit that have only a box, except in the split 'test'.

    Parameters
    ----------
    dataset : DataSet
        Labels with masks and ignored labels are not changed.
    segmenter : Segmenter
        Segmenter, prompted with box and centre.
    progress : callable, optional
        Called with 1 after each picture.

    Returns
    -------
    PseudoMasks
        The data set with masks, and the rejected ones.

    Raises
    ------
    CaptureError
        If a picture cannot be read.
    """
    pictures: list[LabelledPicture] = []
    refused: list[tuple[str, str]] = []
    drawn = 0
    for picture in ticked(dataset.pictures, progress):
        if picture.split != "test":
            labels, faults = _draw(dataset, picture, segmenter)
            drawn += sum(label.pseudo for label in labels) - sum(x.pseudo for x in picture.labels)
            refused += [(picture.file, fault) for fault in faults]
            picture = replace(picture, labels=labels)
        pictures.append(picture)
    return PseudoMasks(replace(dataset, pictures=tuple(pictures)), drawn, tuple(refused))


def _draw(
    dataset: DataSet, picture: LabelledPicture, segmenter: Segmenter
) -> tuple[tuple[Label, ...], list[str]]:
    wanted = [k for k, x in enumerate(picture.labels) if x.mask_code is None and not x.ignore]
    if not wanted:
        return picture.labels, []
    color = read_color(dataset.path(picture))
    boxes = [Instance(picture.labels[k].box) for k in wanted]
    labels, faults = list(picture.labels), []
    for k, found in zip(wanted, segmenter.segment(color, boxes), strict=True):
        if found.mask is None:
            faults.append(found.mask_failure)
            labels[k] = replace(labels[k], ignore=True)
        else:
            labels[k] = replace(labels[k], mask_code=Rle.of(found.mask), pseudo=True)
    return tuple(labels), faults


_FORMATS = ("coco", "yolo-seg", "yolo-pose", "yolo-detect")

_TASKS = {"yolo-seg": "segment", "yolo-pose": "pose", "yolo-detect": "detect"}


def parse_keep(words: Sequence[str]) -> dict[int | str, str]:
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
    kept: dict[int | str, str] = {}
    for word in words:
        old, sign, new = word.partition("=")
        if not (sign and old.strip() and new.strip()):
            raise DataSetError(f"invalid class mapping {word!r}", remedy="give OLD=NEW")
        kept[old.strip()] = new.strip()
    return kept


def convert_dataset(
    dataset: DataSet,
    out: Path,
    form: str,
    *,
    keep: Mapping[int | str, str] | None = None,
    source: str = "",
    licence: str = "",
    link: bool = True,
    splits: Sequence[str] = SPLITS,
    progress: Callable[[int], None] | None = None,
) -> str:
    """Write a data set in another format.

    Parameters
    ----------
    dataset : DataSet
        Data set to convert.
    out : Path
        New output folder.
    form : str
        One of `_FORMATS`.
    keep : mapping of int or str to str, optional
        Class mapping, see `keep_classes`; by default all classes are kept.
    source, licence : str
        Defaults for pictures without source or licence.
    link, splits, progress
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
    if form not in _FORMATS:
        raise DataSetError(f"unknown format {form!r}", remedy=f"use one of {', '.join(_FORMATS)}")
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
        written = write_coco(dataset, out, link=link, progress=progress)
        labels = sum(len(p.labels) for p in written.pictures)
        return f"{len(written.pictures)} pictures, {labels} labels in {out}"
    done = write_yolo(dataset, out, _TASKS[form], splits=splits, link=link, progress=progress)
    parts = ", ".join(f"{count} {split}" for split, count in done.pictures.items())
    return f"{parts}, {done.labels} labels; data file for Ultralytics: {done.data_yaml}"
