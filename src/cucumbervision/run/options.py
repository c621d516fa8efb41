"""Options of a run, which are part of the provenance, crop packs, and plug-ins."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self, get_args

from cucumbervision import errors
from cucumbervision.capture.source import ReadOptions
from cucumbervision.crop.profiles import PACK_PROFILE, CropProfile, load_profile
from cucumbervision.files import json_value, read_json
from cucumbervision.methods.pose import CUT_BEYOND_M
from cucumbervision.methods.result import LengthDefinition, Selector
from cucumbervision.methods.table import Method, TableMethod, Trait, plugin_of
from cucumbervision.networks import DEFAULT_CONFIDENCE
from cucumbervision.networks.registry import file_sha256
from cucumbervision.networks.runtime import RUNTIMES
from cucumbervision.networks.sam import PROMPTS
from cucumbervision.plugins import Detector, Kind, Plugin, Segmenter, faults, plugins
from cucumbervision.run.fields import Field, fields_with, trait_field

GRAVITY_BY_EDGE = {
    "top": (0.0, 1.0, 0.0),
    "left": (1.0, 0.0, 0.0),
    "right": (-1.0, 0.0, 0.0),
    "bottom": (0.0, -1.0, 0.0),
}
"""Direction of gravity in camera coordinates, by the image's edge that is up."""

_CHOICES: dict[str, tuple[str, ...]] = {
    "length": tuple(LengthDefinition),
    "selector": tuple(Selector),
    "prompt": PROMPTS,
    "runtime": RUNTIMES,
    "camera_up": tuple(GRAVITY_BY_EDGE),
}

INSTANCE_SOURCES = ("auto", "models", "dataset")
"""What `MeasureOptions.instances` may be beside a file."""


