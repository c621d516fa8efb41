"""The pictures to learn from: a `data.yaml` made complete for one class and five points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cucumbervision.errors import TrainingError

__all__ = ["KEYPOINT_SIGMA", "TASKS", "write_data_file"]

TASKS = {"seg": "segment", "pose": "pose"}
"""Our tasks, and what Ultralytics calls them."""

KEYPOINT_SIGMA = 0.05
"""Tolerance of every keypoint in the object keypoint similarity, of the loss and of validation."""

_KEYPOINTS = 5


def write_data_file(data: Path, task: str, run: Path) -> Path:
    """Write the run's own `data.yaml`: absolute paths, one class, and the keypoints' tolerance.

    Ultralytics reads `kpt_oks_sigmas` from it, for the loss and for validation; without it five
    points get 0.2 each, four times as kind. `flip_idx` leaves the points in their order: none of
    them is left or right.

    Parameters
    ----------
    data : Path
        A data.yaml, or the folder that holds it.
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
    TrainingError
        If there is no data.yaml, it cannot be read, it has no training or validation pictures,
        more classes than one, or (pose) other than five keypoints.
    """
    import yaml

    path = data / "data.yaml" if data.is_dir() else data
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise TrainingError(
            f"the data set's data.yaml cannot be read ({type(error).__name__})",
            source=path,
            remedy="give a folder with data.yaml, images/ and labels/",
        ) from error
    if not isinstance(values, dict):
        raise TrainingError("is no data set's description", source=path)
    _check(values, task, path)
    own: dict[str, Any] = {
        "path": str((path.parent / str(values.get("path") or ".")).resolve()),
        **{split: values[split] for split in ("train", "val", "test") if values.get(split)},
        "names": {0: "cucumber"},
    }
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
