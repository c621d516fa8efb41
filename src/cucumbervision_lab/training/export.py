"""From a YOLO26 checkpoint to the one ONNX file that both runtimes load, and its card.

Ultralytics exports two forms (8.4): the one-to-many head, raw, whose overlaps the reader must
suppress; and the one-to-one head with the choice of the best 300 inside, which OpenVINO refuses
(GatherElements). The third form written here is the one-to-one head, raw: no suppression, the
choice is made by the reader, and both runtimes load it. It is laid out as Ultralytics' own raw
form, so that Ultralytics reads it too. Needs the extra `train`.
"""

from __future__ import annotations

import csv
import re
import shutil
import tempfile
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.files import read_json
from cucumbervision.errors import ModelError, TrainingError
from cucumbervision.perception.registry import file_sha256
from cucumbervision.perception.yolo import ONE_TO_ONE_KEY, ORDER_KEY, SIZES_KEY
from cucumbervision_lab.training.checkpoint import import_ultralytics, require_layers
from cucumbervision_lab.training.data import DATA_CARD, TASKS
from cucumbervision_lab.training.plan import RunState
from cucumbervision_lab.training.publish import MAKERS, ModelCard, write_card
from cucumbervision_lab.training.train import NETWORK

if TYPE_CHECKING:
    import onnx

_SMALLEST = 1024  # fewer numbers than this stay as they are: they cost nothing


def halve_storage(network: onnx.ModelProto) -> None:
    """Replace float32 weights by float16 ones, each widened by a Cast; changes the network.

    Both runtimes do the Cast once, when they load the file. Tables beyond float16's range stay.

    Parameters
    ----------
    network : onnx.ModelProto
        Any network.
    """
    from onnx import TensorProto, helper, numpy_helper

    graph = network.graph
    casts = []
    for tensor in graph.initializer:
        values = numpy_helper.to_array(tensor)
        if tensor.data_type != TensorProto.FLOAT or values.size < _SMALLEST:
            continue
        if np.abs(values).max() > np.finfo(np.float16).max:
            continue
        name = tensor.name
        tensor.CopyFrom(numpy_helper.from_array(values.astype(np.float16), f"{name}.half"))
        casts.append(helper.make_node("Cast", [f"{name}.half"], [name], to=TensorProto.FLOAT))
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)


_OPSET = 17


