"""Import what training needs: torchvision beside a CPU-only torch, Ultralytics without telemetry.

The torchvision wheels of the Python package index are linked against CUDA: beside a CPU-only
torch their operators do not load, and the import ends with 'operator torchvision::nms does not
exist'. Ultralytics needs torchvision for little more than that one operator, so it is given here.
Where torchvision's own operators load, nothing is done.
"""

from __future__ import annotations

import importlib
import os
import sys
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.errors import MissingExtraError
from cucumbervision.perception.boxes import suppress
from cucumbervision.perception.runtime import import_onnxruntime

if TYPE_CHECKING:
    import torch

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
    ensure_torchvision()
    # Ultralytics imports it too, and would leave its telemetry on.
    import_onnxruntime()
    try:
        # It sets how NumPy prints arrays, for everybody.
        with np.printoptions():
            import ultralytics
            from ultralytics.utils import SETTINGS, events
    except ImportError as error:
        raise MissingExtraError("ultralytics", "train") from error
    # In this process only: the user's own settings file stays as it is.
    dict.__setitem__(SETTINGS, "sync", False)
    events.events.enabled = False
    return ultralytics


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

    classes = np.zeros(len(boxes), int)
    kept = suppress(boxes.detach().numpy(), scores.detach().numpy(), classes, iou_threshold)
    return torch.from_numpy(kept)
