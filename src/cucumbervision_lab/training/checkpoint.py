"""Read, strip and average checkpoints; import Ultralytics offline; read and write CSV tables."""

from __future__ import annotations

import csv
import importlib
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from cucumbervision.errors import MissingExtraError, TrainingError
from cucumbervision.perception.onnx_runtime import import_onnxruntime

_LAYERS = ("torch.nn.modules.", "ultralytics.nn.")
_OPTIONS = "ultralytics.utils.IterableSimpleNamespace"  # holds the training options of a last.pt


def require_layers(path: Path | str) -> list[Any]:
    """Return the layer classes of a checkpoint, and reject checkpoints that use other names.

    A checkpoint is a pickle of the whole network. The names are read without loading it.

    Raises
    ------
    TrainingError
        If the file is not a checkpoint, or uses a name other than a PyTorch or Ultralytics layer.
    """
    from torch.nn import Module
    from torch.serialization import get_unsafe_globals_in_checkpoint

    layers, foreign = [], ""
    try:
        for name in get_unsafe_globals_in_checkpoint(path):
            module, _, word = name.rpartition(".")
            trusted = name.startswith(_LAYERS) or name == _OPTIONS
            layer = getattr(importlib.import_module(module), word) if trusted else None
            if isinstance(layer, type) and issubclass(layer, (Module, SimpleNamespace)):
                layers.append(layer)
            else:
                foreign = name
    # Reading a damaged pickle can raise any exception.
    except Exception as error:
        raise _not_loadable(path, error) from error
    if foreign:
        raise TrainingError(
            f"loading it would run {foreign}, which is not a network layer",
            source=path,
            remedy="use weights from a trusted source",
        )
    return layers


def _not_loadable(path: Path | str, error: Exception) -> TrainingError:
    return TrainingError(
        f"cannot load the weights ({error})",
        source=path,
        remedy="give a YOLO26 checkpoint (.pt)",
    )


def load_checkpoint(path: Path) -> Any:
    """Return the contents of a checkpoint.

    Parameters
    ----------
    path : Path
        A YOLO26 checkpoint (.pt), written by Ultralytics or by `strip_checkpoint`.

    Returns
    -------
    dict
        The entries of Ultralytics ('model' and others) and, after `strip_checkpoint`, 'place'.

    Raises
    ------
    TrainingError
        If the file is not a checkpoint, or contains more than a network (`require_layers`).
    """
    import torch

    layers = require_layers(path)
    try:
        with torch.serialization.safe_globals(layers):
            return torch.load(path, map_location="cpu", weights_only=True)
    # Unpickling a broken checkpoint can raise anything.
    except Exception as error:
        raise _not_loadable(path, error) from error


def stored_run_state(checkpoint: Path) -> dict[str, Any] | None:
    """Return the run state that `strip_checkpoint` stored in a checkpoint, or None.

    Raises
    ------
    TrainingError
        If the file is not a checkpoint.
    """
    entries = load_checkpoint(checkpoint)
    state = entries.get("place") if isinstance(entries, dict) else None
    return state if isinstance(state, dict) else None


def strip_checkpoint(checkpoint: Path, out: Path, run_state: dict[str, Any]) -> None:
    """Write a checkpoint in half precision and without optimiser state; replaces `out` atomically.

    `run_state` is stored with the weights, so that another machine can resume the run. Paths are
    reduced to file names and Git metadata is dropped: both describe the training machine.
    """
    import torch
    from ultralytics.utils.torch_utils import strip_optimizer

    part = out.with_suffix(".part")
    strip_optimizer(str(checkpoint), str(part))
    entries = load_checkpoint(part)
    entries.pop("git", None)
    entries["train_args"] = _without_folders(entries.get("train_args") or {})
    network = entries["model"]
    for holder in ("args", "yaml"):
        value = getattr(network, holder, None)
        if isinstance(value, dict):
            setattr(network, holder, _without_folders(value))
    network.pt_path = None
    entries["place"] = _without_folders(run_state)
    torch.save(entries, part)
    part.replace(out)


def _without_folders(values: dict[str, Any]) -> dict[str, Any]:
    """Replace paths by their file names."""
    return {
        key: Path(value).name if isinstance(value, str) and "/" in value else value
        for key, value in values.items()
    }


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
    """Import Ultralytics with telemetry, downloads and automatic installs disabled.

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
    dict.__setitem__(SETTINGS, "sync", False)
    events.events.enabled = False
    return ultralytics


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a CSV file, or an empty list if it does not exist."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows with the union of their columns as CSV; replaces the file atomically."""
    head = dict.fromkeys(key for row in rows for key in row)
    part = path.with_suffix(".part")
    with part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(head), restval="")
        writer.writeheader()
        writer.writerows(rows)
    part.replace(path)


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
        The checkpoint to write, in half precision; replaced atomically.
    share : float
        Weight of `second`, 0 to 1.

    Returns
    -------
    Path
        `out`. It stores no run state, so a training initialised with it starts a new run.

    Raises
    ------
    TrainingError
        If a file is not a checkpoint, the two architectures differ, or `share` is out of range.
    """
    import torch

    if not 0 <= share <= 1:
        raise TrainingError(
            f"the share {share} is out of range", remedy="give a number from 0 to 1"
        )
    entries_1, entries_2 = _load_network(first), _load_network(second)
    state_1, state_2 = (entries["model"].float().state_dict() for entries in (entries_1, entries_2))
    shapes_1, shapes_2 = ({k: v.shape for k, v in state.items()} for state in (state_1, state_2))
    if shapes_1 != shapes_2:
        raise TrainingError(
            f"its architecture differs from {first.name}",
            source=second,
            remedy="give two checkpoints that were trained from the same weights",
        )
    with torch.no_grad():
        for key, value in state_2.items():
            if value.is_floating_point():
                # The state dictionary refers to the network's own tensors: update them in place.
                value.copy_(torch.lerp(state_1[key], value, share))
    entries_2["model"].half()
    entries_2.pop("place", None)
    part = out.with_suffix(".part")
    torch.save(entries_2, part)
    part.replace(out)
    return out


def _load_network(path: Path) -> dict[str, Any]:
    """Return the contents of a checkpoint that stores a network."""
    import_ultralytics()
    entries = load_checkpoint(path)
    if not (isinstance(entries, dict) and hasattr(entries.get("model"), "state_dict")):
        raise TrainingError(
            "cannot load the weights (the file contains no network)",
            source=path,
            remedy="give a YOLO26 checkpoint (.pt) such as network.pt written by `train`",
        )
    return entries
