"""From a training run to what is shipped: one ONNX file for every size of picture, and its card."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from cucumbervision.errors import TrainingError
from cucumbervision.perception.registry import file_sha256
from cucumbervision_lab.training.cards import MAKERS, ModelCard, write_card
from cucumbervision_lab.training.export_yolo import export_model, import_ultralytics
from cucumbervision_lab.training.learn_from import DATA_CARD, TASKS
from cucumbervision_lab.training.plan import RunState
from cucumbervision_lab.training.train import NETWORK

__all__ = ["export_trained", "last_metrics"]

_NAME = re.compile(r"[a-z0-9][a-z0-9.-]*")
_SIZE_PX = 640


def export_trained(
    source: Path,
    out: Path,
    name: str,
    *,
    evaluation: Path | None = None,
    credits: Sequence[str] = (),
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

    Returns
    -------
    ModelCard
        As written.

    Raises
    ------
    TrainingError
        If no epoch of the run is through, the name or the evaluation's file cannot be used, or
        the network is not one of ours.
    ModelError
        If the checkpoint cannot be loaded.
    MissingExtraError
        If the extra `train` is not installed.
    """
    if not _NAME.fullmatch(name):
        raise TrainingError(
            f"{name!r} cannot name a network", remedy="use small letters, digits, '-' and '.'"
        )
    judged = _read_json(evaluation) if evaluation else {}
    checkpoint = source / NETWORK if source.is_dir() else source
    if not checkpoint.is_file():
        raise TrainingError(
            "there are no weights yet", source=source, remedy="train on with --resume"
        )
    model = _load(checkpoint)
    path = export_model(model, out / f"{name}.onnx", size_px=_SIZE_PX, dynamic=True, half=True)
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


def _load(checkpoint: Path) -> Any:
    ultralytics = import_ultralytics()
    try:
        model = ultralytics.YOLO(str(checkpoint))
    # Unpickling a broken checkpoint can raise anything.
    except Exception as error:
        raise TrainingError(
            f"Ultralytics cannot load it ({error})",
            source=checkpoint,
            remedy="give a run's folder or a YOLO26 checkpoint (.pt)",
        ) from error
    if model.task not in TASKS.values() or len(model.names) != 1:
        raise TrainingError(
            f"is a network for {model.task} with {len(model.names)} classes",
            source=checkpoint,
            remedy="give one of one class for segment or pose",
        )
    return model


def _known_of_run(run: Path) -> dict[str, Any]:
    """Collect what a run's folder tells for the card, without any path of this machine."""
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
    """Give Ultralytics' metrics of a run's last validation.

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


def _read_json(path: Path) -> dict[str, Any]:
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise TrainingError(
            f"the evaluation cannot be read ({error})", source=path, remedy="give a JSON file"
        ) from error
    if not isinstance(values, dict):
        raise TrainingError("holds no JSON object", source=path, remedy="give another file")
    return values
