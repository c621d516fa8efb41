"""The weighted mean of two networks that were trained from the same one.

A network that was trained on keeps more of what it knew, and finds more on pictures unlike the
new ones, if its weights are averaged with those that it began with.

Source: Wortsman et al., "Robust fine-tuning of zero-shot models", CVPR 2022.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cucumbervision.errors import TrainingError
from cucumbervision_lab.training.checkpoint import import_ultralytics, load_checkpoint


def average_networks(first: Path, second: Path, out: Path, share: float = 0.5) -> Path:
    """Write the weighted mean of two checkpoints.

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
    one, other = _checkpoint(first), _checkpoint(second)
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


def _checkpoint(path: Path) -> dict[str, Any]:
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
