"""What a run's results come from: for its files, and the hash of all that decides a length."""

from __future__ import annotations

import hashlib
import json
import platform
import uuid
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cucumbervision
from cucumbervision.about import installed_versions, software
from cucumbervision.errors import CucumberVisionError
from cucumbervision.networks.registry import file_sha256
from cucumbervision.plugins import plugins
from cucumbervision.run.options import INSTANCE_SOURCES
from cucumbervision.tube.compiled import kernel_name

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from datetime import datetime

    from cucumbervision.accuracy.calibration_file import SiteCalibration
    from cucumbervision.networks.registry import Registry
    from cucumbervision.plugins import Plugin
    from cucumbervision.run.options import MeasureOptions

_CODE = frozenset({".py", ".c", ".csv", ".json", ".toml"})
_NO_LENGTH = frozenset({"cli", "service", "stream"})  # rooms that decide none


def deciding_sha256(
    options: MeasureOptions,
    registry: Registry,
    added: Sequence[Plugin] = (),
    site: SiteCalibration | None = None,
) -> str:
    """Return the hash of all that decides lengths besides the captures' own files.

    These are the content of the code and its tables, of the networks in use, and of the files that
    the options name; the options; the versions of libraries; and the plug-ins.

    Parameters
    ----------
    options : MeasureOptions
        Options of the run.
    registry : Registry
        The networks in use.
    added : sequence of Plugin
        Plug-ins of other packages. One without a version may have changed: no hash is the same.
    site : SiteCalibration, optional
        The calibration that the run has read.

    Raises
    ------
    CucumberVisionError
        If a file in the options cannot be read.

    Examples
    --------
    >>> from cucumbervision.networks.registry import load_registry
    >>> from cucumbervision.run.options import MeasureOptions
    >>> one, other = (
    ...     deciding_sha256(MeasureOptions(confidence=c), load_registry()) for c in (0.3, 0.1)
    ... )
    >>> one == other
    False
    """
    values = options.as_json()
    for name in ("intrinsics", "depth"):  # files of the capture
        del values["reading"][name]
    files = [options.pose] if options.pose else []
    detectors, segmenters = plugins("detectors"), plugins("segmenters")
    if options.instances in detectors:
        added = (*added, detectors[options.instances])
    elif options.instances not in INSTANCE_SOURCES:
        files.append(Path(options.instances))
    tasks = ("segment", "pose", "fruit", "look")
    networks = [model.name for model in map(registry.default, tasks) if model is not None]
    if options.segmenter in segmenters:
        added = (*added, segmenters[options.segmenter])
    elif options.segmenter != "none" and registry.default("prompted-mask") is not None:
        networks.append(registry.segmenter(options.segmenter).name)
    if not all(plugin.version for plugin in added):
        values["run"] = uuid.uuid4().hex
    values |= {
        "calibration": site and site.sha256,
        "files": [_path_sha256(path) for path in files],
        "networks": [registry.hashes(name) for name in networks],
        "plugins": [plugin.as_json() for plugin in added],
        "code": code_sha256(),
        "versions": installed_versions(),
    }
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


@cache
def code_sha256() -> str:
    """Return the hash of the code and the tables of this package that decide a length."""
    root = Path(cucumbervision.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*")):
        name = path.relative_to(root)
        if path.suffix in _CODE and name.parts[0] not in _NO_LENGTH:
            digest.update(f"{name.as_posix()} {file_sha256(path)}\n".encode())
    return digest.hexdigest()


def _path_sha256(path: Path) -> str:
    """Hash a file, or all files of a folder with their names."""
    if not path.exists():
        raise CucumberVisionError("no such file", source=path, remedy="check the run's options")
    if path.is_file():
        return file_sha256(path)
    files = sorted(file for file in path.rglob("*") if file.is_file())
    named = [[file.relative_to(path).as_posix(), file_sha256(file)] for file in files]
    return hashlib.sha256(json.dumps(named).encode()).hexdigest()


def provenance_of(
    options: MeasureOptions,
    models: Sequence[Mapping[str, Any]],
    site: SiteCalibration | None,
    started: datetime,
) -> dict[str, Any]:
    """Return the provenance of a run: software, options, networks, calibration, versions."""
    return {
        **software(),
        "started": started.isoformat(timespec="seconds"),
        "config": options.as_json(),
        "config_sha256": options.sha256,
        "models": [model for model in models if "package" not in model],
        "plugins": [model for model in models if "package" in model],
        "calibration": site and {"tag": site.tag, **site.model_dump(mode="json")},
        "kernel": kernel_name(),
        "versions": {"python": platform.python_version(), **installed_versions()},
    }
