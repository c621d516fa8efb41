"""Data sets made of others: merged, with masks drawn by SAM, cut into windows, in another form."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Protocol

import numpy as np

from cucumbervision.capture.files import read_color, write_jpeg
from cucumbervision.errors import DataSetError
from cucumbervision.perception.instances import Instance
from cucumbervision.perception.masks import Rle, box_of_mask
from cucumbervision_lab.datasets.bop import write_bop
from cucumbervision_lab.datasets.coco import write_coco
from cucumbervision_lab.datasets.labels import SPLITS, keep_classes, ticked
from cucumbervision_lab.datasets.yolo import write_yolo

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from cucumbervision_lab.datasets.labels import DataSet, Label, LabelledPicture

__all__ = [
    "FORMS",
    "Drawn",
    "MaskSource",
    "Window",
    "add_pseudo_masks",
    "choose_windows",
    "convert_dataset",
    "label_in",
    "merge_datasets",
    "parse_keep",
    "write_windows",
]


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
    root = _common([d.folder.resolve() for d in datasets])
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


def _common(folders: Sequence[Path]) -> Path:
    common = folders[0]
    while not all(f.is_relative_to(common) for f in folders):
        common = common.parent
    return common


class MaskSource(Protocol):
    """What draws masks: `cucumbervision.perception.sam.Segmenter`."""

    def segment(
        self, color_rgb: NDArray[np.uint8], instances: Sequence[Instance]
    ) -> tuple[Instance, ...]:
        """Return each instance with its mask, or without and why."""
        ...


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
    segmenter: MaskSource,
    *,
    splits: Sequence[str] = ("train", "val", ""),
    progress: Callable[[int], None] | None = None,
) -> Drawn:
    """Draw a mask for every fruit that has only a box.

    Parameters
    ----------
    dataset : DataSet
        Fruit with masks and labels to ignore stay as they are.
    segmenter : MaskSource
        A `Segmenter`, prompted with box and centre.
    splits : sequence of str
        Whose pictures get masks; never 'test', which stays as people labelled it.
    progress : callable, optional
        Called with 1 after each picture.

    Returns
    -------
    Drawn

    Raises
    ------
    DataSetError
        If 'test' is asked for.
    CaptureError
        If a picture cannot be read.
    """
    if "test" in splits:
        raise DataSetError(
            "masks that a network drew are no truth to test on",
            source=dataset.folder,
            remedy="leave test out",
        )
    pictures: list[LabelledPicture] = []
    refused: list[tuple[str, str]] = []
    drawn = 0
    for picture in ticked(dataset.pictures, progress):
        if picture.split in splits:
            labels, faults = _draw(dataset, picture, segmenter)
            drawn += sum(label.pseudo for label in labels) - sum(x.pseudo for x in picture.labels)
            refused += [(picture.file, fault) for fault in faults]
            picture = replace(picture, labels=labels)
        pictures.append(picture)
    return Drawn(replace(dataset, pictures=tuple(pictures)), drawn, tuple(refused))


def _draw(
    dataset: DataSet, picture: LabelledPicture, segmenter: MaskSource
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


MARGIN = 1.25  # a window's side over the longer side of the fruit that it is cut around

WHOLE = 0.9  # of a fruit's pixels in a window: another one of its own is not needed

SLIVER = 0.15  # with less of its pixels a fruit in a window is to be ignored


@dataclass(frozen=True)
class Window:
    """A part of a picture.

    Parameters
    ----------
    left, top, width, height : int
        In pixels of the picture.
    """

    left: int
    top: int
    width: int
    height: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns of the picture."""
        return (
            slice(self.top, self.top + self.height),
            slice(self.left, self.left + self.width),
        )


