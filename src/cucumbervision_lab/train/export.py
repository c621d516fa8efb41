"""Export a YOLO26 checkpoint to an ONNX file for both runtimes, with a model card.

Ultralytics 8.4 exports either the raw one-to-many head, which needs non-maximum suppression, or
the one-to-one head with a built-in top-300 selection, which OpenVINO cannot load
(GatherElements). This module exports the raw one-to-one head: it needs no suppression, and both
runtimes load it. The output layout is Ultralytics' raw layout, so Ultralytics can read the file
too. Requires the extra `train`.
"""

from __future__ import annotations

import csv
import json
import math
import re
import shutil
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from cucumbervision.errors import ModelError, TrainingError
from cucumbervision.files import read_json
from cucumbervision.networks import DETECTOR_SIZES_PX
from cucumbervision.networks.registry import file_sha256
from cucumbervision.networks.yolo import ONE_TO_ONE_KEY, ORDER_KEY, SIZES_KEY
from cucumbervision_lab.train.network import (
    BEGUN,
    DATA_CARD,
    NETWORK,
    TASKS,
    import_ultralytics,
    load_yolo,
)

_LICENCE = "AGPL-3.0-only"

_WHAT = {
    "segment": "YOLO26, task segment, one class (cucumber).",
    "pose": "YOLO26, task pose, one class (cucumber), five keypoints. They run from a fruit's "
    "lower left end to its upper right one where the file's metadata say `keypoint_order: place`, "
    "and `cucumber-fruit` tells which is the stem's; else from the blossom end to the stem end.",
    "fruit": "Draws the outline and five keypoints of one detected cucumber at the camera's "
    "resolution, from colour, depth and the detector's mask around it, turned along the mask; and "
    "tells whether it is a cucumber and which end is the stem's.",
    "look": "Looks at each end of a measured cucumber, from the picture, the depth and the mask "
    "around it, turned along the fruit: whether the fruit ends there, goes on behind something or "
    "stops before, how much of its length may be missing, and whether it is the stem end.",
}

MAKERS = ("Network and its first weights: Ultralytics YOLO26, AGPL-3.0",)
"""Credits of every card."""

_LIMITS = (
    "One class. Zucchini may count as cucumbers; other long fruit, leaves and stems should not, "
    "but sometimes will.",
    "Trained for fruit at 0.3 to 1.2 m; small, far or mostly hidden fruit are missed more often.",
    "Fruit that overlap may be given one mask, and one hidden in its middle two boxes.",
    "Stored in half precision and computed in full; not quantised to 8 bits, since what that "
    "costs was not measured.",
)


@dataclass(frozen=True)
class ModelCard:
    """Description of an exported network.

    Parameters
    ----------
    name : str
        Name of the model in commands.
    task : str
        'segment', 'pose', 'fruit' or 'look'.
    file : str
        Name of the ONNX file.
    sha256 : str
        SHA-256 of the ONNX file.
    size_bytes : int
        Size of the ONNX file.
    checkpoint_sha256 : str
        SHA-256 of the exported checkpoint.
    began_with : str
        Initial weights of the training.
    plan : str
        What was trained, as in '50 epochs at 640 px'; empty if only the checkpoint is known.
    command : str
        Training command, without local paths.
    metrics : mapping of str to float
        Validation metrics of the exported epoch.
    evaluation : mapping
        Results of a separate evaluation, including its command.
    data : str
        Card of the data set, in Markdown.
    licence : str
        SPDX identifier.
    credits, limits : tuple of str
        Credits and known limitations, one sentence each.
    versions : mapping of str to str
        Versions of torch and Ultralytics.
    """

    name: str
    task: str
    file: str
    sha256: str
    size_bytes: int
    checkpoint_sha256: str
    began_with: str = ""
    plan: str = ""
    command: str = ""
    metrics: Mapping[str, float] = field(default_factory=dict)
    evaluation: Mapping[str, Any] = field(default_factory=dict)
    data: str = ""
    licence: str = _LICENCE
    credits: tuple[str, ...] = MAKERS
    limits: tuple[str, ...] = _LIMITS
    versions: Mapping[str, str] = field(default_factory=dict)


def write_card(card: ModelCard, out: Path) -> tuple[Path, Path]:
    """Write a card as Markdown (.md) and JSON (.json).

    Parameters
    ----------
    card : ModelCard
        The card; metrics that are not finite are omitted.
    out : Path
        Folder; the files are named after the network.

    Returns
    -------
    tuple of Path
        The Markdown file and the JSON file.
    """
    out.mkdir(parents=True, exist_ok=True)
    metrics = {name: value for name, value in card.metrics.items() if math.isfinite(value)}
    card = replace(card, metrics=metrics)
    page, record = out / f"{card.name}.md", out / f"{card.name}.json"
    page.write_text(card_markdown(card), encoding="utf-8")
    text = json.dumps(asdict(card), indent=2, ensure_ascii=False, allow_nan=False)
    record.write_text(text + "\n", encoding="utf-8")
    return page, record


