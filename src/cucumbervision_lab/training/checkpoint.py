"""Checkpoints, their weighted mean, Ultralytics without telemetry, and the tables of a run."""

from __future__ import annotations

import csv
import importlib
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cucumbervision.errors import MissingExtraError, TrainingError
from cucumbervision.perception.runtime import import_onnxruntime

_LAYERS = ("torch.nn.modules.", "ultralytics.nn.")


def require_layers(path: Path | str) -> list[Any]:
    """Return the classes of a checkpoint's layers; refuse one whose loading would run other code.

    A checkpoint is a pickle of the whole network. Which names it uses is seen without loading it.

    Raises
    ------
    TrainingError
        If it is no checkpoint, or uses a name that is no layer of PyTorch or Ultralytics.
    """
    from torch.nn import Module
    from torch.serialization import get_unsafe_globals_in_checkpoint

    layers, other = [], ""
    try:
        for name in get_unsafe_globals_in_checkpoint(path):
            module, _, word = name.rpartition(".")
            known = name.startswith(_LAYERS)
            layer = getattr(importlib.import_module(module), word) if known else None
            if isinstance(layer, type) and issubclass(layer, Module):
                layers.append(layer)
            else:
                other = name
    # Walking a broken pickle can raise anything.
    except Exception as error:
        raise _not_loadable(path, error) from error
    if other:
        raise TrainingError(
            f"loading it would run {other}, which is no layer of a network",
            source=path,
            remedy="use weights from somebody whom you trust",
        )
    return layers


def _not_loadable(path: Path | str, error: Exception) -> TrainingError:
    return TrainingError(
        f"these weights cannot be loaded ({error})",
        source=path,
        remedy="give a YOLO26 checkpoint (.pt)",
    )


def load_checkpoint(path: Path) -> Any:
    """Return what a checkpoint holds.

    Parameters
    ----------
    path : Path
        A YOLO26 checkpoint (.pt), as Ultralytics or `strip` wrote it.

    Returns
    -------
    dict
        Ultralytics' entries, 'model' and others, and `strip`'s 'place'.

    Raises
    ------
    TrainingError
        If the file is no checkpoint, or holds more than a network (`require_layers`).
    """
    import torch

    layers = require_layers(path)
    try:
        with torch.serialization.safe_globals(layers):
            return torch.load(path, map_location="cpu", weights_only=True)
    # Unpickling a broken checkpoint can raise anything.
    except Exception as error:
        raise _not_loadable(path, error) from error


def place_in(checkpoint: Path) -> dict[str, Any] | None:
    """Return the place in a plan that `strip` wrote into a checkpoint, or None.

    Raises
    ------
    TrainingError
        If the file is no checkpoint.
    """
    kept = load_checkpoint(checkpoint)
    found = kept.get("place") if isinstance(kept, dict) else None
    return found if isinstance(found, dict) else None


def strip(checkpoint: Path, out: Path, place: dict[str, Any]) -> None:
    """Write a checkpoint without its optimiser, in half precision; replaces `out` whole.

    `place` says where in which plan it stands, so that another machine can go on from it. Of paths
    on this machine only the names stay, and nothing of the folder's repository.
    """
    import torch
    from ultralytics.utils.torch_utils import strip_optimizer

    part = out.with_suffix(".part")
    strip_optimizer(str(checkpoint), str(part))
    kept = load_checkpoint(part)
    kept.pop("git", None)
    kept["train_args"] = _named(kept.get("train_args") or {})
    network = kept["model"]
    for holder in ("args", "yaml"):
        value = getattr(network, holder, None)
        if isinstance(value, dict):
            setattr(network, holder, _named(value))
    network.pt_path = None
    kept["place"] = _named(place)
    torch.save(kept, part)
    part.replace(out)


def _named(values: dict[str, Any]) -> dict[str, Any]:
    """Return paths as their last name."""
    return {
        key: Path(value).name if isinstance(value, str) and "/" in value else value
        for key, value in values.items()
    }


