"""Prepare data sets for training: checked, in YOLO format, for one class and five keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from cucumbervision.capture.pictures import read_color, write_jpeg
from cucumbervision.errors import TrainingError
from cucumbervision.networks.keypoint_axis import keypoints_between
from cucumbervision.networks.yolo_layout import BY_PLACE
from cucumbervision_lab.data.checks import check_folder, require_clean
from cucumbervision_lab.data.coco import write_coco
from cucumbervision_lab.data.derive import add_pseudo_masks
from cucumbervision_lab.data.labels import KEYPOINT_ORDER, DataSet, Label, LabelledPicture
from cucumbervision_lab.data.polygons import DIRECTIONS, keypoints_of_mask
from cucumbervision_lab.data.yolo import write_yolo
from cucumbervision_lab.evaluate.photos import audited
from cucumbervision_lab.scenes.colors import d435_colors

TASKS = {"seg": "segment", "pose": "pose"}
"""Task names of the commands, and their names in Ultralytics."""

KEYPOINT_SIGMA = 0.05
"""Standard deviation of every keypoint in object keypoint similarity (loss and validation)."""

DATA_CARD = "data.md"
"""File name of the data sets' card in the run's folder."""

_KEYPOINTS = 5
_MOST_HIDDEN = 0.05


def open_sets(folders: Sequence[Path]) -> list[DataSet]:
    """Read and check data sets; one that is named twice is read once.

    Raises
    ------
    DataSetError
        If a data set cannot be read or has faults.
    """
    read: dict[Path, DataSet] = {}
    for folder in folders:
        if folder not in read:
            read[folder], findings = check_folder(folder)
            require_clean(findings, folder)
    return [read[folder] for folder in folders]


def write_training_data(datasets: Sequence[DataSet], task: str, run: Path) -> Path:
    """Write data sets in YOLO format to the run's folder, with one `data.yaml` and card of all.

    For 'pose', keypoints are ordered by their position in the picture, which a network learns
    within hours; `cucumber-fruit` tells the stem end later. Hidden ones become unlabelled, because
    Ultralytics' keypoint confidence separates labelled from unlabelled ones.

    Parameters
    ----------
    datasets : sequence of DataSet
        One class each. A set given twice counts twice in training.
    task : str
        'seg' or 'pose'.
    run : Path
        Folder of the training run.

    Returns
    -------
    Path
        The data.yaml.

    Raises
    ------
    DataSetError
        If a picture has no split, or a label lacks a mask for 'seg'.
    TrainingError
        If a set has more than one class, or there are no training or validation pictures.
    """
    content: dict[str, Any] = {"train": [], "val": [], "names": {0: datasets[0].categories[0]}}
    unique = list({id(dataset): dataset for dataset in datasets}.values())
    for number, dataset in enumerate(unique):
        if len(dataset.categories) != 1:
            raise TrainingError(
                f"has {len(dataset.categories)} classes, expected 1",
                source=dataset.folder,
                remedy="keep one class",
            )
        folder = (run / "data" / str(number)).resolve()
        if task == "pose":
            dataset = _each_label(dataset, _ordered_by_place)
        written = write_yolo(dataset, folder, TASKS[task], splits=("train", "val"))
        times = {"train": sum(entry is unique[number] for entry in datasets), "val": 1}
        for split in times:
            if written.pictures[split]:
                content[split] += times[split] * [str(folder / "images" / split)]
    for split in ("train", "val"):
        if not content[split]:
            raise TrainingError(
                f"the split {split} is missing",
                source=datasets[0].folder,
                remedy=f"add {split} pictures: cucumbervision data split",
            )
    if task == "pose":
        content |= {"kpt_shape": [_KEYPOINTS, 3], "flip_idx": list(range(_KEYPOINTS))}
    cards = [data_card(dataset, f"Trained on {dataset.folder.name}") for dataset in unique]
    (run / DATA_CARD).write_text("\n\n".join(cards), encoding="utf-8")
    file = run / "data.yaml"
    file.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return file


def _each_label(dataset: DataSet, change: Any) -> DataSet:
    pictures = (
        replace(picture, labels=tuple(change(label) for label in picture.labels))
        for picture in dataset.pictures
    )
    return replace(dataset, pictures=tuple(pictures))


def _ordered_by_place(label: Label) -> Label:
    """Order keypoints so that the last is further right and up; the order flips for few fruit."""
    if label.keypoints is None:
        return label
    points = label.keypoints
    labelled = points[points[:, 2] > 0]
    if len(labelled) < 2:
        return replace(label, keypoints=None)
    x, y = labelled[-1, :2] - labelled[0, :2]
    ordered = points[::-1] if x < y else points
    return replace(label, keypoints=np.where(ordered[:, 2:] == 2, ordered, 0.0))


def data_card(dataset: DataSet, title: str) -> str:
    """Return a Markdown table of a data set's sources, licences and picture counts.

    Examples
    --------
    >>> from cucumbervision_lab.data.labels import LabelledPicture
    >>> picture = LabelledPicture("a.png", 64, 48, source="own house", licence="CC0-1.0")
    >>> print(data_card(DataSet(Path(), (picture, picture)), "Set"))
    # Set
    <BLANKLINE>
    | source | licence | pictures | with fruit | fruit |
    |---|---|--:|--:|--:|
    | own house | CC0-1.0 | 2 | 0 | 0 |
    """
    groups: dict[tuple[str, str], list[LabelledPicture]] = {}
    for picture in dataset.pictures:
        key = (picture.source or "not stated", picture.licence or "not stated")
        groups.setdefault(key, []).append(picture)
    lines = [f"# {title}", "", "| source | licence | pictures | with fruit | fruit |"]
    lines.append("|---|---|--:|--:|--:|")
    for (source, licence), members in sorted(groups.items()):
        fruit = [sum(not label.ignore for label in picture.labels) for picture in members]
        counts = len(members), np.count_nonzero(fruit), sum(fruit)
        # Escape the column separator.
        cells = (source.replace("|", "\\|"), licence.replace("|", "\\|"), *map(str, counts))
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def photo_set(folder: Path, out: Path, *, as_d435: bool = False) -> DataSet:
    """Write the audited photos below a folder, except those of test scenes, as a labelled set.

    Fruit without an outline get a mask by SAM; complete fruit get keypoints along the mask's axis,
    ordered by place where the stem end is not directed.

    Parameters
    ----------
    folder : Path
        Folder of the photos, searched recursively.
    out : Path
        Folder of the set.
    as_d435 : bool
        Write the photos to train on once more, in the colours of a D435 in a greenhouse.

    Raises
    ------
    DataSetError, CaptureError
        If there is no such photo, or one cannot be read.
    """
    from cucumbervision.networks.loaded import open_segmenter

    audit = audited(folder, outlines=True)
    pictures = tuple(
        replace(picture, extras={})
        for picture in audit.pictures
        if picture.split != "test" and (picture.extras["fully_labelled"] or picture.shows_fruit)
    )
    drawn = add_pseudo_masks(replace(audit, pictures=pictures), open_segmenter()).dataset
    labelled = write_coco(_each_label(drawn, _with_axis_points), out)
    if not as_d435:
        return labelled
    rng, copies = np.random.default_rng(0), []
    for number, picture in enumerate(labelled.in_split("train")):
        copy = replace(picture, file=f"images/d435-{number:05d}.jpg")
        write_jpeg(out / copy.file, d435_colors(read_color(labelled.path(picture)), rng))
        copies.append(copy)
    return write_coco(replace(labelled, pictures=(*labelled.pictures, *copies)), out)


def _with_axis_points(label: Label) -> Label:
    mask = label.mask
    hidden = (label.hidden_share or 0.0) > _MOST_HIDDEN
    if mask is None or label.keypoints is not None or label.ignore or label.cut_off or hidden:
        return label
    ends = label.extras.get("ends_px")
    points = None if ends is None else keypoints_between(mask, ends)
    if points is not None:
        return replace(label, keypoints=np.column_stack([points, np.full(len(points), 2.0)]))
    stem = label.extras.get("stem")
    directed = stem in DIRECTIONS
    for direction in [str(stem)] if directed else ["right", "up"]:
        points = keypoints_of_mask(mask, direction)
        if points is not None:
            order = {} if directed else {KEYPOINT_ORDER: BY_PLACE}
            return replace(label, keypoints=points, extras={**label.extras, **order})
    return label