def described(
    network: Path, checkpoint: Path, *, credits: Sequence[str] = (), **fields: Any
) -> ModelCard:
    """Write the card of an ONNX file that was made from a checkpoint next to it."""
    card = ModelCard(
        file=network.name,
        sha256=file_sha256(network),
        size_bytes=network.stat().st_size,
        checkpoint_sha256=file_sha256(checkpoint),
        credits=(*MAKERS, *credits),
        **fields,
    )
    write_card(card, network.parent)
    return card


def card_markdown(card: ModelCard) -> str:
    """Return a card as Markdown.

    Examples
    --------
    >>> print(card_markdown(ModelCard("c-seg", "segment", "c-seg.onnx", "ab", 5, "cd"))[:9])
    # c-seg
    """
    lines = [
        f"# {card.name}",
        "",
        _WHAT[card.task],
        "",
        f"- file: `{card.file}`, {card.size_bytes / 1e6:.2f} MB, SHA-256 `{card.sha256}`",
        f"- exported from a checkpoint with SHA-256 `{card.checkpoint_sha256}`",
        f"- licence: {card.licence}",
    ]
    if card.began_with:
        lines.append(f"- began with: `{card.began_with}`")
    if card.plan:
        lines.append(f"- trained: {card.plan}")
    lines += [f"- {name} {version}" for name, version in card.versions.items()]
    if card.metrics:
        lines += ["", "## Figures", "", "On the validation pictures, by:", ""]
        lines += ["```", card.command, "```", "", *_table(card.metrics)]
    if card.evaluation:
        text = json.dumps(card.evaluation, indent=2, ensure_ascii=False)
        lines += ["", "## Evaluation", "", "```json", text, "```"]
    lines += ["", "## Limits", "", *(f"- {limit}" for limit in card.limits)]
    lines += ["", "## Credits", "", *(f"- {credit}" for credit in card.credits)]
    if card.data:
        # Headings of the data card become one level lower.
        data = [f"#{line}" if line.startswith("#") else line for line in card.data.splitlines()]
        lines += ["", *data]
    return "\n".join(lines).rstrip() + "\n"


def _table(metrics: Mapping[str, float]) -> list[str]:
    rows = [f"| {name} | {value:g} |" for name, value in metrics.items()]
    return ["| figure | value |", "|---|--:|", *rows]


_SMALLEST = 1024  # smaller tensors stay float32: converting them saves nothing


