"""Checkpoints: loaded, stripped of the optimiser, and the place in a plan that they hold."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cucumbervision.errors import TrainingError


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
        If the file is no checkpoint.
    """
    import torch

    try:
        # A checkpoint that the user named; it keeps the whole network, not weights alone.
        return torch.load(path, map_location="cpu", weights_only=False)
    # Unpickling a broken checkpoint can raise anything.
    except Exception as error:
        raise TrainingError(
            f"these weights cannot be loaded ({error})",
            source=path,
            remedy="give a YOLO26 checkpoint (.pt)",
        ) from error


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