def export_yolo(
    checkpoint: Path | str,
    out: Path | str,
    *,
    size_px: int | tuple[int, int] = 640,
    dynamic: bool = False,
    half: bool = False,
    input_sizes: Sequence[int] = (),
) -> Path:
    """Export a checkpoint's one-to-one head to ONNX, in the form of a raw output.

    Parameters
    ----------
    checkpoint : Path or str
        A YOLO26 .pt file (detect, segment or pose), or an Ultralytics .yaml for random weights.
    out : Path or str
        The file to write.
    size_px : int or tuple of int
        Height and width of the input; a multiple of the stride.
    dynamic : bool
        Let the network take any size.
    half : bool
        Store the weights in half precision; inputs and outputs stay float32.
    input_sizes : sequence of int
        Long sides at which the network is run where no others are asked for, pixels; without any
        `size_px` alone.

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
    model = _load(checkpoint)
    return export_model(
        model, out, size_px=size_px, dynamic=dynamic, half=half, input_sizes=input_sizes
    )


def _load(checkpoint: Path | str) -> Any:
    ultralytics = import_ultralytics()
    try:
        if Path(checkpoint).suffix == ".pt":
            require_layers(checkpoint)
        return ultralytics.YOLO(str(checkpoint))
    except TrainingError as error:
        raise ModelError(error.message, source=checkpoint, remedy=error.remedy) from error
    # Unpickling a broken checkpoint can raise anything.
    except Exception as error:
        raise ModelError(
            f"Ultralytics cannot load it ({error})",
            source=checkpoint,
            remedy="give a YOLO26 checkpoint (.pt)",
        ) from error


def export_model(
    model: Any,
    out: Path | str,
    *,
    size_px: int | tuple[int, int] = 640,
    dynamic: bool = False,
    half: bool = False,
    input_sizes: Sequence[int] = (),
) -> Path:
    """Export a loaded `ultralytics.YOLO`; see `export_yolo`."""
    detect = model.model.model[-1]
    if getattr(detect, "one2one_cv2", None) is None:
        raise ModelError("it has no one-to-one head", source=model.ckpt_path, remedy="use YOLO26")
    out = Path(out)
    with tempfile.TemporaryDirectory() as folder:
        # Ultralytics writes beside the checkpoint; the checkpoint's own folder stays clean.
        model.ckpt_path = model.model.pt_path = str(Path(folder) / "network.pt")
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
                    nms=False,
                    device="cpu",
                    verbose=False,
                )
        finally:
            detect.__dict__.pop("postprocess", None)
        out.parent.mkdir(parents=True, exist_ok=True)
        own = {
            ORDER_KEY: str(getattr(model.model, "keypoint_order", "")),
            SIZES_KEY: ",".join(map(str, input_sizes)),
            "end2end": "False",
            ONE_TO_ONE_KEY: "True",
        }
        _finish(Path(written), own, half=half)
        shutil.move(written, out)
    return out


def _corners_to_centres(rows: Any) -> Any:
    """Lay the one-to-one head's rows (B, N, 4 + classes + extra) out as a raw output.

    It replaces `Detect.postprocess`, which chooses the best 300.
    """
    import torch

    low, high, rest = rows[..., :2], rows[..., 2:4], rows[..., 4:]
    return torch.cat(((low + high) / 2, high - low, rest), dim=-1).permute(0, 2, 1)


def _finish(path: Path, own: dict[str, str], *, half: bool) -> None:
    """Add what is not empty of our own metadata, and halve the weights' storage.

    The same weights give the same bytes, so that a card's evaluation stands for a file that was
    exported again.
    """
    import onnx

    network = onnx.load(path)
    entries = {entry.key: entry.value for entry in network.metadata_props}
    # Paths of the training machine are private.
    entries["description"] = entries.get("description", "").split(" trained on ")[0]
    entries.pop("date", None)
    entries |= {key: value for key, value in own.items() if value}
    onnx.helper.set_model_props(network, entries)
    if half:
        # Ultralytics' own half precision computes in it too: positions from 512 px on then lie on
        # a grid of half pixels.
        halve_storage(network)
    onnx.save(network, path)


_NAME = re.compile(r"[a-z0-9][a-z0-9.-]*")

_SIZE_PX = 640


def export_trained(
    source: Path,
    out: Path,
    name: str,
    *,
    evaluation: Path | None = None,
    credits: Sequence[str] = (),
    input_sizes: Sequence[int] = (),
) -> ModelCard:
    """Export a run's newest weights, or a checkpoint, and write the card beside them.

    The file takes any size that is a multiple of 32, holds the one-to-one head, which needs no
    suppression, and stores its weights in half precision; what it computes is float32.

    Parameters
    ----------
    source : Path
        A run's folder, or a YOLO26 checkpoint (.pt) of one class.
    out : Path
        Folder for `NAME.onnx`, `NAME.md` and `NAME.json`.
    name : str
        What commands are to call it: small letters, digits, '-' and '.'.
    evaluation : Path, optional
        A JSON file of an evaluation, taken into the card as it is.
    credits : sequence of str
        Whom the card names beside the network's makers: publishers of pictures.
    input_sizes : sequence of int
        As for `export_yolo`.

    Returns
    -------
    ModelCard
        As written.

    Raises
    ------
    TrainingError
        If no epoch of the run is through, the name or the evaluation cannot be used, or the
        network is for another task or several classes.
    CaptureError
        If the evaluation's file is no JSON.
    ModelError
        If the checkpoint cannot be loaded.
    MissingExtraError
        If the extra `train` is not installed.
    """
    if not _NAME.fullmatch(name):
        raise TrainingError(
            f"{name!r} cannot name a network", remedy="use small letters, digits, '-' and '.'"
        )
    judged = read_json(evaluation) if evaluation else {}
    if not isinstance(judged, dict):
        raise TrainingError("holds no JSON object", source=evaluation, remedy="give another file")
    checkpoint = source / NETWORK if source.is_dir() else source
    if not checkpoint.is_file():
        raise TrainingError(
            "there are no weights yet", source=source, remedy="train on with --resume"
        )
    model = _load(checkpoint)
    if model.task not in TASKS.values() or len(model.names) != 1:
        raise TrainingError(
            f"is a network for {model.task} with {len(model.names)} classes",
            source=checkpoint,
            remedy="give one of one class for segment or pose",
        )
    path = export_model(
        model,
        out / f"{name}.onnx",
        size_px=_SIZE_PX,
        dynamic=True,
        half=True,
        input_sizes=input_sizes,
    )
    known = _known_of_run(source) if source.is_dir() else {}
    card = ModelCard(
        name=name,
        task=str(model.task),
        file=path.name,
        sha256=file_sha256(path),
        size_bytes=path.stat().st_size,
        checkpoint_sha256=file_sha256(checkpoint),
        evaluation=judged,
        credits=(*MAKERS, *credits),
        versions={"torch": version("torch"), "ultralytics": import_ultralytics().__version__},
        **known,
    )
    write_card(card, out)
    return card


def _known_of_run(run: Path) -> dict[str, Any]:
    """Return a run's entries for the card, without any path of this machine."""
    state = RunState.load(run)
    init, data = Path(state.init).name, run / DATA_CARD
    return {
        "began_with": init,
        "plan": f"{state.pictures} of {state.plan.text} pictures in {state.seconds / 3600:.1f} h",
        "command": f"cucumbervision train {state.task} DATA --out RUN --init {init} "
        f"--plan {state.plan.text} --seed {state.seed}",
        "metrics": last_metrics(run / "metrics.csv"),
        "data": data.read_text(encoding="utf-8") if data.is_file() else "",
    }


def last_metrics(table: Path) -> dict[str, float]:
    """Return Ultralytics' metrics of a run's last validation.

    Parameters
    ----------
    table : Path
        A run's `metrics.csv`.

    Returns
    -------
    dict of str to float
        'mAP50(B)' and the like (B boxes, M masks, P points), the pictures seen and their size.
        Empty without any.
    """
    if not table.is_file():
        return {}
    with table.open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row.get("fitness")]
    if not rows:
        return {}
    found = {
        key.removeprefix("metrics/"): float(value)
        for key, value in rows[-1].items()
        if key.startswith("metrics/")
    }
    return {"size_px": float(rows[-1]["size_px"]), "pictures": float(rows[-1]["pictures"]), **found}