def halve_storage(network: onnx.ModelProto) -> None:
    """Store float32 weights as float16 followed by a Cast, in place.

    Both runtimes fold the Cast when they load the file. Tensors beyond the float16 range stay
    float32.

    Parameters
    ----------
    network : onnx.ModelProto
        The network to change.
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
    model: Any, out: Path, *, size_px: int = 640, input_sizes: Sequence[int] = ()
) -> Path:
    """Export a network's one-to-one head to ONNX with raw output, for any size of the input.

    Weights are stored in half precision; inputs and outputs stay float32.

    Parameters
    ----------
    model : ultralytics.YOLO
        The network, from `load_yolo`.
    out : Path
        The ONNX file to write.
    size_px : int
        Height and width of the input that the network is traced with; a multiple of the stride.
    input_sizes : sequence of int
        Default long sides of the input at inference, pixels; if empty, `size_px`.

    Returns
    -------
    Path
        `out`.

    Raises
    ------
    ModelError
        If the network has no one-to-one head.
    """
    detect = model.model.model[-1]
    if getattr(detect, "one2one_cv2", None) is None:
        raise ModelError(
            "the network has no one-to-one head", source=model.ckpt_path, remedy="use YOLO26"
        )
    with tempfile.TemporaryDirectory() as folder:
        # Ultralytics writes next to the checkpoint: redirect the output to a temporary folder.
        model.ckpt_path = model.model.pt_path = str(Path(folder) / "network.pt")
        detect.postprocess = _corners_to_centres
        try:
            with warnings.catch_warnings():
                # The tracer warns about its deprecation and about branches on shapes.
                warnings.simplefilter("ignore")
                written = model.export(
                    format="onnx",
                    imgsz=size_px,
                    dynamic=True,
                    opset=_OPSET,
                    simplify=False,
                    nms=False,
                    device="cpu",
                    verbose=False,
                )
        finally:
            detect.__dict__.pop("postprocess", None)
        out.parent.mkdir(parents=True, exist_ok=True)
        metadata = {
            ORDER_KEY: str(getattr(model.model, "keypoint_order", "")),
            SIZES_KEY: ",".join(map(str, input_sizes)),
            "end2end": "False",
            ONE_TO_ONE_KEY: "True",
        }
        _finish(Path(written), metadata)
        shutil.move(written, out)
    return out


def _corners_to_centres(rows: Any) -> Any:
    """Convert one-to-one rows (B, N, 4 + classes + extra) to the raw output layout.

    Replaces `Detect.postprocess`, which would select the top 300.
    """
    import torch

    lower, upper, scores = rows[..., :2], rows[..., 2:4], rows[..., 4:]
    return torch.cat(((lower + upper) / 2, upper - lower, scores), dim=-1).permute(0, 2, 1)


def _finish(path: Path, metadata: dict[str, str]) -> None:
    """Add the non-empty metadata, and store the weights in half precision.

    Exporting the same weights gives identical bytes, so a card's evaluation stays valid after
    another export.
    """
    import onnx

    network = onnx.load(path)
    entries = {entry.key: entry.value for entry in network.metadata_props}
    # The description contains paths of the training machine.
    entries["description"] = entries.get("description", "").split(" trained on ")[0]
    entries.pop("date", None)
    entries |= {key: value for key, value in metadata.items() if value}
    onnx.helper.set_model_props(network, entries)
    # Ultralytics' half precision also computes in float16, where coordinates from 512 px on are
    # rounded to half pixels.
    halve_storage(network)
    onnx.save(network, path)


_NAME = re.compile(r"[a-z0-9][a-z0-9.-]*")


def export_trained(
    source: Path,
    out: Path,
    name: str,
    *,
    evaluation: Path | None = None,
    credits: Sequence[str] = (),
    input_sizes: Sequence[int] = (),
) -> ModelCard:
    """Export the latest weights of a run, or a checkpoint, and write the model card.

    The ONNX file accepts any input size that is a multiple of 32, uses the one-to-one head, and
    stores weights in half precision but computes in float32.

    Parameters
    ----------
    source : Path
        Folder of a training run, or a YOLO26 checkpoint (.pt) with one class.
    out : Path
        Folder for `NAME.onnx`, `NAME.md` and `NAME.json`.
    name : str
        Name of the model in commands: lower-case letters, digits, '-' and '.'.
    evaluation : Path, optional
        JSON file with evaluation results to include in the card.
    credits : sequence of str
        Further credits for the card, such as the publishers of training pictures.
    input_sizes : sequence of int
        As for `export_yolo`; if empty, a detector gets `DETECTOR_SIZES_PX`.

    Raises
    ------
    TrainingError
        If the run has no completed epoch, `name` or `evaluation` is invalid, or the network has
        another task or more than one class.
    CaptureError
        If the evaluation file is not valid JSON.
    ModelError, MissingExtraError
        See `load_yolo`.
    """
    if not _NAME.fullmatch(name):
        raise TrainingError(
            f"invalid model name {name!r}", remedy="use lower-case letters, digits, '-' and '.'"
        )
    results = read_json(evaluation) if evaluation else {}
    if not isinstance(results, dict):
        raise TrainingError("is not a JSON object", source=evaluation, remedy="give another file")
    checkpoint = source / NETWORK if source.is_dir() else source
    if not checkpoint.is_file():
        raise TrainingError(
            "no epoch has completed yet", source=source, remedy="run the training again"
        )
    model = load_yolo(checkpoint)
    if model.task not in TASKS.values() or len(model.names) != 1:
        raise TrainingError(
            f"is a {model.task} network with {len(model.names)} classes",
            source=checkpoint,
            remedy="give a segment or pose network with one class",
        )
    if model.task == "segment":
        input_sizes = input_sizes or DETECTOR_SIZES_PX
    path = export_yolo(model, out / f"{name}.onnx", input_sizes=input_sizes)
    return described(
        path,
        checkpoint,
        name=name,
        task=str(model.task),
        evaluation=results,
        credits=credits,
        versions={"torch": version("torch"), "ultralytics": import_ultralytics().__version__},
        **(_card_entries(source) if (source / BEGUN).is_file() else {}),
    )


def _card_entries(run: Path) -> dict[str, Any]:
    """Return a run's entries for the model card, without local paths."""
    begun = read_json(run / BEGUN, TrainingError)
    with (run / "results.csv").open(newline="", encoding="utf-8") as file:
        *_, last = csv.DictReader(file, skipinitialspace=True)
    options = " ".join(
        f"--{option} {begun[key]}"
        for option, key in (("init", "init"), ("epochs", "epochs"), ("size", "size_px"))
    )
    return {
        "began_with": begun["init"],
        "plan": f"{last['epoch']} of {begun['epochs']} epochs at {begun['size_px']} px, "
        f"{float(last['time']) / 3600:.1f} h",
        "command": f"cucumbervision train network {begun['task']} SET --out RUN {options} "
        f"--seed {begun['seed']}",
        "metrics": {
            key.removeprefix("metrics/"): float(value)
            for key, value in last.items()
            if key.startswith("metrics/")
        },
        "data": (run / DATA_CARD).read_text(encoding="utf-8"),
    }