@dataclass(frozen=True)
class MeasureOptions:
    """Options of a run.

    Parameters
    ----------
    instances : str
        'auto' (the data set's own masks where a capture has them, the models otherwise),
        'models', 'dataset', or the path of a file: COCO JSON, YOLO txt (or a folder of them),
        or a YOLO ONNX export.
    classes : sequence of str
        The classes to measure, as the file or network names them, in any case; also as one text,
        'cucumber,gherkin'. All if empty.
    pose : Path, optional
        A YOLO pose ONNX export that gives the five keypoints, wherever the fruit come from; the
        package's own networks give them to fruit of the package's own detector only.
    quick : bool
        Whether the package's network that looks at each fruit looks once, and only at what the
        detector is sure of.
    end_look : bool
        Whether a network evaluates both ends of each fruit whose mask a network drew; intervals
        then depend on its result.
    segmenter : str, optional
        A segmenter's name, which draws all masks, or 'none'.
        With None, the default segmenter draws masks for instances without a mask, and for those
        whose detector mask does not fit a tube well (`measurement.m6.fits_well`).
    prompt : str
        SAM's prompt: 'box+point', 'box' or 'point'.
    methods : sequence of str
        Names of the methods to run, in any case; also 'all', or 'm1,m5'.
    selector : Selector
        How the result is chosen.
    length : LengthDefinition
        Definition of `length_cm` if a tube was fitted.
    confidence : float
        Minimum confidence of detections.
    input_sizes : tuple of int
        Long sides, pixels, that detector and pose network see; what they find at several is
        merged. Empty for each network's own.
    runtime : str
        Runtime of the networks.
    full_precision : bool
        Networks in float32: the same lengths on every machine. Half precision is faster where
        the processor has it, and moves outlines by a pixel or so.
    reading : ReadOptions
        Reading options.
    calibration : Path, optional
        A site's calibration file, applied to depth and rows.
    accepted_m : tuple of float
        Shortest and longest plausible fruit, metres, from the crop profile; by default those of a
        long cucumber. Fruit outside get no length.
    accepted_diameter_m : tuple of float
        Smallest and largest plausible mean diameter, metres.
    cut_beyond_m : float
        Distance of the cut beyond the stem end, metres, from the crop profile.
    camera_up : str, optional
        The image's edge that is up, 'top', 'left', 'right' or 'bottom', for a camera that is
        mounted about level before hanging fruit; it takes the place of `Capture.gravity` where a
        capture has none: the networks see the image turned upright, and the stem is above.
    """

    instances: str = "auto"
    classes: Sequence[str] = ()
    pose: Path | None = None
    quick: bool = False
    end_look: bool = True
    segmenter: str | None = None
    prompt: str = "box+point"
    methods: Sequence[str] = ("all",)
    selector: Selector = Selector.BEST
    length: LengthDefinition = LengthDefinition.CENTRELINE
    confidence: float = DEFAULT_CONFIDENCE
    input_sizes: tuple[int, ...] = ()
    runtime: str = "auto"
    full_precision: bool = True
    reading: ReadOptions = field(default_factory=ReadOptions)
    calibration: Path | None = None
    accepted_m: tuple[float, float] = (0.05, 0.80)
    accepted_diameter_m: tuple[float, float] = (0.012, 0.07)
    cut_beyond_m: float = CUT_BEYOND_M
    camera_up: str | None = None

    def __post_init__(self) -> None:
        """Convert names to enumerations, and reject invalid values.

        Raises
        ------
        CucumberVisionError
            With the option, its value and the allowed values.
        """
        names = (name.strip().casefold() for name in _listed(self.classes))
        object.__setattr__(self, "classes", tuple(filter(None, names)))
        object.__setattr__(self, "methods", _method_names(self.methods))
        for name, allowed in _CHOICES.items():
            value = getattr(self, name)
            if value not in allowed and (value is not None or name != "camera_up"):
                raise _no_choice(name, value, allowed)
        object.__setattr__(self, "length", LengthDefinition(self.length))
        object.__setattr__(self, "selector", Selector(self.selector))
        if not 0 <= self.confidence <= 1:
            raise _no_choice("confidence", self.confidence, ("a number from 0 to 1",))

    def for_crop(self, profile: CropProfile) -> Self:
        """Return the options with the plausible sizes and the cut of a crop."""
        return replace(
            self,
            accepted_m=profile.accepted_m,
            accepted_diameter_m=profile.accepted_diameter_m,
            cut_beyond_m=profile.cut_cm / 100,
        )

    def as_json(self) -> dict[str, Any]:
        """Return the options as JSON values."""
        values: dict[str, Any] = json_value(asdict(self))
        return values

    @property
    def sha256(self) -> str:
        """Hash of the options; equal options have equal hashes.

        Examples
        --------
        >>> MeasureOptions().sha256 == MeasureOptions(confidence=0.31).sha256
        False
        """
        text = json.dumps(self.as_json(), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def _listed(names: Sequence[str]) -> Sequence[str]:
    return names.split(",") if isinstance(names, str) else names


def _method_names(methods: Sequence[str]) -> tuple[str, ...]:
    """Return names of the table for what people write: names, 'all', or 'm1,m5' as one text."""
    names = {str(name).strip().casefold() for name in _listed(methods)}
    table = tuple(plugins("methods"))
    if names == {"all"}:
        return table
    for name in sorted(names - {name.casefold() for name in table}):
        raise _no_choice("methods", name, table)
    return tuple(name for name in table if name.casefold() in names)


def _no_choice(name: str, value: Any, allowed: tuple[str, ...]) -> errors.CucumberVisionError:
    return errors.CucumberVisionError(
        f"{value!r} is not a valid value", source=name, remedy=f"give {' or '.join(allowed)}"
    )


TRUTH = "truth.csv"
"""Lengths measured by hand, as `evaluate lengths` reads them."""


@dataclass(frozen=True)
class CropPack:
    """A crop's folder.

    Parameters
    ----------
    profile : CropProfile
        The profile, from `profile.toml`.
    segment, pose : Path, optional
        Its networks, `NAME-seg.onnx` and `NAME-pose.onnx` as `train export` writes them; without
        them, those of the package are used.
    truth : Path, optional
        Its `truth.csv`, if there is one.
    """

    profile: CropProfile
    segment: Path | None = None
    pose: Path | None = None
    truth: Path | None = None

    def options(self, options: MeasureOptions) -> MeasureOptions:
        """Return options with the size limits, the cut and the networks of this crop.

        Instances and keypoints chosen by the user are kept.
        """
        has_segmenter = options.instances in ("auto", "models") and self.segment is not None
        return replace(
            options.for_crop(self.profile),
            instances=str(self.segment) if has_segmenter else options.instances,
            pose=options.pose or self.pose,
        )


def read_pack(folder: Path) -> CropPack:
    """Read a crop's folder.

    Raises
    ------
    ProfileError
        If `profile.toml` is missing or invalid.
    ModelError
        If there are two networks for one task.
    ModelHashError
        If a network does not match the card in the same folder.
    """
    profile = load_profile(folder / PACK_PROFILE)
    truth = folder / TRUTH
    segment, pose = (_network(folder, task) for task in ("seg", "pose"))
    return CropPack(profile, segment, pose, truth if truth.is_file() else None)


def _network(folder: Path, task: str) -> Path | None:
    paths = sorted(folder.glob(f"*-{task}.onnx"))
    if len(paths) > 1:
        raise errors.ModelError(
            f"holds {len(paths)} networks *-{task}.onnx", source=folder, remedy="keep one"
        )
    for path in paths:
        card = path.with_suffix(".json")
        content = read_json(card, errors.ModelError) if card.is_file() else {}
        with errors.wrap_os_errors(
            "cannot be read", path, "put the network's file there", errors.ModelError
        ):
            sha256 = file_sha256(path)
        if isinstance(content, dict) and content.get("sha256") not in (None, sha256):
            raise errors.ModelHashError(
                f"is not the network that {card.name} describes",
                source=path,
                remedy="export both again with `cucumbervision train export`",
            )
    return paths[0] if paths else None


@dataclass(frozen=True, eq=False)
class PlugIns:
    """Plug-ins that a program passes in Python; copied into other processes by `pickle`.

    Parameters
    ----------
    detector : Detector, optional
        Finds the fruit in place of `MeasureOptions.instances`. What has no mask is segmented.
    segmenter : Segmenter, optional
        Draws all masks in place of `MeasureOptions.segmenter`.
    methods : tuple of Method
        Methods beside those of `MeasureOptions.methods`.
    traits : tuple of Trait
        Traits beside the package's and the installed ones.
    """

    detector: Detector | None = None
    segmenter: Segmenter | None = None
    methods: tuple[Method, ...] = ()
    traits: tuple[Trait, ...] = ()


class RunPlugins:
    """Methods and traits of a run, loaded once; those that cannot be loaded are left out.

    Parameters
    ----------
    options : MeasureOptions
        The run's choices.
    plug_ins : PlugIns
        Plug-ins that the program passes.

    Attributes
    ----------
    faults : list of PluginError
        Why plug-ins were left out.
    """

    def __init__(self, options: MeasureOptions, plug_ins: PlugIns) -> None:
        self._options = options
        kinds: tuple[Kind, ...] = get_args(Kind)
        self.faults = [fault for kind in kinds for fault in faults(kind)]
        self.methods: list[str | Method] = []
        self.traits: list[tuple[Plugin, Trait]] = []
        all_methods: list[str | Method] = [*options.methods, *plug_ins.methods]
        for method in all_methods:
            try:
                TableMethod.of(method)
                self.methods.append(method)
            except errors.PluginError as fault:
                self.faults.append(fault)
        taken = {field.name for field in fields_with(self._method_names(), ())}
        handed = [
            (Plugin.of("traits", getattr(trait, "function", trait), str(trait.name)), trait)
            for trait in plug_ins.traits
        ]
        for plugin, trait in (*((plugin, None) for plugin in plugins("traits").values()), *handed):
            try:
                part = plugin.load() if trait is None else trait
                name = trait_field(plugin, part).name
                if name in taken and not plugin.is_own:
                    raise plugin.error("has a name that is taken, and is left out")
                taken.add(name)
                self.traits.append((plugin, part))
            except errors.PluginError as fault:
                self.faults.append(fault)

    def _method_names(self) -> list[str]:
        """Return the methods whose columns there are, those that could not be loaded too."""
        names = [method if isinstance(method, str) else str(method.name) for method in self.methods]
        return [*self._options.methods, *names]

    @cached_property
    def fields(self) -> tuple[Field, ...]:
        """The columns of the run's tables."""
        return fields_with(self._method_names(), self.traits)

    @cached_property
    def lines(self) -> tuple[Plugin, ...]:
        """The lines of the table for methods and traits of other packages."""
        listed = (
            *(plugin_of(method) for method in self.methods),
            *(plugin for plugin, _ in self.traits),
        )
        return tuple(plugin for plugin in listed if not plugin.is_own)

    @property
    def models(self) -> tuple[dict[str, Any], ...]:
        """Their descriptions in files."""
        return tuple(plugin.as_json() for plugin in self.lines)
