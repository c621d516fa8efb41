"""Put a user's own network in use, if it is better than the one in use."""

from __future__ import annotations

import json
import shutil
import tempfile
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cucumbervision.errors import ModelError, wrap_reader_errors
from cucumbervision.files import read_json
from cucumbervision.perception.registry import (
    IN_USE,
    Model,
    ModelFile,
    Registry,
    file_sha256,
    load_registry,
)
from cucumbervision.perception.yolo import YoloDetector

if TYPE_CHECKING:
    from collections.abc import Mapping

JUDGEMENT = "judgement.json"
"""Written by `train house`: old and new network evaluated on the same pictures."""

_LONGEST_NAME = 200


def use_network(
    run_or_network: Path, *, anyway: bool = False, registry: Registry | None = None
) -> Model:
    """Make a user's network the default for its task.

    Parameters
    ----------
    run_or_network : Path
        The folder of a `train house` run, or a YOLO ONNX export.
    anyway : bool
        Skip the check that it is better.
    registry : Registry, optional
        The registry to change; `load_registry()` by default.

    Returns
    -------
    Model
        Its entry in the registry.

    Raises
    ------
    ModelError
        If it is not a YOLO network for segments or poses; unless `anyway`, if it was not compared
        with the network in use, or is not better.
    """
    registry = registry or load_registry()
    judgement = _read_judgement(run_or_network)
    path = _network_file(run_or_network, judgement)
    task = YoloDetector(path, "onnxruntime").task
    sha256 = file_sha256(path)
    if not anyway:
        _require_better(path, sha256, judgement, registry.default(task))
    name = f"{path.stem}-{sha256[:8]}"
    model = Model(
        name=name,
        task=task,
        licence="AGPL-3.0-only",
        title=f"{path.name}, put in use on this machine",
        origin="trained by its user",
        files=(ModelFile("network", path.name, sha256, path.stat().st_size),),
    )
    earlier = tuple(model for model in registry.user_models if model.name != name)
    changed = replace(registry, user_models=(*earlier, model))
    with tempfile.TemporaryDirectory() as folder:
        changed.install(name, (Path(shutil.copyfile(path, Path(folder) / path.name)),))
    _write(changed)
    return model


def use_shipped(registry: Registry | None = None) -> None:
    """Use the package's own networks again, for every task."""
    _write(replace(registry or load_registry(), user_models=()))


def _write(registry: Registry) -> None:
    text = json.dumps({"models": [asdict(model) for model in registry.user_models]}, indent=2)
    registry.user.mkdir(parents=True, exist_ok=True)
    part = registry.user / f"{IN_USE}.part"
    part.write_text(text + "\n", encoding="utf-8")
    part.replace(registry.user / IN_USE)


def _read_judgement(run_or_network: Path) -> Mapping[str, Any]:
    """Return the comparison in a run's folder; empty for a single file."""
    path = (run_or_network if run_or_network.is_dir() else run_or_network.parent) / JUDGEMENT
    if not path.is_file():
        return {}
    with wrap_reader_errors(path, ModelError, "judge it again"):
        values = read_json(path, ModelError, "judge it again")
        return {name: values[name] for name in ("file", "new", "old", "better", "why")}


def _network_file(run_or_network: Path, judgement: Mapping[str, Any]) -> Path:
    path = run_or_network
    if run_or_network.is_dir():
        # The file name only: a comparison is about files in its own folder.
        path = run_or_network / Path(str(judgement.get("file", ""))).name[:_LONGEST_NAME]
    if not path.is_file() or path.suffix != ".onnx":
        raise ModelError(
            "there is no exported and judged network",
            source=run_or_network,
            remedy="give the folder of a finished `train house` run, or an .onnx file",
        )
    return path


def _require_better(
    path: Path, sha256: str, judgement: Mapping[str, Any], used: Model | None
) -> None:
    """Raise if a network is not known to be better than the one in use."""
    if judgement.get("new") != sha256:
        fault, remedy = "it was not compared with the network in use", "run `train house`"
    elif used is not None and judgement["old"] != used.files[0].sha256:
        fault = "it was judged against another network than the one in use"
        remedy = "run the same `train house` again"
    elif not judgement["better"]:
        fault, remedy = f"it is not better: {judgement['why']}", "judge more stops and train again"
    else:
        return
    raise ModelError(fault, source=path, remedy=f"{remedy}, or add --anyway")
