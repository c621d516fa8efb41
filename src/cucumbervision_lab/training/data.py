"""Training data: checked, and a complete `data.yaml` for one class and five keypoints.

A data set with faults is refused here, before any hour is spent.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from cucumbervision.errors import TrainingError
from cucumbervision_lab.datasets.checks import check_folder, require_clean
from cucumbervision_lab.datasets.labels import DataSet, LabelledPicture
from cucumbervision_lab.datasets.yolo import load_data_yaml, write_yolo

TASKS = {"seg": "segment", "pose": "pose"}
"""Our tasks, and what Ultralytics calls them."""

KEYPOINT_SIGMA = 0.05
"""Tolerance of every keypoint in the object keypoint similarity, of the loss and of validation."""

DATA_CARD = "data.md"
"""Name of the data set's card in the run's folder."""

_KEYPOINTS = 5


def prepare_data(data: Path, task: str, run: Path, *, check: bool = True) -> Path:
    """Check a data set, write its card into the run's folder, and its `data.yaml`.

    Parameters
    ----------
    data : Path
        A folder in the hub's form or COCO's, of which a YOLO copy is written into the run's
        folder; or a YOLO folder or its data.yaml, read where it is.
    task : str
        'seg' or 'pose'.
    run : Path
        Folder of the training.
    check : bool
        Look for faults, and for the same picture in two splits. A set in another form than
        YOLO's is read anyway, and then refused if it cannot be.

    Returns
    -------
    Path
        The `data.yaml` to train on.

    Raises
    ------
    DataSetError
        If it is no data set, or has faults.
    TrainingError
        As `write_data_file`.
    """
    file = data / "data.yaml" if data.is_dir() else data
    if check or not file.is_file():
        dataset, findings = check_folder(data, duplicates=check)
        require_clean(findings, data)
        run.mkdir(parents=True, exist_ok=True)
        (run / DATA_CARD).write_text(data_card(dataset, "Trained on"), encoding="utf-8")
        if not (data.is_dir() and file.is_file()) and data.suffix not in (".yaml", ".yml"):
            file = write_yolo(dataset, run / "data", TASKS[task]).data_yaml
    return write_data_file(file, task, run)


def data_card(dataset: DataSet, title: str) -> str:
    """Return in Markdown whose pictures a set holds, how many and under which licence.

    Parameters
    ----------
    dataset : DataSet
        What to describe.
    title : str
        Heading.

    Examples
    --------
    >>> from cucumbervision_lab.datasets.labels import LabelledPicture
    >>> one = LabelledPicture("a.png", 64, 48, source="own house", licence="CC0-1.0")
    >>> print(data_card(DataSet(Path(), (one, one)), "Set"))
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
    for (source, licence), own in sorted(groups.items()):
        fruit = [sum(not label.ignore for label in picture.labels) for picture in own]
        counts = len(own), np.count_nonzero(fruit), sum(fruit)
        # A bar in a licence's text would end the cell.
        cells = (source.replace("|", "\\|"), licence.replace("|", "\\|"), *map(str, counts))
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def write_data_file(path: Path, task: str, run: Path) -> Path:
    """Write the run's own `data.yaml`: absolute paths, one class, and the keypoints' tolerance.

    Ultralytics reads `kpt_oks_sigmas` from it, for the loss and for validation; without it five
    points get 0.2 each, four times as kind. `flip_idx` leaves the points in their order: none of
    them is left or right.

    Parameters
    ----------
    path : Path
        A data.yaml.
    task : str
        'seg' or 'pose'.
    run : Path
        Folder of the training.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    CaptureError, DataSetError
        If there is no data.yaml, or it cannot be read.
    TrainingError
        If it has no training or validation pictures, more classes than one, or (pose) other than
        five keypoints.
    """
    values = load_data_yaml(path)
    _check(values, task, path)
    own: dict[str, Any] = {
        "path": str((path.parent / str(values.get("path") or ".")).resolve()),
        **{split: values[split] for split in ("train", "val", "test") if values.get(split)},
        "names": {0: "cucumber"},
    }
    if values.get("weights"):
        own["weights"] = list(values["weights"])
    if task == "pose":
        own |= {
            "kpt_shape": [_KEYPOINTS, values["kpt_shape"][1]],
            "flip_idx": list(range(_KEYPOINTS)),
            "kpt_oks_sigmas": [KEYPOINT_SIGMA] * _KEYPOINTS,
        }
    run.mkdir(parents=True, exist_ok=True)
    written = run / "data.yaml"
    written.write_text(yaml.safe_dump(own, sort_keys=False), encoding="utf-8")
    return written


def _check(values: dict[str, Any], task: str, path: Path) -> None:
    for split in ("train", "val"):
        if not values.get(split):
            raise TrainingError(f"names no {split} pictures", source=path, remedy="add them")
    names = values.get("names") or []
    if len(names) != 1:
        raise TrainingError(
            f"has {len(names)} classes, not one", source=path, remedy="keep the cucumbers only"
        )
    shape = values.get("kpt_shape")
    if task == "pose" and (not shape or shape[0] != _KEYPOINTS or shape[1] not in (2, 3)):
        raise TrainingError(
            f"has keypoints of shape {shape}, not [5, 3]",
            source=path,
            remedy="write the data set again for the task pose",
        )
