"""Check training data and write a complete `data.yaml` for one class and five keypoints."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from cucumbervision.errors import TrainingError
from cucumbervision_lab.datasets.checks import check_folder, require_clean
from cucumbervision_lab.datasets.labels import DataSet, LabelledPicture
from cucumbervision_lab.datasets.yolo import class_names, load_data_yaml, write_yolo

TASKS = {"seg": "segment", "pose": "pose"}
"""Task names of the commands, and their names in Ultralytics."""

KEYPOINT_SIGMA = 0.05
"""Standard deviation of every keypoint in object keypoint similarity (loss and validation)."""

DATA_CARD = "data.md"
"""File name of the data set's card in the run's folder."""

_KEYPOINTS = 5


def prepare_data(data: Path, task: str, run: Path, *, check: bool = True) -> Path:
    """Check a data set, and write its card and `data.yaml` to the run's folder.

    Parameters
    ----------
    data : Path
        A YOLO folder or its data.yaml, used in place; or a folder in COCO format, which is
        converted to YOLO format in the run's folder.
    task : str
        'seg' or 'pose'.
    run : Path
        Folder of the training run.
    check : bool
        Look for faults and for duplicate pictures across splits. A set that must be converted is
        always checked for faults.

    Returns
    -------
    Path
        The `data.yaml` to train on.

    Raises
    ------
    DataSetError
        If the data set cannot be read or has faults.
    TrainingError
        See `write_data_file`.
    """
    file = data / "data.yaml" if data.is_dir() else data
    if check or not file.is_file():
        dataset, findings = check_folder(data, duplicates=check)
        require_clean(findings, data)
        run.mkdir(parents=True, exist_ok=True)
        (run / DATA_CARD).write_text(data_card(dataset, "Trained on"), encoding="utf-8")
        if not (data.is_dir() and file.is_file()) and data.suffix not in (".yaml", ".yml"):
            # Training does not read the test split, whose fruit may have boxes only.
            used = ("train", "val")
            file = write_yolo(dataset, run / "data", TASKS[task], splits=used).data_yaml
    return write_data_file(file, task, run)


def data_card(dataset: DataSet, title: str) -> str:
    """Return a Markdown table of a data set's sources, licences and picture counts.

    Parameters
    ----------
    dataset : DataSet
        The data set to describe.
    title : str
        Heading of the card.

    Examples
    --------
    >>> from cucumbervision_lab.datasets.labels import LabelledPicture
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


def write_data_file(path: Path, task: str, run: Path) -> Path:
    """Write the run's `data.yaml` with absolute paths, one class and the keypoint sigmas.

    Ultralytics reads `kpt_oks_sigmas` for the loss and for validation; its default for five points
    is 0.2 each, four times as tolerant. `flip_idx` keeps the order of the keypoints, because none
    of them is a left or right one.

    Parameters
    ----------
    path : Path
        The data.yaml to read.
    task : str
        'seg' or 'pose'.
    run : Path
        Folder of the training run.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    CaptureError, DataSetError
        If `path` does not exist or cannot be read.
    TrainingError
        If `path` lists no training or validation pictures, has more than one class, or, for
        'pose', does not have five keypoints.
    """
    values = load_data_yaml(path)
    _check(values, task, path)
    content: dict[str, Any] = {
        "path": str((path.parent / str(values.get("path") or ".")).resolve()),
        **{split: values[split] for split in ("train", "val", "test") if values.get(split)},
        "names": {0: class_names(values["names"], path)[0]},
    }
    if values.get("weights"):
        content["weights"] = list(values["weights"])
    if task == "pose":
        content |= {
            "kpt_shape": [_KEYPOINTS, values["kpt_shape"][1]],
            "flip_idx": list(range(_KEYPOINTS)),
            "kpt_oks_sigmas": [KEYPOINT_SIGMA] * _KEYPOINTS,
        }
    run.mkdir(parents=True, exist_ok=True)
    written = run / "data.yaml"
    written.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return written


def _check(values: dict[str, Any], task: str, path: Path) -> None:
    for split in ("train", "val"):
        if not values.get(split):
            raise TrainingError(
                f"the split {split} is missing", source=path, remedy=f"add {split} pictures"
            )
    names = class_names(values.get("names"), path)
    if len(names) != 1:
        raise TrainingError(
            f"has {len(names)} classes, expected 1", source=path, remedy="keep one class"
        )
    shape = values.get("kpt_shape")
    if task == "pose" and (not shape or shape[0] != _KEYPOINTS or shape[1] not in (2, 3)):
        raise TrainingError(
            f"has keypoints of shape {shape}, expected [5, 3]",
            source=path,
            remedy="export the data set again for the task pose",
        )
