"""Options of a training, and the settings of Ultralytics that follow from them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cucumbervision.errors import TrainingError
from cucumbervision_lab.training.checkpoint import require_layers
from cucumbervision_lab.training.data import TASKS
from cucumbervision_lab.training.plan import RunState

LEARNING = ("learning_rate", "one_to_many", "by_place", "overrides")
"""Options that a run keeps from its beginning; the others are the machine's, and may change."""

_AUGMENTATION: dict[str, Any] = {
    # Fruit hang or lie at any angle, and none of the five points is left or right.
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

# Without outlines a turned box is the box about the old one's corners: far too wide for thin fruit.
# And fruit hang by the stem: which end is up says much of which end it is, as long as the pictures
# are not turned over. Scenes that were drawn hold turned cameras and lying fruit themselves.
_POINTS: dict[str, Any] = {"degrees": 0.0, "flipud": 0.0}


_BATCH = 8
_BATCH_ON_CARD = 64
_FROZEN = 6
_LAST_RATE = 0.05
_LAST_ONE_TO_MANY = 0.1
_WITHOUT_MOSAIC = 0.1


@dataclass(frozen=True)
class TrainOptions:
    """How to train.

    Parameters
    ----------
    batch : int
        Pictures at a time; 0: 8 on the processor, 64 on a card. The learning rate is for 8, and
        grows with the root of it.
    device : str
        'auto' (a graphics card where there is one), 'cpu', or a card's number.
    precision : str
        'auto', 'f32' or 'bf16'; see `choose_precision`.
    freeze : int
        Layers from the front that stay as they are; 10 is the whole backbone; -1: 6 on the
        processor, where they take most of the time and learn least, none on a card.
    seed : int
        Of the random numbers.
    threads, workers : int
        Threads of torch (0: as many as there are cores), and processes that load pictures.
    minutes : float, optional
        End after the epoch in which this time has passed; `resume` goes on.
    validate_every : int
        Epochs between two validations.
    learning_rate : float
        At the beginning of the plan, by AdamW.
    one_to_many : float
        Share of the loss that is the one-to-many head's at the beginning of the plan. A network
        that finds fruit already needs less of it than a new one.
    by_place : bool
        Learn points from a fruit's lower left end to its upper right one, and leave it to `ends`
        which of them is the stem's; else from blossom to stem.
    check : bool
        Refuse a data set with faults or with the same picture in two splits.
    overrides : mapping
        Further settings of Ultralytics, which win.
    """

    batch: int = 0
    device: str = "auto"
    precision: str = "auto"
    freeze: int = 0
    seed: int = 0
    threads: int = 0
    workers: int = 0
    minutes: float | None = None
    validate_every: int = 4
    learning_rate: float = 0.001
    one_to_many: float = 0.8
    by_place: bool = True
    check: bool = True
    overrides: Mapping[str, Any] | None = None

    def batch_on(self, device: str) -> int:
        """Return the pictures at a time on a device."""
        return self.batch or (_BATCH if device == "cpu" else _BATCH_ON_CARD)

    def frozen_on(self, device: str) -> int:
        """Return the layers that stay as they are on a device."""
        return self.freeze if self.freeze >= 0 else _FROZEN if device == "cpu" else 0


def rate_at(progress: float) -> float:
    """Return the learning rate as a share of the first one.

    Parameters
    ----------
    progress : float
        Share of the plan that is through, 0 to 1.

    Examples
    --------
    >>> [round(rate_at(t), 3) for t in (0.0, 0.5, 1.0)]
    [1.0, 0.525, 0.05]
    """
    return 1.0 - (1.0 - _LAST_RATE) * progress


def one_to_many_at(progress: float, first: float) -> float:
    """Return the one-to-many head's share of the loss.

    Parameters
    ----------
    progress : float
        Share of the plan that is through, 0 to 1.
    first : float
        The share at its beginning.

    Examples
    --------
    >>> [round(one_to_many_at(t, 0.8), 3) for t in (0.0, 0.5, 1.0)]
    [0.8, 0.45, 0.1]
    """
    return first + (min(first, _LAST_ONE_TO_MANY) - first) * progress


def trainer_settings(
    state: RunState, model: str, out: Path, options: TrainOptions, device: str
) -> dict[str, Any]:
    """Return Ultralytics' settings from the epoch on that a run has come to.

    Parameters
    ----------
    state : RunState
        The run.
    model : str
        The network that it goes on from.
    out : Path
        The run's folder.
    options : TrainOptions
        How to train.
    device : str
        From `choose_device`.

    Returns
    -------
    dict
        The overrides of Ultralytics' trainer.

    Raises
    ------
    TrainingError
        If the weights to begin with cannot be loaded.
    """
    epochs, batch = state.plan.epochs, options.batch_on(device)
    return {
        **_network(state, model),
        "data": state.data,
        "save_dir": str(out),
        "device": device,
        "batch": batch,
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
        # Resumed, it would draw the same chances again.
        "seed": state.seed + state.epochs,
        "deterministic": False,
        "amp": device != "cpu",
        "exist_ok": True,
        # Validate the head that is shipped: one to one, without suppression. Of its 300 rows
        # those under 0.01 would cost a mask each and change nothing.
        "nms": False,
        "conf": 0.01,
        **_AUGMENTATION,
        **(_POINTS if state.task == "pose" else {}),
        **(options.overrides or {}),
    }


def _network(state: RunState, model: str) -> dict[str, Any]:
    """Say which network and weights a training goes on from."""
    if not model.endswith(".pt"):
        return {"model": model, "pretrained": False}
    from ultralytics.nn.tasks import load_checkpoint

    require_layers(model)
    try:
        network, _ = load_checkpoint(model)
    # Unpickling a broken checkpoint can raise anything.
    except Exception as error:
        raise TrainingError(
            f"Ultralytics cannot load these weights ({error})",
            source=model,
            remedy="give a YOLO26 checkpoint (.pt)",
        ) from error
    if network.task == TASKS[state.task]:
        return {"model": model}
    scale = str(network.yaml.get("scale") or "n")
    return {"model": f"yolo26{scale}-{state.task}.yaml", "pretrained": model}


def choose_device(asked: str) -> str:
    """Return the device to train on: 'auto' is the first CUDA card, or the CPU without one.

    Parameters
    ----------
    asked : str
        'auto', 'cpu' or a card's number.
    """
    import torch

    if asked != "auto":
        return asked
    return "0" if torch.cuda.is_available() else "cpu"
