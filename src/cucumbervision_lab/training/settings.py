"""What is set of Ultralytics for one stage of a training, and why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cucumbervision.errors import TrainingError
from cucumbervision_lab.training.learn_from import TASKS
from cucumbervision_lab.training.stages import RunState

__all__ = ["LEARNING", "TrainOptions", "choose_device", "stage_settings"]

LEARNING = ("batch", "freeze", "patience", "learning_rate", "by_place", "overrides")
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


@dataclass(frozen=True)
class TrainOptions:
    """How to train.

    Parameters
    ----------
    batch : int
        Pictures at a time.
    device : str
        'auto' (a graphics card where there is one), 'cpu', or a card's number.
    precision : str
        'auto', 'f32' or 'bf16'; see `half_precision`.
    freeze : int
        Layers from the front that stay as they are; 10 is the whole backbone.
    patience : int
        Epochs of a stage without a better result before it ends.
    seed : int
        Of the random numbers.
    cache : str
        Where decoded pictures are kept: 'ram', 'disk' or 'none'.
    threads, workers : int
        Threads of torch (0: as many as there are cores), and processes that load pictures.
    minutes : float, optional
        End after the epoch in which this time has passed; `resume` goes on.
    learning_rate : float
        Of the first stage, by AdamW; later stages begin at half of it.
    by_place : bool
        Learn points from a fruit's lower left end to its upper right one, and leave it to `ends`
        which of them is the stem's; else from blossom to stem.
    check : bool
        Refuse a data set with faults or with the same picture in two splits.
    overrides : mapping
        Further settings of Ultralytics, which win.
    """

    batch: int = 8
    device: str = "auto"
    precision: str = "auto"
    freeze: int = 0
    patience: int = 20
    seed: int = 0
    cache: str = "ram"
    threads: int = 0
    workers: int = 0
    minutes: float | None = None
    learning_rate: float = 0.001
    by_place: bool = True
    check: bool = True
    overrides: Mapping[str, Any] | None = None


def stage_settings(
    state: RunState,
    index: int,
    out: Path,
    options: TrainOptions,
    device: str,
    last: Path | None,
) -> dict[str, Any]:
    """Give Ultralytics' settings of one stage.

    Parameters
    ----------
    state : RunState
        The run.
    index : int
        Of the stage, from 0.
    out : Path
        The run's folder.
    options : TrainOptions
        How to train.
    device : str
        From `choose_device`.
    last : Path, optional
        The stage's own checkpoint, if it was begun.

    Returns
    -------
    dict
        The overrides of Ultralytics' trainer.

    Raises
    ------
    TrainingError
        If the weights to begin with cannot be loaded.
    """
    stage = state.stages[index]
    settings: dict[str, Any] = {
        "data": state.data,
        "save_dir": str(state.folder(out, index)),
        "device": device,
        "batch": options.batch,
        "cache": False if options.cache == "none" else options.cache,
        "patience": options.patience,
        "freeze": options.freeze or None,
        "plots": False,
    }
    if last:
        return settings | {"model": str(last), "resume": str(last)}
    return (
        settings
        | _start(state, index, out)
        | {
            "epochs": stage.epochs,
            "imgsz": stage.size_px,
            "optimizer": "AdamW",
            "lr0": options.learning_rate * (1.0 if index == 0 else 0.5),
            "lrf": 0.1,
            "momentum": 0.9,
            # A later stage begins with weights that know the pictures: an epoch of warming up would
            # be all of a stage of one.
            "warmup_epochs": 1.0 if index == 0 else 0.0,
            "warmup_bias_lr": 0.0,
            "nbs": max(8, options.batch),
            "close_mosaic": min(3, max(1, stage.epochs // 3)),
            "seed": state.seed,
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
    )


def _start(state: RunState, index: int, out: Path) -> dict[str, Any]:
    """Say which network and weights a stage begins with."""
    if index:
        return {"model": str(state.folder(out, index - 1) / "weights" / "best.pt")}
    if not state.init.endswith(".pt"):
        return {"model": state.init, "pretrained": False}
    from ultralytics.nn.tasks import load_checkpoint

    try:
        network, _ = load_checkpoint(state.init)
    # Unpickling a broken checkpoint can raise anything.
    except Exception as error:
        raise TrainingError(
            f"Ultralytics cannot load these weights ({error})",
            source=state.init,
            remedy="give a YOLO26 checkpoint (.pt)",
        ) from error
    if network.task == TASKS[state.task]:
        return {"model": state.init}
    scale = str(network.yaml.get("scale") or "n")
    return {"model": f"yolo26{scale}-{state.task}.yaml", "pretrained": state.init}


def choose_device(asked: str) -> str:
    """Give the device to train on: 'auto' is the first CUDA card, or the CPU without one.

    Parameters
    ----------
    asked : str
        'auto', 'cpu' or a card's number.
    """
    import torch

    if asked != "auto":
        return asked
    return "0" if torch.cuda.is_available() else "cpu"
