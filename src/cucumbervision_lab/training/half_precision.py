"""Train in bfloat16 on processors that compute in it.

Ultralytics narrows numbers on graphics cards only. Here the network's own layers run under
autocast on the CPU, and what they give is widened again before the loss, which stays in float32.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

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