# Torch drops an operator's definition together with the library object that made it.
_libraries: list[Any] = []


def _import_torchvision() -> None:
    """Import torchvision, as Ultralytics does when it validates.

    A torchvision whose operators were built for another torch cannot be imported; with its two
    operators declared it can. Nothing here calls them: the exported head suppresses nothing.
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
        # The failed import left parts behind that would be taken for whole ones.
        for name in [n for n in sys.modules if n.partition(".")[0] == "torchvision"]:
            del sys.modules[name]
        importlib.import_module("torchvision")


def import_ultralytics() -> Any:
    """Import Ultralytics with its telemetry, downloads and installs off.

    Returns
    -------
    module
        `ultralytics`.

    Raises
    ------
    MissingExtraError
        If it is not installed.
    """
    os.environ["YOLO_OFFLINE"] = "1"
    os.environ["YOLO_AUTOINSTALL"] = "False"
    os.environ.setdefault("YOLO_VERBOSE", "False")
    # Ultralytics imports it too, and would leave its telemetry on.
    import_onnxruntime()
    try:
        # It sets how NumPy prints arrays, for everybody.
        with np.printoptions():
            _import_torchvision()
            import ultralytics
            from ultralytics.utils import SETTINGS, events
    except ImportError as error:
        raise MissingExtraError(error.name or "ultralytics", "train") from error
    # In this process only: the user's own settings file stays as it is.
    dict.__setitem__(SETTINGS, "sync", False)
    events.events.enabled = False
    return ultralytics


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a table; none where there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a table whose columns are those of all rows; a kill leaves the old or the new one."""
    head = dict.fromkeys(key for row in rows for key in row)
    part = path.with_suffix(".part")
    with part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(head), restval="")
        writer.writeheader()
        writer.writerows(rows)
    part.replace(path)


def average_networks(first: Path, second: Path, out: Path, share: float = 0.5) -> Path:
    """Write the weighted mean of two checkpoints.

    A network that was trained on keeps more of what it knew, and finds more on pictures unlike the
    new ones, if its weights are averaged with those that it began with (Wortsman et al., "Robust
    fine-tuning of zero-shot models", CVPR 2022).

    Parameters
    ----------
    first, second : Path
        Checkpoints (.pt) of one network, the second trained on from the first or both from one.
    out : Path
        The checkpoint to write, in half precision; replaced whole.
    share : float
        Of the second, 0 to 1.

    Returns
    -------
    Path
        `out`. It holds no place in a plan: a training that begins with it begins a plan.

    Raises
    ------
    TrainingError
        If a file is no checkpoint, the two differ in more than weights, or the share is no share.
    """
    import torch

    if not 0 <= share <= 1:
        raise TrainingError(f"{share} is no share", remedy="give a number from 0 to 1")
    one, other = _with_network(first), _with_network(second)
    mine, theirs = (kept["model"].float().state_dict() for kept in (one, other))
    shapes, other_shapes = ({k: v.shape for k, v in own.items()} for own in (mine, theirs))
    if shapes != other_shapes:
        raise TrainingError(
            f"it is not the network of {first.name}",
            source=second,
            remedy="give two checkpoints that were trained from the same one",
        )
    with torch.no_grad():
        for key, value in theirs.items():
            if value.is_floating_point():
                # In place: these are the second network's own weights.
                value.copy_(torch.lerp(mine[key], value, share))
    other["model"].half()
    other.pop("place", None)
    part = out.with_suffix(".part")
    torch.save(other, part)
    part.replace(out)
    return out


def _with_network(path: Path) -> dict[str, Any]:
    """Return a checkpoint with a network in it."""
    import_ultralytics()
    kept = load_checkpoint(path)
    if not (isinstance(kept, dict) and hasattr(kept.get("model"), "state_dict")):
        raise TrainingError(
            "these weights cannot be loaded (no network is in them)",
            source=path,
            remedy="give a YOLO26 checkpoint (.pt) as `train` writes it, network.pt",
        )
    return kept