def choose_windows(
    rng: np.random.Generator, picture: LabelledPicture, side_px: int
) -> tuple[Window, ...]:
    """Choose windows in which every fruit of a picture lies whole at least once.

    Parameters
    ----------
    rng : numpy.random.Generator
        The source of chance.
    picture : LabelledPicture
        With boxes.
    side_px : int
        Side of a window, pixels; larger where a fruit is.

    Returns
    -------
    tuple of Window
        One where there is no fruit. None reaches beyond the picture.

    Examples
    --------
    >>> from cucumbervision_lab.datasets.labels import Label, LabelledPicture
    >>> fruit = tuple(Label(np.array([x, 10.0, x + 40, 30.0])) for x in (10.0, 60.0, 400.0))
    >>> picture = LabelledPicture("a.png", 480, 270, fruit)
    >>> windows = choose_windows(np.random.default_rng(1), picture, 128)
    >>> len(windows), {(w.width, w.height) for w in windows}
    (2, {(128, 128)})
    """
    boxes = [label.box for label in picture.labels if not label.ignore]
    if not boxes:
        return (_around(rng, picture, np.full(4, np.nan), side_px),)
    chosen: list[Window] = []
    for index in rng.permutation(len(boxes)):
        if not any(_inside(boxes[index], window) >= WHOLE for window in chosen):
            chosen.append(_around(rng, picture, boxes[index], side_px))
    return tuple(chosen)


def _around(
    rng: np.random.Generator, picture: LabelledPicture, box: NDArray[np.float64], side_px: int
) -> Window:
    """Put a window somewhere about a box, or anywhere."""
    placed = []
    long_px = 0.0 if np.isnan(box[0]) else float(max(box[2] - box[0], box[3] - box[1]))
    side = max(side_px, round(MARGIN * long_px))
    for axis, whole in enumerate((picture.width, picture.height)):
        size = min(side, whole)
        first, last = 0, whole - size
        if not np.isnan(box[0]):
            first = max(first, int(np.ceil(box[2 + axis] + 0.5)) - size)
            last = min(last, int(np.floor(box[axis] + 0.5)))
        placed.append((int(rng.integers(first, max(first, last) + 1)), size))
    (left, width), (top, height) = placed
    return Window(left, top, width, height)


def _inside(box: NDArray[np.float64], window: Window) -> float:
    """Return the share of a box that lies in a window."""
    edges = box + 0.5
    low = np.maximum(edges[:2], (window.left, window.top))
    high = np.minimum(edges[2:], (window.left + window.width, window.top + window.height))
    return float(np.maximum(high - low, 0).prod() / max((edges[2:] - edges[:2]).prod(), 1e-9))


def label_in(label: Label, window: Window) -> Label | None:
    """Return a label as a window shows it, or None where it shows nothing of the fruit.

    Parameters
    ----------
    label : Label
        Of the picture.
    window : Window
        Part of that picture.

    Returns
    -------
    Label or None
        In pixels of the window. Points outside are not labelled any more. A fruit of which less
        than 0.15 is left is to be ignored; one of which something is left out is cut off, and
        loses its lengths.

    Examples
    --------
    >>> from cucumbervision_lab.datasets.labels import Label
    >>> mask = np.zeros((20, 40), bool)
    >>> mask[5:10, 10:30] = True
    >>> cut = label_in(Label.of_mask(mask), Window(20, 0, 20, 20))
    >>> cut.box.tolist(), cut.cut_off, cut.ignore
    ([-0.5, 4.5, 9.5, 9.5], True, False)
    """
    mask, amodal = label.mask, label.amodal
    part = None if mask is None else mask[window.slices]
    if part is not None and mask is not None:
        share = float(np.count_nonzero(part)) / max(int(np.count_nonzero(mask)), 1)
    else:
        share = _inside(label.box, window)
    if share == 0:
        return None
    whole_part = None if amodal is None else amodal[window.slices]
    cut = label.cut_off or _inside(label.box, window) < 1
    if whole_part is not None and amodal is not None:
        cut = cut or int(np.count_nonzero(whole_part)) < int(np.count_nonzero(amodal))
    high = np.array([window.width - 0.5, window.height - 0.5])
    moved = (label.box.reshape(2, 2) - (window.left, window.top)).clip(-0.5, high).ravel()
    return replace(
        label,
        box=moved if part is None else box_of_mask(part),
        mask_code=None if part is None else Rle.of(part),
        amodal_code=None if whole_part is None else Rle.of(whole_part),
        keypoints=_points_in(label.keypoints, window),
        cut_off=cut,
        ignore=label.ignore or share < SLIVER,
        extras={} if cut else label.extras,
    )


