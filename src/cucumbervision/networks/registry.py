"""The registry of networks: description, origin, licence, verified files, and a user's own.

`models.toml` beside this file lists those of the package. `in-use.json` in the user's folder lists
the user's networks, the newest last; each is in a folder of its own beside it.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from cucumbervision.errors import ModelError, ModelHashError, UnknownModelError, wrap_reader_errors
from cucumbervision.files import parse_model, read_json, write_bytes


@dataclass(frozen=True)
class ModelFile:
    """One file that a runtime loads.

    Parameters
    ----------
    role : str
        'encoder', 'decoder' or 'network'.
    file : str
        Its name.
    sha256 : str
        Its hash, hexadecimal.
    size_bytes : int
        Its size.
    """

    role: str
    file: str
    sha256: str = ""
    size_bytes: int = 0


@dataclass(frozen=True)
class Model:
    """One entry of the registry.

    Parameters
    ----------
    name : str
        Its name in commands.
    task : str
        'prompted-mask', 'segment' or 'pose'.
    licence : str
        SPDX identifier of the weights' licence.
    title : str
        A one-line description.
    origin : str
        Publisher.
    files : tuple of ModelFile
        Files that the runtimes load; empty for a segmenter without weights.
    embedded : bool
        True if it is part of the package.
    card : str
        File name of its model card; for networks trained by this project.
    segmenter : str
        For 'prompted-mask': the class that draws masks with the files, as 'module:name'.
    """

    name: str
    task: str
    licence: str
    title: str
    origin: str
    files: tuple[ModelFile, ...] = ()
    embedded: bool = False
    card: str = ""
    segmenter: str = ""

    @property
    def size_bytes(self) -> int:
        """Size of all files."""
        return sum(file.size_bytes for file in self.files)


_HERE = Path(__file__).parent

IN_USE = "in-use.json"
"""In the user's folder: the user's own networks."""


@dataclass(frozen=True)
class Registry:
    """The models, and the two folders with their files.

    Parameters
    ----------
    shipped : tuple of Model
        The package's own, in the order of the file.
    embedded : Path
        Folder of the embedded files.
    user : Path
        Folder of the user's networks, with a subfolder per model; it need not exist.
    user_models : tuple of Model
        The user's own networks, the newest last.
    """

    shipped: tuple[Model, ...]
    embedded: Path
    user: Path
    user_models: tuple[Model, ...] = ()

    @property
    def models(self) -> tuple[Model, ...]:
        """All models, those of the package first."""
        return self.shipped + self.user_models

    def get(self, name: str) -> Model:
        """Return a model by its name.

        Raises
        ------
        UnknownModelError
            If there is none.
        """
        for model in self.models:
            if model.name == name:
                return model
        names = ", ".join(model.name for model in self.models)
        raise UnknownModelError(f"no model is called {name!r}", remedy=f"choose one of {names}")

    def default(self, task: str) -> Model | None:
        """Return the network in use for a task: the user's newest, else the first embedded one.

        Parameters
        ----------
        task : str
            'segment', 'pose' or 'prompted-mask'.

        Examples
        --------
        >>> load_registry().default("prompted-mask").name
        'mobile-sam'
        """
        embedded = (model for model in self.shipped if model.embedded)
        return next(
            (model for model in (*self.user_models[::-1], *embedded) if model.task == task), None
        )

    @property
    def looks_closely(self) -> bool:
        """Whether a network looks at each fruit alone, instead of a pose network at the image.

        A pose network of the user's own is not replaced.
        """
        pose = self.default("pose")
        return self.default("fruit") is not None and (pose is None or pose.embedded)

    def segmenter(self, name: str | None = None) -> Model:
        """Return a network that draws masks: the named one, or the default without a name.

        Raises
        ------
        UnknownModelError
            If there is no such network, or it does not draw masks.
        """
        model = self.default("prompted-mask") if name is None else self.get(name)
        if model is None or not model.segmenter:
            names = ", ".join(model.name for model in self.models if model.segmenter)
            fault = "no segmenter is installed" if name is None else f"{name} draws no masks"
            raise UnknownModelError(fault, remedy=f"choose one of {names}")
        return model

    def hashes(self, name: str) -> dict[str, str]:
        """Return the expected SHA-256 of each file, by role."""
        return {file.role: file.sha256 for file in self.get(name).files}

    def resolve(self, name: str) -> dict[str, Path]:
        """Return the paths of a model's files by role, each verified.

        Raises
        ------
        UnknownModelError
            If no model has the name.
        ModelError
            If a file is missing.
        ModelHashError
            If a file's hash differs.
        """
        model = self.get(name)
        folder = self.embedded if model.embedded else self.user / name
        remedy = "run: cucumbervision models use --shipped"
        if model.embedded:
            remedy = "install cucumbervision again"
        for file in model.files:
            path = folder / file.file
            if not path.is_file():
                raise ModelError("the file is missing", source=path, remedy=remedy)
            if file_sha256(path) != file.sha256:
                fault = "its SHA-256 is not the registry's"
                raise ModelHashError(fault, source=path, remedy=remedy)
        return {file.role: folder / file.file for file in model.files}

    def export(self, name: str, out: Path) -> tuple[Path, ...]:
        """Copy a model's verified files into a folder, made if need be.

        Raises
        ------
        UnknownModelError, ModelError, ModelHashError
            As `resolve`.
        """
        files = self.resolve(name).values()
        out.mkdir(parents=True, exist_ok=True)
        return tuple(Path(shutil.copyfile(path, out / path.name)) for path in files)


def load_registry(path: Path | None = None, user: Path | None = None) -> Registry:
    """Read the registry.

    Parameters
    ----------
    path : Path, optional
        Another registry file; its embedded files lie in a folder `weights` beside it.
    user : Path, optional
        Another folder for the user's networks than `models_folder`.

    Raises
    ------
    ModelError
        If the file cannot be read.

    Examples
    --------
    >>> load_registry().get("mobile-sam").licence
    'Apache-2.0'
    """
    path = path or _HERE / "models.toml"
    with wrap_reader_errors(path, ModelError, "install again"):
        entries = tomllib.loads(path.read_text(encoding="utf-8"))["models"]
        models = tuple(_model(entry, path, "install again") for entry in entries)
    user = user or models_folder()
    return Registry(models, path.parent / "weights", user, _read_own(user / IN_USE))


def models_folder() -> Path:
    """Return the folder of the user's networks: `CUCUMBERVISION_MODELS`, or in the data folder."""
    if chosen := os.environ.get("CUCUMBERVISION_MODELS"):
        return Path(chosen)
    import platformdirs

    return Path(platformdirs.user_data_dir("cucumbervision", appauthor=False)) / "models"


