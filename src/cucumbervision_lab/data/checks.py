"""Check data sets for invalid files, labels, classes and splits, and for leakage across splits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from cucumbervision.errors import CucumberVisionError, DataSetError
from cucumbervision_lab.arrays import Progress
from cucumbervision_lab.data import splits
from cucumbervision_lab.data.coco import coco_files, read_coco
from cucumbervision_lab.data.labels import SPLITS, DataSet, Label, LabelledPicture, picture_size
from cucumbervision_lab.data.yolo import read_yolo

# Stricter than when scenes are searched. Photos of different scenes share at most 31 corners, and
# those were taken at the same place.
_LEAK_CORNERS = 25
_LEAK_COLOR = 0.2
_SLACK_PX = 0.51
_BY_SCENE = "split by scene: cucumbervision data split"


def require_clean(findings: Sequence[CucumberVisionError], source: object) -> None:
    """Raise an error if a data set has faults.

    Raises
    ------
    DataSetError
        With the first fault and the number of further ones.
    """
    if findings:
        count = f" (and {len(findings) - 1} more)" if len(findings) > 1 else ""
        raise DataSetError(
            f"{findings[0]}{count}", source=source, remedy="list all: cucumbervision data check"
        )


def open_dataset(path: Path, names: Sequence[str] = ()) -> DataSet:
    """Read a data set in COCO or YOLO format.

    Raises
    ------
    DataSetError
        If the format is not recognised.
    """
    if not path.exists():
        raise DataSetError("folder not found", source=path, remedy="check the path")
    is_coco = path.suffix.lower() == ".json" if path.is_file() else bool(coco_files(path))
    return read_coco(path) if is_coco else read_yolo(path, names)


def check_dataset(
    dataset: DataSet, *, duplicates: bool = True, progress: Progress | None = None
) -> list[CucumberVisionError]:
    """Find all faults of a data set.

    Parameters
    ----------
    dataset : DataSet
        Data set to check.
    duplicates : bool
        Also compare the pictures to find duplicates across splits, about 10 ms per picture.
    progress : callable, optional
        Called with 1 after each compared picture.

    Returns
    -------
    list of CucumberVisionError
        Faults found by the reader come first.
    """
    findings = list(dataset.refused)
    for picture in dataset.pictures:
        findings += picture_faults(dataset, picture)
    findings += [*_class_faults(dataset), *_split_faults(dataset), *_scene_leaks(dataset)]
    if duplicates:
        findings += _duplicate_leaks(dataset, progress)
    # A picture that cannot be read is found twice.
    return list({str(finding): finding for finding in findings}.values())


def picture_faults(dataset: DataSet, picture: LabelledPicture) -> Iterator[CucumberVisionError]:
    """Yield the faults of a picture's files and labels."""
    depth = picture.depth_file
    if depth is not None and not (dataset.folder / depth).is_file():
        yield DataSetError("the file is missing", source=depth, remedy="copy the data set again")
    try:
        size = picture_size(dataset.path(picture))
    except CucumberVisionError as error:
        yield error
    else:
        if size != (picture.width, picture.height):
            labelled = f"{picture.width}x{picture.height}"
            fault = f"is {size[0]}x{size[1]}, but its labels are for {labelled}"
            yield DataSetError(fault, source=picture.file, remedy="restore the labelled picture")
    for k, label in enumerate(picture.labels):
        where = f"{picture.file}, label {k + 1}"
        for fault in _label_faults(label, picture, len(dataset.categories)):
            yield DataSetError(fault, source=where, remedy="correct it")
        if label.pseudo and not label.ignore and picture.split == "test":
            fault = "the test split contains a pseudo-label"
            yield DataSetError(fault, source=where, remedy="move its scene to train")