def _points_in(keypoints: NDArray[np.float64] | None, window: Window) -> NDArray[np.float64] | None:
    if keypoints is None:
        return None
    points = keypoints - (window.left, window.top, 0.0)
    size = np.array([window.width, window.height])
    outside = ((points[:, :2] < -0.5) | (points[:, :2] > size - 0.5)).any(axis=1)
    points[outside] = 0.0
    return points


def write_windows(
    dataset: DataSet,
    out: Path,
    side_px: int,
    *,
    splits: Sequence[str] = ("train",),
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> DataSet:
    """Cut windows around the fruit of a set and write them as a set of their own.

    Parameters
    ----------
    dataset : DataSet
        With boxes, and masks and keypoints where there are some. Depth and cameras are left out.
    out : Path
        New folder.
    side_px : int
        Side of a window, pixels.
    splits : sequence of str
        Whose pictures are cut; windows are to train on, and nothing is tested on them.
    seed : int
        The same seed cuts the same windows.
    progress : callable, optional
        Called with 1 after each picture.

    Returns
    -------
    DataSet
        A window's scene, source and licence are its picture's.

    Raises
    ------
    DataSetError
        If the side is under 32 pixels, or a file cannot be written.
    CaptureError
        If a picture cannot be read.
    """
    if side_px < 32:
        raise DataSetError(f"a window of {side_px} px is too small", remedy="give 32 or more")
    pictures: list[LabelledPicture] = []
    for index, picture in enumerate(ticked(dataset.pictures, progress)):
        if picture.split in splits:
            rng = np.random.default_rng([seed, index])
            pictures += _cut(dataset, picture, choose_windows(rng, picture, side_px), out)
    return write_coco(replace(dataset, folder=out, pictures=tuple(pictures)), out)


def _cut(
    dataset: DataSet, picture: LabelledPicture, windows: Sequence[Window], out: Path
) -> Iterator[LabelledPicture]:
    color = read_color(dataset.path(picture))
    path = PurePosixPath(picture.file)
    for number, window in enumerate(windows):
        file = path.with_name(f"{path.stem}-w{number}.jpg")
        (out / file).parent.mkdir(parents=True, exist_ok=True)
        write_jpeg(out / file, color[window.slices])
        labels = (label_in(label, window) for label in picture.labels)
        yield replace(
            picture,
            file=str(file),
            width=window.width,
            height=window.height,
            labels=tuple(label for label in labels if label is not None),
            depth_file=None,
            camera=None,
            extras={},
        )


FORMS = ("coco", "yolo-seg", "yolo-pose", "yolo-detect", "bop")

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
    paint_ignored: Sequence[str] = ("train",),
    progress: Callable[[int], None] | None = None,
) -> str:
    """Write a set in another form.

    Parameters
    ----------
    dataset : DataSet
    out : Path
        A new folder.
    form : str
        One of `FORMS`.
    keep : mapping of int or str to str, optional
        As in `keep_classes`; all classes without it.
    source, licence : str
        Of pictures that state none.
    link, splits, paint_ignored, progress
        As in `write_yolo`.

    Returns
    -------
    str
        What was written, in one line.

    Raises
    ------
    DataSetError
        If there is no such form, or what `write_coco`, `write_yolo` and `write_bop` raise.
    """
    if form not in FORMS:
        raise DataSetError(
            f"no form is called {form!r}", remedy=f"choose one of {', '.join(FORMS)}"
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
    if form == "bop":
        scenes = write_bop(dataset, out, link=link, progress=progress)
        return f"{len(dataset.pictures)} pictures in {len(scenes)} scenes in {out}"
    done = write_yolo(
        dataset,
        out,
        _TASKS[form],
        splits=splits,
        link=link,
        paint_ignored=paint_ignored,
        progress=progress,
    )
    parts = ", ".join(f"{count} {split}" for split, count in done.pictures.items())
    return (
        f"{parts}, {done.labels} labels, {done.painted} pictures painted over in part, "
        f"{done.filled_holes} holes filled; give Ultralytics {done.data_yaml}"
    )
