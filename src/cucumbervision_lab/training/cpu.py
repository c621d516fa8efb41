"""Faster training on a processor: masks assigned at half the resolution, and bfloat16."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any


def losses_of(model: Any) -> list[Any]:
    """Return the losses of the one-to-many and the one-to-one head, or the only one.

    Parameters
    ----------
    model : ultralytics.nn.tasks.BaseModel
        With or without a criterion; it gets one.
    """
    if getattr(model, "criterion", None) is None:
        model.criterion = model.init_criterion()
    heads = (getattr(model.criterion, name, None) for name in ("one2many", "one2one"))
    return [head for head in heads if head is not None] or [model.criterion]


_FACTOR = 2


def assign_coarsely(model: Any) -> None:
    """Make a segmenting network's loss assign by masks of half the size in both directions.

    The masks that the network learns stay whole: only the choice of the anchors is coarser.

    Parameters
    ----------
    model : ultralytics.nn.tasks.SegmentationModel
        With or without a criterion; it gets one.
    """
    for loss in losses_of(model):
        loss.assigner = _coarse(loss.assigner)


def _coarse(assigner: Any) -> Any:
    from torch.nn.functional import avg_pool2d
    from ultralytics.utils.tal import SegTaskAlignedAssigner

    class Coarse(SegTaskAlignedAssigner):  # type: ignore[misc]
        """Sees masks and prototypes at half the size."""

        def forward(self, *seen: Any, **of_masks: Any) -> Any:
            """Assign; `of_masks` are the prototypes, the true masks and their scale."""
            if "proto" not in of_masks:
                return super().forward(*seen, **of_masks)
            rows = cells = slice(_FACTOR // 2, None, _FACTOR)
            coarse = of_masks | {
                "mask_scale": of_masks["mask_scale"] / _FACTOR,
                "proto": avg_pool2d(of_masks["proto"], _FACTOR),
                "gt_masks": of_masks["gt_masks"][..., rows, cells],
            }
            return super().forward(*seen, **coarse)

    names = ("topk", "topk2", "num_classes", "alpha", "beta", "stride")
    return Coarse(**{name: getattr(assigner, name) for name in names})


_FLAGS = ("avx512_bf16", "amx_bf16")


def cpu_has_bfloat16(cpuinfo: str | None = None) -> bool:
    """Return whether the processor computes in bfloat16 (AVX-512 BF16 or AMX).

    Parameters
    ----------
    cpuinfo : str, optional
        The system's description of it; Linux's /proc/cpuinfo without it.

    Returns
    -------
    bool
        False where there is no such description.

    Examples
    --------
    >>> cpu_has_bfloat16("flags : sse avx512_bf16")
    True
    """
    if cpuinfo is None:
        path = Path("/proc/cpuinfo")
        cpuinfo = path.read_text(encoding="utf-8") if path.is_file() else ""
    return not set(_FLAGS).isdisjoint(cpuinfo.split())


def choose_precision(asked: str, device: str) -> str:
    """Say in which precision a training runs.

    Parameters
    ----------
    asked : str
        'auto', 'f32' or 'bf16'.
    device : str
        'cpu', or anything else for a graphics card, where Ultralytics' own way is used.

    Returns
    -------
    str
        'f32' or 'bf16'.

    Examples
    --------
    >>> choose_precision("f32", "cpu")
    'f32'
    """
    if asked != "auto":
        return asked
    return "bf16" if device == "cpu" and cpu_has_bfloat16() else "f32"


def channels_last(model: Any) -> None:
    """Keep a network's weights with the channels innermost, which is quicker on the CPU too.

    Parameters
    ----------
    model : torch.nn.Module
        Its values stay as they are. Ultralytics writes files in the usual order again.
    """
    import torch

    model.to(memory_format=torch.channels_last)


def narrow(model: Any) -> None:
    """Run a network's layers in bfloat16 from here on, until `widen`.

    Parameters
    ----------
    model : ultralytics.nn.tasks.BaseModel
        On the CPU; its weights stay in float32, and so does what `predict` gives.
    """
    model.predict = partial(_predict, model)


def widen(model: Any) -> None:
    """Undo `narrow`. Copies and files of a network are made from the plain one only."""
    model.__dict__.pop("predict", None)


def _predict(model: Any, *args: Any, **kwargs: Any) -> Any:
    import torch

    with torch.autocast("cpu", torch.bfloat16):
        given = type(model).predict(model, *args, **kwargs)
    return _float32(given)


def _float32(value: Any) -> Any:
    """Widen every bfloat16 tensor in nested lists, tuples and dictionaries."""
    import torch

    if isinstance(value, torch.Tensor):
        return value.float() if value.dtype == torch.bfloat16 else value
    if isinstance(value, dict):
        return {key: _float32(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_float32(item) for item in value)
    return value
