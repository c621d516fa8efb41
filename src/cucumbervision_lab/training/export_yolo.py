"""From a YOLO26 checkpoint to the one ONNX file that both runtimes load.

Ultralytics exports two forms (8.4): the one-to-many head, raw, whose overlaps the reader must
suppress; and the one-to-one head with the choice of the best 300 inside, which OpenVINO refuses
(GatherElements). The third form written here is the one-to-one head, raw: no suppression, the
choice is made by the reader, and both runtimes load it. It is laid out as Ultralytics' own raw
form, so that Ultralytics reads it too. Needs the extra `train`.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from cucumbervision.errors import MissingExtraError, ModelError
from cucumbervision.perception.runtime import import_onnxruntime
from cucumbervision.perception.yolo import ONE_TO_ONE_KEY, ORDER_KEY
from cucumbervision_lab.training.half_storage import halve_storage
from cucumbervision_lab.training.torchvision_ops import ensure_torchvision

__all__ = ["HEADS", "export_model", "export_yolo", "import_ultralytics"]

HEADS = ("one-to-one", "one-to-many", "end-to-end")
"""Forms of export: ours, and Ultralytics' two."""

_OPSET = 17


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


def export_yolo(
    checkpoint: Path | str,
    out: Path | str,
    *,
    head: str = "one-to-one",
    size_px: int | tuple[int, int] = 640,
    dynamic: bool = False,
    half: bool = False,
) -> Path:
    """Export a checkpoint to ONNX.

    Parameters
    ----------
    checkpoint : Path or str
        A YOLO26 .pt file (detect, segment or pose), or an Ultralytics .yaml for random weights.
    out : Path or str
        The file to write.
    head : str
        'one-to-one' (the shipped form), 'one-to-many' or 'end-to-end' (Ultralytics' own).
    size_px : int or tuple of int
        Height and width of the input; a multiple of the stride.
    dynamic : bool
        Let the network take any size.
    half : bool
        Store the weights in half precision; inputs and outputs stay float32.

    Returns
    -------
    Path
        `out`.

    Raises
    ------
    ModelError
        If the checkpoint cannot be read, or has no one-to-one head.
    MissingExtraError
        If the extra `train` is not installed.
    """
    if head not in HEADS:
        raise ModelError(f"no head is called {head!r}", remedy=f"choose one of {', '.join(HEADS)}")
    ultralytics = import_ultralytics()
    try:
        model = ultralytics.YOLO(str(checkpoint))
    # Unpickling a broken checkpoint can raise anything.
    except Exception as error:
        raise ModelError(
            f"Ultralytics cannot load it ({error})",
            source=checkpoint,
            remedy="give a YOLO26 checkpoint (.pt)",
        ) from error
    return export_model(model, out, head=head, size_px=size_px, dynamic=dynamic, half=half)


def export_model(
    model: Any,
    out: Path | str,
    *,
    head: str = "one-to-one",
    size_px: int | tuple[int, int] = 640,
    dynamic: bool = False,
    half: bool = False,
) -> Path:
    """Export a loaded `ultralytics.YOLO`; see `export_yolo`."""
    detect = model.model.model[-1]
    if head != "one-to-many" and getattr(detect, "one2one_cv2", None) is None:
        raise ModelError("it has no one-to-one head", source=model.ckpt_path, remedy="use YOLO26")
    out = Path(out)
    with tempfile.TemporaryDirectory() as folder:
        # Ultralytics writes beside the checkpoint; the checkpoint's own folder stays clean.
        model.ckpt_path = model.model.pt_path = str(Path(folder) / "network.pt")
        if head == "one-to-one":
            detect.postprocess = _corners_to_centres
        try:
            with warnings.catch_warnings():
                # The tracer warns of itself and of branches on shapes.
                warnings.simplefilter("ignore")
                written = model.export(
                    format="onnx",
                    imgsz=size_px,
                    dynamic=dynamic,
                    opset=_OPSET,
                    simplify=False,
                    nms=None if head == "one-to-many" else False,
                    device="cpu",
                    verbose=False,
                )
        finally:
            detect.__dict__.pop("postprocess", None)
        out.parent.mkdir(parents=True, exist_ok=True)
        order = str(getattr(model.model, "keypoint_order", ""))
        _finish(Path(written), one_to_one=head == "one-to-one", half=half, order=order)
        shutil.move(written, out)
    return out


def _corners_to_centres(rows: Any) -> Any:
    """Lay the one-to-one head's rows (B, N, 4 + classes + extra) out as a raw output.

    It stands in for `Detect.postprocess`, which chooses the best 300.
    """
    import torch

    low, high, rest = rows[..., :2], rows[..., 2:4], rows[..., 4:]
    return torch.cat(((low + high) / 2, high - low, rest), dim=-1).permute(0, 2, 1)


def _finish(path: Path, *, one_to_one: bool, half: bool, order: str) -> None:
    """Say in the metadata which head and order of points it is, and halve the weights' storage."""
    import onnx

    network = onnx.load(path)
    entries = {entry.key: entry.value for entry in network.metadata_props}
    # Where the data lay on the machine of whoever trained is nobody's business.
    entries["description"] = entries.get("description", "").split(" trained on ")[0]
    if one_to_one:
        entries |= {"end2end": "False", ONE_TO_ONE_KEY: "True"}
    if order:
        entries[ORDER_KEY] = order
    onnx.helper.set_model_props(network, entries)
    if half:
        # Ultralytics' own half precision computes in it too: positions from 512 px on then lie on
        # a grid of half pixels.
        halve_storage(network)
    onnx.save(network, path)
