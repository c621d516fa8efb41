"""Import Ultralytics offline, load YOLO26 checkpoints, and average two of them."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

from cucumbervision.errors import MissingExtraError, ModelError, TrainingError
from cucumbervision.perception.runtime import import_onnxruntime

_INTEGRATIONS = ("clearml", "comet", "dvc", "mlflow", "neptune", "raytune", "tensorboard", "wandb")

# Torch removes an operator's definition when its Library object is garbage-collected.
_libraries: list[Any] = []


def _import_torchvision() -> None:
    """Import torchvision, which Ultralytics needs for validation.

    A torchvision built for another torch fails to import because its operators are missing.
    Declaring the two operators lets the import succeed. They are never called here, because the
    one-to-one head needs no non-maximum suppression.
    """
    import torch

    try:
        importlib.import_module("torchvision")
    except RuntimeError as error:
        if "torchvision::nms" not in str(error):
            raise
        _libraries.append(torch.library.Library("torchvision", "DEF"))
        for name in ("nms", "qnms"):
            _libraries[-1].define(f"{name}(Tensor dets, Tensor scores, float iou) -> Tensor")
        # The failed import leaves partly initialised modules behind.
        for name in [n for n in sys.modules if n.partition(".")[0] == "torchvision"]:
            del sys.modules[name]
        importlib.import_module("torchvision")


def import_ultralytics() -> Any:
    """Import Ultralytics with telemetry, integrations, downloads and installs disabled.

    Returns
    -------
    module
        The `ultralytics` package.

    Raises
    ------
    MissingExtraError
        If Ultralytics is not installed.
    """
    os.environ["YOLO_OFFLINE"] = "1"
    os.environ["YOLO_AUTOINSTALL"] = "False"
    os.environ.setdefault("YOLO_VERBOSE", "False")
    # Imported first, because Ultralytics would import it with telemetry enabled.
    import_onnxruntime()
    try:
        # Ultralytics changes NumPy's print options globally.
        with np.printoptions():
            _import_torchvision()
            import ultralytics
            from ultralytics.utils import SETTINGS, events
    except ImportError as error:
        raise MissingExtraError(error.name or "ultralytics", "train") from error
    # `dict.__setitem__` changes the setting in this process only, not in the user's file.
    for name in ("sync", *_INTEGRATIONS):
        dict.__setitem__(SETTINGS, name, False)
    events.events.enabled = False
    return ultralytics


def load_yolo(checkpoint: Path | str) -> Any:
    """Load a YOLO26 .pt file, or random weights from an Ultralytics .yaml.

    A checkpoint is a pickle, which can contain code: load only what you trust.

    Raises
    ------
    ModelError
        If the checkpoint cannot be loaded.
    MissingExtraError
        If the extra `train` is not installed.
    """
    ultralytics = import_ultralytics()
    try:
        return ultralytics.YOLO(str(checkpoint))
    # Unpickling a broken checkpoint can raise anything.
    except Exception as error:
        raise ModelError(
            f"Ultralytics cannot load the checkpoint ({error})",
            source=checkpoint,
            remedy="give a YOLO26 checkpoint (.pt)",
        ) from error


def allowed_threads() -> int:
    """Return OMP_NUM_THREADS, or the number of cores; Ultralytics would choose others."""
    asked = os.environ.get("OMP_NUM_THREADS", "")
    return int(asked) if asked.isdigit() and int(asked) else os.cpu_count() or 1


def average_networks(first: Path, second: Path, out: Path, share: float = 0.5) -> Path:
    """Write the weighted mean of two checkpoints.

    Averaging the weights before and after fine-tuning reduces forgetting and improves accuracy on
    pictures that differ from the fine-tuning data (Wortsman et al., "Robust fine-tuning of
    zero-shot models", CVPR 2022).

    Parameters
    ----------
    first, second : Path
        Checkpoints (.pt) of the same architecture: `second` was fine-tuned from `first`, or both
        were fine-tuned from a third one.
    out : Path
        The checkpoint to write, in half precision.
    share : float
        Weight of `second`, 0 to 1.

    Raises
    ------
    ModelError
        If a file is not a checkpoint.
    TrainingError
        If the two architectures differ, or `share` is out of range.
    """
    if not 0 <= share <= 1:
        raise TrainingError(
            f"the share {share} is out of range", remedy="give a number from 0 to 1"
        )
    model = load_yolo(second)
    state_1, state_2 = (x.model.float().state_dict() for x in (load_yolo(first), model))
    if {k: v.shape for k, v in state_1.items()} != {k: v.shape for k, v in state_2.items()}:
        raise TrainingError(
            f"its architecture differs from {first.name}",
            source=second,
            remedy="give two checkpoints that were trained from the same weights",
        )
    for key, value in state_2.items():
        if value.is_floating_point():
            # The state dictionary refers to the network's own tensors: update them in place.
            value.copy_(state_1[key].lerp(value, share))
    model.save(out)
    return out
