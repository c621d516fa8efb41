"""Training options, and the Ultralytics settings derived from them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cucumbervision.errors import TrainingError
from cucumbervision_lab.training.checkpoint import require_layers
from cucumbervision_lab.training.data import TASKS
from cucumbervision_lab.training.plan import RunState

FIXED_OPTIONS = ("learning_rate", "one_to_many")
"""Options that stay fixed during a run; the others depend on the machine and may change."""

_AUGMENTATION: dict[str, Any] = {
    # Fruit hang or lie at any angle, and no keypoint is a left or right one.
    "degrees": 45.0,
    "flipud": 0.5,
    "fliplr": 0.5,
    "scale": 0.5,
    "translate": 0.1,
    "hsv_h": 0.02,
    "hsv_s": 0.6,
    "hsv_v": 0.45,
    "mosaic": 0.5,
    "erasing": 0.0,
}

# Without outlines, a rotated box is the bounding box of the old corners: far too wide for thin
# fruit. Flips upside down would hide that fruit hang by the stem, which helps to identify the ends.
# Synthetic scenes already contain rotated cameras and lying fruit.
_POSE_AUGMENTATION: dict[str, Any] = {"degrees": 0.0, "flipud": 0.0}


_BATCH = 8
_BATCH_ON_CARD = 64
_FROZEN = 6
_LAST_RATE = 0.05
_LAST_ONE_TO_MANY = 0.1
_WITHOUT_MOSAIC = 0.1


@dataclass(frozen=True)
class TrainOptions:
    """Training options.

    Parameters
    ----------
    batch : int
        Batch size; 0 selects 8 on the CPU and 64 on a GPU. The learning rate refers to a batch of
        8 and grows with the square root of the batch size.
    device : str
        'auto' (a GPU if available), 'cpu', or a GPU number.
    precision : str
        'auto', 'f32' or 'bf16'; see `choose_precision`.
    freeze : int
        Number of layers to freeze, from the input; 10 is the whole backbone. -1 selects 6 on the
        CPU, where the first layers take most of the time and change least, and 0 on a GPU.
    seed : int
        Random seed.
    threads : int
        Number of torch threads; 0 uses all cores.
    validate_every : int
        Epochs between two validations.
    learning_rate : float
        Initial learning rate of AdamW.
    one_to_many : float
        Initial share of the one-to-many head in the loss. A pretrained detector needs a smaller
        share than a new network.
    check : bool
        Reject data sets with faults or with duplicate pictures across splits.
    """

    batch: int = 0
    device: str = "auto"
    precision: str = "auto"
    freeze: int = 0
    seed: int = 0
    threads: int = 0
    validate_every: int = 4
    learning_rate: float = 0.001
    one_to_many: float = 0.8
    check: bool = True

    def batch_on(self, device: str) -> int:
        """Return the batch size on a device."""
        return self.batch or (_BATCH if device == "cpu" else _BATCH_ON_CARD)

    def frozen_on(self, device: str) -> int:
        """Return the number of frozen layers on a device."""
        return self.freeze if self.freeze >= 0 else _FROZEN if device == "cpu" else 0


def rate_at(progress: float) -> float:
    """Return the learning rate relative to the initial one.

    Parameters
    ----------
    progress : float
        Completed share of the plan, 0 to 1.

    Examples
    --------
    >>> [round(rate_at(t), 3) for t in (0.0, 0.5, 1.0)]
    [1.0, 0.525, 0.05]
    """
    return 1.0 - (1.0 - _LAST_RATE) * progress


def one_to_many_at(progress: float, first: float) -> float:
    """Return the share of the one-to-many head in the loss.

    Parameters
    ----------
    progress : float
        Completed share of the plan, 0 to 1.
    first : float
        Share at the beginning of the plan.

    Examples
    --------
    >>> [round(one_to_many_at(t, 0.8), 3) for t in (0.0, 0.5, 1.0)]
    [0.8, 0.45, 0.1]
    """
    return first + (min(first, _LAST_ONE_TO_MANY) - first) * progress


def trainer_settings(
    state: RunState, model: str, out: Path, options: TrainOptions, device: str
) -> dict[str, Any]:
    """Return the Ultralytics settings to continue a run from its current epoch.

    Parameters
    ----------
    state : RunState
        State of the run.
    model : str
        Checkpoint or network definition to start from.
    out : Path
        The run's folder.
    options : TrainOptions
        Training options.
    device : str
        Device from `choose_device`.

    Returns
    -------
    dict
        Overrides for the Ultralytics trainer.

    Raises
    ------
    TrainingError
        If the weights cannot be loaded.
    """
    epochs, batch = state.plan.epochs, options.batch_on(device)
    return {
        **_network(state, model),
        "data": state.data,
        "save_dir": str(out),
        "device": device,
        "batch": batch,
        "workers": 0,
        "cache": False,
        "freeze": options.frozen_on(device) or None,
        "plots": False,
        "patience": 0,
        "epochs": epochs,
        "imgsz": state.plan.size_at(state.epochs),
        "optimizer": "AdamW",
        "lr0": options.learning_rate * math.sqrt(max(batch, _BATCH) / _BATCH),
        "momentum": 0.9,
        "warmup_epochs": 0.0,
        "nbs": max(_BATCH, batch),
        "close_mosaic": max(1, round(_WITHOUT_MOSAIC * epochs)),
        # A resumed run would otherwise repeat the random augmentations of its start.
        "seed": state.seed + state.epochs,
        "deterministic": False,
        "amp": device != "cpu",
        "exist_ok": True,
        # Validate the one-to-one head, which is exported, without suppression. Each of its 300
        # rows costs a mask; rows below 0.01 do not change the metrics.
        "nms": False,
        "conf": 0.01,
        **_AUGMENTATION,
        **(_POSE_AUGMENTATION if state.task == "pose" else {}),
    }


def _network(state: RunState, model: str) -> dict[str, Any]:
    """Return the settings 'model' and 'pretrained': network definition and initial weights."""
    if not model.endswith(".pt"):
        return {"model": model, "pretrained": False}
    from ultralytics.nn.tasks import load_checkpoint

    require_layers(model)
    try:
        network, _ = load_checkpoint(model)
    # Unpickling a broken checkpoint can raise anything.
    except Exception as error:
        raise TrainingError(
            f"Ultralytics cannot load the weights ({error})",
            source=model,
            remedy="give a YOLO26 checkpoint (.pt)",
        ) from error
    if network.task == TASKS[state.task]:
        return {"model": model}
    scale = str(network.yaml.get("scale") or "n")
    return {"model": f"yolo26{scale}-{state.task}.yaml", "pretrained": model}


def choose_device(requested: str) -> str:
    """Return the device to train on.

    Parameters
    ----------
    requested : str
        'auto', 'cpu' or a GPU number. 'auto' selects the first CUDA GPU, or the CPU.
    """
    import torch

    if requested != "auto":
        return requested
    return "0" if torch.cuda.is_available() else "cpu"
