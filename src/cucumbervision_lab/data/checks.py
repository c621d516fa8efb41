"""Check data sets for invalid files, labels, classes and splits, and for leakage across splits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cucumbervision.errors import CucumberVisionError, DataSetError
from cucumbervision_lab.arrays import Progress
from cucumbervision_lab.data import splits
from cucumbervision_lab.data.coco import ANNOTATIONS, ROBOFLOW, read_coco
from cucumbervision_lab.data.labels import SPLITS, DataSet, Label, LabelledPicture, picture_size
from cucumbervision_lab.data.yolo import read_yolo

# Stricter than when scenes are searched. Photos of different scenes share at most 31 corners, and
# those were taken at the same place.
_LEAK_CORNERS = 25
_LEAK_COLOR = 0.2
_SLACK_PX = 0.51


@dataclass(frozen=True)
class Finding:
    """A fault of a data set.

    Parameters
    ----------
    kind : str
        'label', 'picture', 'class', 'polygon', 'split' or 'leak'.
    where : str
        File, and line or annotation.
    fault : str
        Description of the fault.
    remedy : str
        How to correct it.

    Examples
    --------
    >>> print(Finding("class", "data.yaml", "'leaf' has no label", "remove it"))
    data.yaml: 'leaf' has no label; remove it
    """

    kind: str
    where: str
    fault: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.where}: {self.fault}; {self.remedy}"


def require_clean(findings: Sequence[Finding], source: object) -> None:
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
    return read_coco(path) if _is_coco(path) else read_yolo(path, names)


def _is_coco(path: Path) -> bool:
    if path.is_file():
        return path.suffix.lower() == ".json"
    if not path.is_dir():
        raise DataSetError("folder not found", source=path, remedy="check the path")
    return (
        (path / ANNOTATIONS).is_file()
        or any(path.glob(ROBOFLOW))
        or any(path.glob(f"*/{ROBOFLOW}"))
    )


def check_folder(
    path: Path,
    names: Sequence[str] = (),
    *,
    duplicates: bool = True,
    progress: Progress | None = None,
) -> tuple[DataSet, list[Finding]]:
    """Read a data set and find all its faults.

    Parameters
    ----------
    path : Path
        Data set in COCO or YOLO format.
    names : sequence of str
        Class names, if the data set has none.
    duplicates : bool
        Also compare the pictures to find duplicates across splits, about 10 ms per picture.
    progress : callable, optional
        Called with 1 after each compared picture.

    Returns
    -------
    dataset : DataSet
        The data set.
    findings : list of Finding
        Its faults.

    Raises
    ------
    DataSetError
        If the folder contains no data set.
    """
    dataset = open_dataset(path, names)
    return dataset, check_dataset(dataset, duplicates=duplicates, progress=progress)


def check_dataset(
    dataset: DataSet, *, duplicates: bool = True, progress: Progress | None = None
) -> list[Finding]:
    """Find all faults of a data set.

    Parameters
    ----------
    dataset : DataSet
        Data set to check.
    duplicates, progress
        See `check_folder`.

    Returns
    -------
    list of Finding
        Faults found by the reader come first.
    """
    findings = [_refusal(error) for error in dataset.refused]
    bad: set[str] = set()
    for picture in dataset.pictures:
        faults = list(_picture_faults(dataset, picture))
        if any(f.kind == "picture" for f in faults):
            bad.add(picture.file)
        findings += faults
    findings += [*_class_faults(dataset), *_split_faults(dataset), *_scene_leaks(dataset)]
    if duplicates:
        readable = [p for p in dataset.pictures if p.file not in bad]
        findings += _duplicate_leaks(dataset, readable, progress)
    return findings


def _refusal(error: CucumberVisionError) -> Finding:
    label = Path(error.source).suffix.lower() in {".txt", ".json"}
    return Finding("label" if label else "picture", error.source, error.message, error.remedy)


def _picture_faults(dataset: DataSet, picture: LabelledPicture) -> Iterator[Finding]:
    try:
        size = picture_size(dataset.path(picture))
    except CucumberVisionError as error:
        yield Finding("picture", picture.file, error.message, error.remedy)
    else:
        if size != (picture.width, picture.height):
            fault = (
                f"is {size[0]}x{size[1]}, but its labels are for {picture.width}x{picture.height}"
            )
            yield Finding("picture", picture.file, fault, "restore the labelled picture")
    for k, label in enumerate(picture.labels):
        for fault in _label_faults(label, picture, len(dataset.categories)):
            yield Finding("label", f"{picture.file}, label {k + 1}", fault, "correct it")
        if label.pseudo and picture.split == "test":
            yield Finding(
                "split",
                f"{picture.file}, label {k + 1}",
                "the test split contains a pseudo-label",
                "move its scene to train",
            )


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


def _class_faults(dataset: DataSet) -> Iterator[Finding]:
    used = {label.category for p in dataset.pictures for label in p.labels if not label.ignore}
    for k, name in enumerate(dataset.categories):
        if k not in used:
            fault = f"the class '{name}' has no label"
            yield Finding("class", str(dataset.folder), fault, "remove the class or label it")


def _split_faults(dataset: DataSet) -> Iterator[Finding]:
    used = {p.split for p in dataset.pictures}
    for split in ("train", "val"):
        if used - {""} and split not in used:
            yield Finding(
                "split", str(dataset.folder), f"no picture is in {split}", "split the set again"
            )
    for split in sorted(used - {"", *SPLITS}):
        fault = f"unknown split '{split}'"
        yield Finding("split", str(dataset.folder), fault, "use train, val and test")


def _scene_leaks(dataset: DataSet) -> Iterator[Finding]:
    first: dict[str, LabelledPicture] = {}
    reported: set[tuple[str, str]] = set()
    for picture in dataset.pictures:
        if not picture.scene or not picture.split:
            continue
        earlier = first.setdefault(picture.scene, picture)
        if earlier.split != picture.split and (picture.scene, picture.split) not in reported:
            reported.add((picture.scene, picture.split))
            fault = (
                f"scene '{picture.scene}' is in {picture.split}, and with {earlier.file} in "
                f"{earlier.split}"
            )
            yield Finding("leak", picture.file, fault, "split by scene: cucumbervision data split")


def _duplicate_leaks(
    dataset: DataSet, pictures: Sequence[LabelledPicture], progress: Progress | None
) -> list[Finding]:
    assigned = [p for p in pictures if p.split]
    if len({p.split for p in assigned}) < 2:
        return []
    prints: list[splits.Fingerprint] = []
    readable: list[LabelledPicture] = []
    findings: list[Finding] = []
    for picture in assigned:
        try:
            prints += splits.take_fingerprints([dataset.path(picture)], progress)
        except CucumberVisionError as error:
            findings.append(Finding("picture", picture.file, error.message, error.remedy))
        else:
            readable.append(picture)
    pairs = dict.fromkeys(_copies_across(readable, prints), "is the same picture as")
    for pair in _views_across(readable, prints):
        pairs.setdefault(pair, "shows the same scene as")
    for (i, j), what in sorted(pairs.items()):
        picture, copy = readable[j], readable[i]
        fault = f"in {picture.split} {what} {copy.file} in {copy.split}"
        findings.append(
            Finding("leak", picture.file, fault, "split by scene: cucumbervision data split")
        )
    return findings


def _copies_across(
    pictures: Sequence[LabelledPicture], prints: Sequence[splits.Fingerprint]
) -> Iterator[tuple[int, int]]:
    index = {split: [k for k, p in enumerate(pictures) if p.split == split] for split in SPLITS}
    for a, b in (("train", "val"), ("train", "test"), ("val", "test")):
        pairs = splits.copies([prints[k] for k in index[a]], [prints[k] for k in index[b]])
        for i, j in pairs:
            picture, copy = sorted((index[a][i], index[b][j]))
            yield picture, copy


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
