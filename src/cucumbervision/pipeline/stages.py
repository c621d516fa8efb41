"""Hashes of everything that a capture's rows depend on besides its own files, by stage.

The table of fields is part of each, so that captures are measured again after a new column.

A change of options or networks affects only captures that depend on them: a data set's own masks
are not measured again after a change of the detector.
"""

from __future__ import annotations

import hashlib
import json
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cucumbervision._version import __version__
from cucumbervision.errors import CucumberVisionError, ModelError
from cucumbervision.perception.registry import file_sha256, load_registry
from cucumbervision.pipeline.plugged import PlugIns, RunPlugins
from cucumbervision.plugins import plugins

if TYPE_CHECKING:
    from collections.abc import Iterable

    from cucumbervision.calibration.calibration_file import SiteCalibration
    from cucumbervision.perception.registry import Registry
    from cucumbervision.pipeline.options import MeasureOptions


class Stage(StrEnum):
    """Processing stages of the fruit of a capture before they are measured."""

    DATASET = "dataset"
    """Taken from the data set's own masks."""
    LISTED = "listed"
    """Taken from a user's file of boxes or masks."""
    DETECTED = "detected"
    """Found by networks."""
    POSED = "posed"
    """Given keypoints by the user's own pose network."""
    KEPT = "kept"
    """Masks were there, or none were wanted."""
    DRAWN = "drawn"
    """Masks by SAM."""


class StageHashes:
    """The hashes of one run's options and networks, by stage; each file is hashed once.

    Parameters
    ----------
    options : MeasureOptions
        Options of the run.
    registry : Registry, optional
        Registry of named networks; by default that of the package.
    plugged : RunPlugins, optional
        Methods and traits of the run; by default those of the options.
    site : SiteCalibration, optional
        The calibration that the run has read; by default its file is hashed, which another program
        may have replaced since.

    Examples
    --------
    >>> from cucumbervision.pipeline.options import MeasureOptions
    >>> by_mask = (Stage.DATASET, Stage.KEPT)
    >>> hashes, unsure = (StageHashes(MeasureOptions(confidence=c)) for c in (0.3, 0.1))
    >>> hashes.of(by_mask) == unsure.of(by_mask)
    True
    >>> hashes.of([Stage.DETECTED]) == unsure.of([Stage.DETECTED])
    False
    """

    def __init__(
        self,
        options: MeasureOptions,
        registry: Registry | None = None,
        plugged: RunPlugins | None = None,
        site: SiteCalibration | None = None,
    ) -> None:
        self._site = site
        self._options, self._registry = options, registry or load_registry()
        self._plugged = plugged or RunPlugins(options, PlugIns())
        self._digests: dict[str, Any] = {}

    @cached_property
    def sources(self) -> frozenset[Stage]:
        """The stages that are possible with these options."""
        choice = self._options.instances
        if choice == "auto":
            return frozenset({Stage.DATASET, Stage.DETECTED})
        named = choice == "models" or choice in plugins("detectors")
        if named or Path(choice).suffix.lower() == ".onnx":
            return frozenset({Stage.DETECTED})
        return frozenset({Stage.DATASET if choice == "dataset" else Stage.LISTED})

    def of(self, stages: Iterable[Stage | str]) -> str:
        """Return the hash of everything that rows of these stages depend on.

        Raises
        ------
        CucumberVisionError
            If a file in the options cannot be read.
        """
        names = [Stage(stage) for stage in stages]
        key = " ".join(names)
        if key not in self._digests:
            descriptions = [self._always, *(self._of_stage(name) for name in names)]
            text = json.dumps([key, descriptions], sort_keys=True)
            self._digests[key] = hashlib.sha256(text.encode()).hexdigest()
        digest: str = self._digests[key]
        return digest

    def still_hold(self, stages: Iterable[Stage | str], digest: str) -> bool:
        """Return whether a result of these stages would be the same with the present options."""
        names = [Stage(stage) for stage in stages]
        if not all(plugin.version for plugin in self._plugged.lines):
            return False  # a part of the calling program may have changed
        return bool(names) and names[0] in self.sources and self.of(names) == digest

    @cached_property
    def _always(self) -> Any:
        options = self._options
        read, path = self._site, options.calibration
        site = read.sha256 if read is not None else path and _path_sha256(path)
        how = [list(options.methods), str(options.selector), str(options.length)]
        sizes = options.accepted_m, options.accepted_diameter_m
        crop = *sizes, options.cut_beyond_m, options.camera_up, list(options.classes)
        table = [
            [
                fruit_field.name,
                fruit_field.unit,
                fruit_field.type,
                fruit_field.path,
                fruit_field.digits,
            ]
            for fruit_field in self._plugged.fields
        ]
        table += [list(plugin.as_json().values()) for plugin in self._plugged.lines]
        reading = options.reading
        depth = [reading.depth_unit_m, reading.depth_along, reading.aligned_to]
        return [__version__, how, site, *depth, *crop, table]

    def _of_stage(self, stage: Stage) -> Any:
        options = self._options
        computing = [options.runtime, options.full_precision, self._look()]
        if stage is Stage.DETECTED:
            seeing = [options.confidence, list(options.input_sizes)]
            return [self._detectors(), seeing, computing]
        if stage is Stage.POSED:
            posed = [options.pose and _path_sha256(options.pose), self._named("fruit")]
            return [posed, options.confidence, list(options.input_sizes), computing]
        if stage is Stage.DRAWN:
            chosen = options.segmenter
            drawing = self._hashes(chosen) if chosen else self._named("prompted-mask")
            if chosen in plugins("segmenters"):
                drawing = plugins("segmenters")[str(chosen)].as_json()
            return [drawing, options.prompt, computing]
        if stage is Stage.KEPT:
            return options.segmenter
        return _path_sha256(Path(options.instances)) if stage is Stage.LISTED else None

    def _detectors(self) -> Any:
        options = self._options
        if options.instances in plugins("detectors"):
            return plugins("detectors")[options.instances].as_json()
        has_own_file = options.instances not in ("auto", "models")
        detector = _path_sha256(Path(options.instances)) if has_own_file else self._named("segment")
        posing = None if has_own_file else self._named("pose")
        posing = _path_sha256(options.pose) if options.pose else posing
        return [detector, posing, self._named("fruit"), options.quick]

    def _look(self) -> Any:
        return self._named("look") if self._options.end_look else None

    def _named(self, task: str) -> Any:
        model = self._registry.default(task)
        return model and self._hashes(model.name)

    def _hashes(self, name: str) -> Any:
        try:
            return self._registry.hashes(name)
        except ModelError as error:  # not installed: measuring raises the error
            return str(error)


def _path_sha256(path: Path) -> str:
    """Hash a file, or all files of a folder with their names."""
    if not path.exists():
        raise CucumberVisionError("no such file", source=path, remedy="check the run's options")
    if path.is_file():
        return file_sha256(path)
    files = sorted(file for file in path.rglob("*") if file.is_file())
    named = [[file.relative_to(path).as_posix(), file_sha256(file)] for file in files]
    return hashlib.sha256(json.dumps(named).encode()).hexdigest()
