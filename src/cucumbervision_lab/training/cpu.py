"""Faster training on the CPU: anchor assignment with half-size masks, and bfloat16."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any


def head_losses(model: Any) -> list[Any]:
    """Return the losses of the one-to-many and one-to-one heads, or the single loss.

    Parameters
    ----------
    model : ultralytics.nn.tasks.BaseModel
        Its criterion is created if missing.
    """
    if getattr(model, "criterion", None) is None:
        model.criterion = model.init_criterion()
    heads = (getattr(model.criterion, name, None) for name in ("one2many", "one2one"))
    return [head for head in heads if head is not None] or [model.criterion]


_FACTOR = 2


def assign_at_half_resolution(model: Any) -> None:
    """Assign anchors with masks of half the height and width.

    The mask loss keeps the full resolution; only the choice of anchors is coarser.

    Parameters
    ----------
    model : ultralytics.nn.tasks.SegmentationModel
        Its criterion is created if missing.
    """
    for loss in head_losses(model):
        loss.assigner = _half_resolution(loss.assigner)


def _half_resolution(assigner: Any) -> Any:
    from torch.nn.functional import avg_pool2d
    from ultralytics.utils.tal import SegTaskAlignedAssigner

    class HalfResolutionAssigner(SegTaskAlignedAssigner):  # type: ignore[misc]
        """Assigner that receives masks and prototypes at half the size."""

        def forward(self, *args: Any, **masks: Any) -> Any:
            """Assign anchors; `masks` has the prototypes, the true masks and their scale."""
            if "proto" not in masks:
                return super().forward(*args, **masks)
            rows = columns = slice(_FACTOR // 2, None, _FACTOR)
            coarse = masks | {
                "mask_scale": masks["mask_scale"] / _FACTOR,
                "proto": avg_pool2d(masks["proto"], _FACTOR),
                "gt_masks": masks["gt_masks"][..., rows, columns],
            }
            return super().forward(*args, **coarse)

    names = ("topk", "topk2", "num_classes", "alpha", "beta", "stride")
    return HalfResolutionAssigner(**{name: getattr(assigner, name) for name in names})


_FLAGS = ("avx512_bf16", "amx_bf16")


def cpu_has_bfloat16(cpuinfo: str | None = None) -> bool:
    """Return whether the CPU supports bfloat16 arithmetic (AVX-512 BF16 or AMX).

    Parameters
    ----------
    cpuinfo : str, optional
        Contents of /proc/cpuinfo; by default, the file is read.

    Returns
    -------
    bool
        False on systems without /proc/cpuinfo.

    Examples
    --------
    >>> cpu_has_bfloat16("flags : sse avx512_bf16")
    True
    """
    if cpuinfo is None:
        path = Path("/proc/cpuinfo")
        cpuinfo = path.read_text(encoding="utf-8") if path.is_file() else ""
    return not set(_FLAGS).isdisjoint(cpuinfo.split())


def choose_precision(requested: str, device: str) -> str:
    """Return the floating-point precision of a training.

    Parameters
    ----------
    requested : str
        'auto', 'f32' or 'bf16'.
    device : str
        'cpu' or a GPU number. On a GPU 'auto' is 'f32': Ultralytics handles mixed precision itself.

    Returns
    -------
    str
        'f32' or 'bf16'.

    Examples
    --------
    >>> choose_precision("f32", "cpu")
    'f32'
    """
    if requested != "auto":
        return requested
    return "bf16" if device == "cpu" and cpu_has_bfloat16() else "f32"


def channels_last(model: Any) -> None:
    """Convert a network's weights to the channels-last memory format, which is faster on CPUs.

    Parameters
    ----------
    model : torch.nn.Module
        Changed in place; its values stay the same. Checkpoints are saved in the default format.
    """
    import torch

    model.to(memory_format=torch.channels_last)


def enable_bfloat16(model: Any) -> None:
    """Run a network's layers in bfloat16 until `disable_bfloat16`.

    Parameters
    ----------
    model : ultralytics.nn.tasks.BaseModel
        A network on the CPU. Weights and the output of `predict` stay float32.
    """
    model.predict = partial(_predict, model)


def disable_bfloat16(model: Any) -> None:
    """Undo `enable_bfloat16`; required before a network is copied or saved."""
    model.__dict__.pop("predict", None)


def _predict(model: Any, *args: Any, **kwargs: Any) -> Any:
    import torch

    with torch.autocast("cpu", torch.bfloat16):
        output = type(model).predict(model, *args, **kwargs)
    return _float32(output)


def _float32(value: Any) -> Any:
    """Convert every bfloat16 tensor in nested lists, tuples and dictionaries to float32."""
    import torch

    if isinstance(value, torch.Tensor):
        return value.float() if value.dtype == torch.bfloat16 else value
    if isinstance(value, dict):
        return {key: _float32(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_float32(item) for item in value)
    return value
