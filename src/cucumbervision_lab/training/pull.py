"""Fetch a model from its publisher, or take a file fetched by hand, and make it ready to run.

Needs the extra `train`, since publishers offer torch checkpoints. A file whose SHA-256 is not the
registry's is never opened.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from cucumbervision.errors import MissingExtraError, ModelError, ModelHashError
from cucumbervision.perception.registry import (
    Model,
    ModelSource,
    Registry,
    file_sha256,
    load_registry,
)
from cucumbervision_lab.training.export_sam import checkpoint_from_archive, export_sam

_ARCHIVES = (".whl", ".zip", ".tar.gz", ".tgz")


def pull_model(
    name: str,
    *,
    given: Path | None = None,
    registry: Registry | None = None,
    progress: Any = None,
) -> dict[str, Path]:
    """Bring a model of the registry onto this machine.

    Parameters
    ----------
    name : str
        Its name. Nothing is fetched if it is on this machine already and whole.
    given : Path, optional
        The publisher's file, already on this machine; nothing is fetched then.
    registry : Registry, optional
        Another registry than the package's.
    progress : object, optional
        Shows the download: an attribute `total` and the methods `update`, `reset` and `close`.

    Returns
    -------
    dict of str to Path
        The verified files by role.

    Raises
    ------
    UnknownModelError
        If no model has the name.
    MissingExtraError
        If the extra `train` is not installed; raised before anything is downloaded.
    ModelHashError
        If the file is not the one that the registry names.
    ModelError
        If it cannot be fetched, is no checkpoint of weights only, or a file is given for an
        embedded model.
    """
    registry = registry or load_registry()
    model = registry.get(name)
    if model.embedded and given:
        raise ModelError(
            f"the model {name} lies in the package and takes no file", remedy="leave out --from"
        )
    if model.embedded or (given is None and _is_whole(registry, name)):
        return registry.resolve(name)
    _require_onnx()
    registry.user.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=registry.user, prefix=".pull-") as folder:
        work = Path(folder)
        checkpoint = given or _fetch(model, _source(model), work, progress)
        return registry.install(name, export_source(model, checkpoint, work / "out"))


def export_source(model: Model, given: Path, out: Path) -> tuple[Path, ...]:
    """Export a publisher's file into the files that the registry names.

    Parameters
    ----------
    model : Model
        The registry's entry.
    given : Path
        The publisher's checkpoint, or the archive (.whl, .zip, .tar.gz) that holds it.
    out : Path
        Folder for the files.

    Returns
    -------
    tuple of Path
        Encoder and decoder.

    Raises
    ------
    ModelHashError
        If the checkpoint is not the one that the registry names.
    ModelError, MissingExtraError
        As `export_sam`.
    """
    source = _source(model)
    if not given.is_file():
        raise ModelError("there is no such file", source=given, remedy="check the path")
    notes = {"name": model.name, "licence": model.licence, "origin": model.origin}
    with tempfile.TemporaryDirectory() as folder:
        checkpoint = given
        if source.member and given.name.endswith(_ARCHIVES):
            checkpoint = Path(folder) / source.file
            checkpoint.write_bytes(checkpoint_from_archive(given, source.member))
        if file_sha256(checkpoint) != source.sha256:
            raise ModelHashError(
                f"its SHA-256 is not that of {source.file}",
                source=given,
                remedy=f"download it again from {source.url}",
            )
        return export_sam(checkpoint, model.architecture, out, stem=model.name, metadata=notes)


def _is_whole(registry: Registry, name: str) -> bool:
    try:
        registry.resolve(name)
    except ModelError:
        return False
    return True


def _fetch(model: Model, source: ModelSource, folder: Path, progress: Any) -> Path:
    """Download the publisher's file, checking its hash."""
    import pooch

    pooch.get_logger().setLevel("ERROR")
    by_hand = (
        f"download it by hand and run: cucumbervision models pull {model.name} --from {source.file}"
    )
    try:
        path = pooch.retrieve(
            source.url,
            f"sha256:{source.sha256}",
            fname=source.file,
            path=folder,
            downloader=pooch.HTTPDownloader(progressbar=progress or False, timeout=30),
        )
    except ValueError as error:
        raise ModelHashError(
            "what is offered there has another SHA-256 than the registry's",
            source=source.url,
            remedy="update cucumbervision",
        ) from error
    except OSError as error:
        raise ModelError(
            f"it cannot be downloaded ({type(error).__name__})", source=source.url, remedy=by_hand
        ) from error
    return Path(path)


def _source(model: Model) -> ModelSource:
    if model.source is None:
        raise ModelError(
            f"the model {model.name} has no source to be exported from",
            remedy="install cucumbervision again",
        )
    return model.source


def _require_onnx() -> None:
    """Find out that the exporter cannot run before a long download."""
    from cucumbervision_lab.training.extras import import_ultralytics

    import_ultralytics()
    try:
        import onnx  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("onnx", "train") from error