def file_sha256(path: Path) -> str:
    """Return a file's SHA-256 in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _model(entry: Any, path: Path, remedy: str) -> Model:
    return parse_model(Model, entry, source=path, error=ModelError, remedy=remedy)


_USE_AGAIN = "delete the file to use the package's own, and give yours again"


def _read_own(path: Path) -> tuple[Model, ...]:
    if not path.is_file():
        return ()
    with wrap_reader_errors(path, ModelError, _USE_AGAIN):
        values = read_json(path, ModelError, _USE_AGAIN)
        return tuple(_model(entry, path, _USE_AGAIN) for entry in values["models"])


JUDGEMENT = "judgement.json"
"""Written by `train house`: old and new network evaluated on the same images."""

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
    path = run_or_network
    if path.is_dir():
        # The file name only: a comparison is about files in its own folder.
        path /= Path(str(judgement.get("file", ""))).name[:_LONGEST_NAME]
    if not path.is_file() or path.suffix != ".onnx":
        raise ModelError(
            "there is no exported and judged network",
            source=run_or_network,
            remedy="give the folder of a finished `train house` run, or an .onnx file",
        )
    from cucumbervision.networks.yolo import YoloDetector

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
    (registry.user / name).mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, registry.user / name / path.name)
    _write(changed)
    return model


def use_shipped(registry: Registry | None = None) -> None:
    """Use the package's own networks again, for every task."""
    _write(replace(registry or load_registry(), user_models=()))


def _write(registry: Registry) -> None:
    text = json.dumps({"models": [asdict(model) for model in registry.user_models]}, indent=2)
    registry.user.mkdir(parents=True, exist_ok=True)
    write_bytes(registry.user / IN_USE, f"{text}\n".encode())


def _read_judgement(run_or_network: Path) -> Mapping[str, Any]:
    """Return the comparison in a run's folder; empty for a single file."""
    path = (run_or_network if run_or_network.is_dir() else run_or_network.parent) / JUDGEMENT
    if not path.is_file():
        return {}
    with wrap_reader_errors(path, ModelError, "judge it again"):
        values = read_json(path, ModelError, "judge it again")
        return {name: values[name] for name in ("file", "new", "old", "better", "why")}


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