def _label_faults(label: Label, picture: LabelledPicture, categories: int) -> Iterator[str]:
    x1, y1, x2, y2 = label.box
    if not np.isfinite(label.box).all() or x2 <= x1 or y2 <= y1:
        yield "its box has no area"
    elif min(x1, y1) < -_SLACK_PX or x2 > picture.width or y2 > picture.height:
        yield f"its box extends beyond the picture of {picture.width}x{picture.height}"
    if not 0 <= label.category < categories:
        yield f"its category {label.category} has no name"
    for code in (label.mask_code, label.amodal_code):
        if code is not None and (code.width, code.height) != (picture.width, picture.height):
            yield f"has a mask of {code.width}x{code.height}"
    points = label.keypoints
    if points is None:
        return
    if points.shape != (5, 3) or not np.isfinite(points).all():
        yield "its keypoints are not 5 x 3 finite numbers"
    else:
        visible = points[points[:, 2] > 0, :2]
        limit = np.array([picture.width, picture.height]) - 1 + _SLACK_PX
        if (visible < -_SLACK_PX).any() or (visible > limit).any():
            yield "a labelled keypoint lies outside the picture"


def _class_faults(dataset: DataSet) -> Iterator[DataSetError]:
    used = {label.category for p in dataset.pictures for label in p.labels if not label.ignore}
    for k, name in enumerate(dataset.categories):
        if k not in used:
            remedy = "remove the class or label it"
            yield DataSetError(
                f"the class '{name}' has no label", source=dataset.folder, remedy=remedy
            )


def _split_faults(dataset: DataSet) -> Iterator[DataSetError]:
    used = {p.split for p in dataset.pictures} - {""}
    for split in ("train", "val") if used else ():
        if split not in used:
            fault = f"no picture is in {split}"
            yield DataSetError(fault, source=dataset.folder, remedy="split the set again")
    for split in sorted(used - {*SPLITS}):
        remedy = "use train, val and test"
        yield DataSetError(f"unknown split '{split}'", source=dataset.folder, remedy=remedy)


def _scene_leaks(dataset: DataSet) -> Iterator[DataSetError]:
    first: dict[str, dict[str, LabelledPicture]] = {}
    for picture in dataset.pictures:
        if picture.scene and picture.split:
            first.setdefault(picture.scene, {}).setdefault(picture.split, picture)
    for scene, of_splits in first.items():
        earlier, *later = of_splits.values()
        for picture in later:
            fault = (
                f"scene '{scene}' is in {picture.split}, and with {earlier.file} in {earlier.split}"
            )
            yield DataSetError(fault, source=picture.file, remedy=_BY_SCENE)


def _duplicate_leaks(dataset: DataSet, progress: Progress | None) -> Iterator[CucumberVisionError]:
    """Find pictures that show another split's picture or scene, and those that are unreadable."""
    assigned = [p for p in dataset.pictures if p.split]
    if len({p.split for p in assigned}) < 2:
        return
    prints: list[splits.Fingerprint] = []
    readable: list[LabelledPicture] = []
    for picture in assigned:
        try:
            prints += splits.take_fingerprints([dataset.path(picture)], progress)
        except CucumberVisionError as error:
            yield error
        else:
            readable.append(picture)
    of_copies = dict.fromkeys(splits.copies(prints), "is the same picture as")
    of_views = dict.fromkeys(_views_across(readable, prints), "shows the same scene as")
    for (i, j), what in sorted((of_views | of_copies).items()):
        picture, copy = readable[j], readable[i]
        if picture.split != copy.split:
            fault = f"in {picture.split} {what} {copy.file} in {copy.split}"
            yield DataSetError(fault, source=picture.file, remedy=_BY_SCENE)


def _views_across(
    pictures: Sequence[LabelledPicture], prints: Sequence[splits.Fingerprint]
) -> list[tuple[int, int]]:
    """Find near-duplicates across splits among pictures without a scene name."""
    unnamed = [k for k, p in enumerate(pictures) if not p.scene]
    pairs = splits.views_of_one_scene(
        [prints[k] for k in unnamed],
        color=_LEAK_COLOR,
        corners=_LEAK_CORNERS,
        wanted=lambda i, j: pictures[unnamed[i]].split != pictures[unnamed[j]].split,
    )
    return [(unnamed[i], unnamed[j]) for i, j in pairs]
