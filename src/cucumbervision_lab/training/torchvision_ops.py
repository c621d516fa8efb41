"""Make torchvision importable beside a CPU-only torch.

The torchvision wheels of the Python package index are linked against CUDA: beside a CPU-only
torch their operators do not load, and the import ends with 'operator torchvision::nms does not
exist'. Ultralytics needs torchvision for little more than that one operator, so it is given here.
Where torchvision's own operators load, nothing is done.
"""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

from cucumbervision.errors import MissingExtraError

if TYPE_CHECKING:
    import torch

__all__ = ["ensure_torchvision", "nms"]

# Torch drops an operator's definition together with the library object that made it.
_libraries: list[Any] = []


def ensure_torchvision() -> str:
    """Import torchvision, with an `nms` of our own where its operators do not load.

    Call it before anything imports Ultralytics.

    Returns
    -------
    str
        'native' where torchvision's own operators are used, 'own' where ours is.

    Raises
    ------
    MissingExtraError
        If torch or torchvision is not installed.
    """
    if _libraries:
        return "own"
    try:
        importlib.import_module("torch")
        importlib.import_module("torchvision")
    except ImportError as error:
        raise MissingExtraError(error.name or "torchvision", "train") from error
    except RuntimeError as error:
        if "torchvision::nms" not in str(error):
            raise
    else:
        return "native"
    import torch

    library = torch.library.Library("torchvision", "DEF")
    # torchvision describes both on import; the quantised one is never called here.
    for name in ("nms", "qnms"):
        library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    library.impl("nms", nms, "CPU")
    _libraries.append(library)
    # The failed import left parts of torchvision behind that would be taken for whole ones.
    for name in [n for n in sys.modules if n == "torchvision" or n.startswith("torchvision.")]:
        del sys.modules[name]
    importlib.import_module("torchvision")
    # torchvision asks whether its library was loaded, not whether the operator exists. Only asked
    # for boxes: the other operators keep their own fallback or their own error.
    boxes = importlib.import_module("torchvision.ops.boxes")
    setattr(boxes, "_assert_has_ops", lambda: None)  # noqa: B010
    return "own"


def nms(boxes: torch.Tensor, scores: torch.Tensor, iou_threshold: float) -> torch.Tensor:
    """Drop every box that overlaps a better one, as `torchvision.ops.nms` does.

    Parameters
    ----------
    boxes : Tensor of float, shape (N, 4)
        x1, y1, x2, y2.
    scores : Tensor of float, shape (N,)
        Any order.
    iou_threshold : float
        Overlap above which the worse is dropped.

    Returns
    -------
    Tensor of int64
        Indices of the boxes kept, best first.
    """
    import torch

    left = scores.argsort(descending=True, stable=True)
    area = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    kept: list[int] = []
    while len(left):
        first, left = int(left[0]), left[1:]
        kept.append(first)
        low = torch.maximum(boxes[first, :2], boxes[left, :2])
        high = torch.minimum(boxes[first, 2:], boxes[left, 2:])
        overlap = (high - low).clamp(min=0).prod(dim=1)
        # Boxes without area give 0/0: no overlap, and they stay.
        left = left[~(overlap / (area[first] + area[left] - overlap) > iou_threshold)]
    return torch.tensor(kept, dtype=torch.int64)
