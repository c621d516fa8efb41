"""Data sets made of others: merged, with masks drawn by SAM, in another form."""

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
    """Write several sets as one in the hub form.

    Classes of the same name become one. A scene's name gets its set's in front where another
    set uses it too, and so does a source that is not stated.

    Parameters
    ----------
    datasets : sequence of DataSet
        At least one.
    out : Path
        None of the sets' folders.
    link : bool
        Pictures become second names of the same files where the disk can; else copies.
    progress : callable, optional
        Called with 1 after each picture.

    Returns
    -------
    DataSet
        As it lies in `out`.

    Raises
    ------
    DataSetError
        If there are no sets, `out` is one of them, or a file is missing.
    """
    if not datasets:
        raise DataSetError("there is nothing to merge", remedy="give data sets' folders")
    if any(out.resolve() == d.folder.resolve() for d in datasets):
        raise DataSetError("is one of the sets to merge", source=out, remedy="give a new folder")
    # Their nearest common folder lets one set name the pictures of all.
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
class Drawn:
    """What `add_pseudo_masks` did.

    Parameters
    ----------
    dataset : DataSet
        The set with the masks.
    drawn : int
        Masks that were drawn.
    refused : tuple of (str, str)
        File and reason ('mask-off-box', ...) of each fruit that SAM's mask did not fit; it keeps
        its box, and is to be ignored.
    """

    dataset: DataSet
    drawn: int
    refused: tuple[tuple[str, str], ...]


def add_pseudo_masks(
    dataset: DataSet,
    segmenter: Segmenter,
    progress: Callable[[int], None] | None = None,
) -> Drawn:
    """Draw a mask for every fruit that has only a box, but in 'test', which stays as labelled.

    Parameters
    ----------
    dataset : DataSet
        Fruit with masks and labels to ignore stay as they are.
    segmenter : Segmenter
        Prompted with box and centre.
    progress : callable, optional
        Called with 1 after each picture.

    Returns
    -------
    Drawn

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
    return Drawn(replace(dataset, pictures=tuple(pictures)), drawn, tuple(refused))


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


_FORMS = ("coco", "yolo-seg", "yolo-pose", "yolo-detect")

_TASKS = {"yolo-seg": "segment", "yolo-pose": "pose", "yolo-detect": "detect"}


def parse_keep(words: Sequence[str]) -> dict[int | str, str]:
    """Read 'old=new' pairs of classes.

    Raises
    ------
    DataSetError
        If a word has no '='.

    Examples
    --------
    >>> parse_keep(["0=cucumber", "zucchini=cucumber"])
    {'0': 'cucumber', 'zucchini': 'cucumber'}
    """
    kept: dict[int | str, str] = {}
    for word in words:
        old, sign, new = word.partition("=")
        if not (sign and old.strip() and new.strip()):
            raise DataSetError(f"{word!r} is no class to keep", remedy="give OLD=NEW")
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
    """Write a set in another form.

    Parameters
    ----------
    dataset : DataSet
    out : Path
        A new folder.
    form : str
        One of `_FORMS`.
    keep : mapping of int or str to str, optional
        As in `keep_classes`; all classes without it.
    source, licence : str
        Of pictures that state none.
    link, splits, progress
        As in `write_yolo`.

    Returns
    -------
    str
        What was written, in one line.

    Raises
    ------
    DataSetError
        If there is no such form, or what `write_coco` and `write_yolo` raise.
    """
    if form not in _FORMS:
        raise DataSetError(
            f"no form is called {form!r}", remedy=f"choose one of {', '.join(_FORMS)}"
        )
    if out.resolve() == dataset.folder.resolve():
        raise DataSetError("is the set itself", source=out, remedy="give a new folder")
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
    return f"{parts}, {done.labels} labels; give Ultralytics {done.data_yaml}"
