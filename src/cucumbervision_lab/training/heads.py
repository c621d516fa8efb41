"""The losses of a network's heads, which is where what it learns is changed."""

from __future__ import annotations

from typing import Any

__all__ = ["losses_of"]


def losses_of(model: Any) -> list[Any]:
    """Give the losses of the one-to-many and the one-to-one head, or the only one.

    Parameters
    ----------
    model : ultralytics.nn.tasks.BaseModel
        With or without a criterion; it gets one.
    """
    if getattr(model, "criterion", None) is None:
        model.criterion = model.init_criterion()
    heads = (getattr(model.criterion, name, None) for name in ("one2many", "one2one"))
    return [head for head in heads if head is not None] or [model.criterion]
