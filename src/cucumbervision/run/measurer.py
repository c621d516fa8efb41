"""Measure a capture: calibrate, detect, measure; errors are converted to failures."""

from __future__ import annotations

import threading
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import zip_longest
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from cucumbervision.accuracy import calibration_file
from cucumbervision.accuracy.calibration_file import SiteCalibration
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.errors import (
    CaptureError,
    CucumberVisionError,
    DiskFullError,
    InternalError,
    named_error,
)
from cucumbervision.fruit.instance import Instance
from cucumbervision.methods.flags import Flag
from cucumbervision.methods.result import FIRST_LINE, Choice, Fruit, Measurement, MethodName, Reason
from cucumbervision.methods.selector import measure_fruit, with_end_looks
from cucumbervision.methods.traits import with_traits
from cucumbervision.networks.registry import Registry, load_registry
from cucumbervision.run.fields import FIELDS, Cell, Field, fruit_row
from cucumbervision.run.finders import Detections, Finder
from cucumbervision.run.options import GRAVITY_BY_EDGE, MeasureOptions, PlugIns, RunPlugins
from cucumbervision.tube.compiled import OneThread

_WARM_UP_PX = (640, 480)


@dataclass(frozen=True)
class Failure:
    """The reason why an input, capture or instance could not be read, measured or written.

    Parameters
    ----------
    input : str
        The file or folder given by the user.
    capture : str
        The capture in it; empty if the input itself failed.
    error : str
        Stable name: the name of a class in `cucumbervision.errors`.
    message : str
        The fault and the remedy in one line.
    """

    __pydantic_config__: ClassVar = FIRST_LINE

    input: str
    capture: str
    error: str
    message: str

    @classmethod
    def of(cls, error: Exception, input: str, capture: str = "") -> Failure:
        """Return the failure for an exception."""
        named = named_error(error, capture or input)
        return cls(input, capture, named.code, named.line)

    @property
    def is_defect(self) -> bool:
        """Whether the cause is a defect of the software."""
        return self.error == InternalError.__name__


class Boundary:
    """Context that converts any exception to a failure, so that a batch can continue.

    KeyboardInterrupt and SystemExit are not converted.

    Parameters
    ----------
    failures : list of Failure
        The failure is appended to this list.
    input, capture : str
        As in `Failure`.

    Examples
    --------
    >>> failures = []
    >>> with Boundary(failures, "house", "a"):
    ...     raise MemoryError
    >>> failures[0].error
    'OutOfMemoryError'
    """

    def __init__(self, failures: list[Failure], input: str, capture: str = "") -> None:
        self._failures, self._input, self._capture = failures, input, capture

    def __enter__(self) -> None:
        """Enter the context."""

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> bool:
        """Append the failure, if there is one; a full disk ends the batch.

        Raises
        ------
        DiskFullError
            If the disk is full: later captures could not be written either.
        """
        if isinstance(error, Exception):
            if isinstance(named := named_error(error, self._input), DiskFullError):
                raise named from error
            self._failures.append(Failure.of(error, self._input, self._capture))
        return isinstance(error, Exception)


def exit_code(done: int, failures: Iterable[Failure]) -> int:
    """Return a command's exit code.

    Parameters
    ----------
    done : int
        Number of captures without failure.
    failures : iterable of Failure
        The failures.

    Returns
    -------
    int
        70 (EX_SOFTWARE) if a failure is a defect of the software, 0 without failures, 1 if some
        captures succeeded, 2 if none did.

    Examples
    --------
    >>> exit_code(3, []), exit_code(0, [Failure("a", "", "CaptureError", "does not exist")])
    (0, 2)
    """
    failed = list(failures)
    if any(failure.is_defect for failure in failed):
        return 70
    return 0 if not failed else (1 if done else 2)


@dataclass(frozen=True, eq=False)
class CaptureResult:
    """The result of one capture.

    Parameters
    ----------
    capture : Capture
        The measured frame, with depth scaled by the calibration, if there is one.
    fruit : tuple of Fruit
        One entry for every detection.
    failures : tuple of Failure
        Why nothing was measured, and invalid entries of a file of instances.
    error : CucumberVisionError, optional
        Why nothing was measured; None if the capture was measured, even without fruit.
    models : tuple of dict
        Name, SHA-256 and runtime of each network that is loaded; kind, name, package and version
        of each plug-in of another package.
    fields : tuple of Field
        Columns of the rows.
    left_out : mapping of str to int
        Number of excluded detections by class.
    """

    capture: Capture
    fruit: tuple[Fruit, ...] = ()
    failures: tuple[Failure, ...] = ()
    error: CucumberVisionError | None = None
    models: tuple[dict[str, Any], ...] = ()
    left_out: Mapping[str, int] = field(default_factory=dict)
    fields: tuple[Field, ...] = FIELDS

    def __repr__(self) -> str:
        return f"<CaptureResult {self.capture.name}: {list(self.fruit)}>"

    def rows(self) -> list[dict[str, Cell]]:
        """Return the rows of the table of fruit."""
        numbered = enumerate(self.fruit, 1)
        return [fruit_row(self.capture, number, fruit, self.fields) for number, fruit in numbered]


class Measurer:
    """Measures captures; its calibration and networks are loaded once, with the first capture.

    Parameters
    ----------
    options : MeasureOptions
        How to measure.
    registry : Registry, optional
        Registry of named networks; by default that of the package.
    plug_ins : PlugIns, optional
        Detector, segmenter, methods and traits of the calling program.

    Examples
    --------
    >>> from cucumbervision.capture.source import example_captures
    >>> from cucumbervision.capture.readers import open_source
    >>> measurer = Measurer(MeasureOptions(instances="dataset"))
    >>> result = measurer.measure(next(iter(open_source(example_captures()))).load())
    >>> length = result.fruit[0].length
    >>> f"{100 * length.low_m:.0f} to {100 * length.high_m:.0f} cm, {length.kind}"
    '16 to 17 cm, centreline'
    """

    def __init__(
        self,
        options: MeasureOptions | None = None,
        registry: Registry | None = None,
        plug_ins: PlugIns | None = None,
    ) -> None:
        self.options = options or MeasureOptions()
        self._registry, self.plug_ins = registry, plug_ins or PlugIns()
        self._finder: Finder | None = None
        # Networks, methods and traits need not be safe for several threads.
        self._finding, self._measuring = threading.RLock(), threading.Lock()

    def __repr__(self) -> str:
        return f"<Measurer: {self.options.instances}, {self.options.length}>"

    @property
    def models(self) -> list[dict[str, Any]]:
        """Name, SHA-256 and runtime of each loaded network."""
        return [] if self._finder is None else self._finder.networks.models

    @cached_property
    def site(self) -> SiteCalibration | None:
        """The site's calibration, if the options name one.

        Raises
        ------
        CalibrationError
            If it cannot be read.
        """
        if self.options.calibration is None:
            return None
        return calibration_file.read_site_calibration(self.options.calibration)

    @cached_property
    def plugged(self) -> RunPlugins:
        """Methods and traits that take part, and which of the installed ones cannot."""
        return RunPlugins(self.options, self.plug_ins)

    @property
    def registry(self) -> Registry:
        """The named networks."""
        return self._registry or load_registry()

    def calibrated_by(self, site: SiteCalibration | None, path: Path | None = None) -> Measurer:
        """Return a measurer with another calibration, or none, that shares the loaded networks.

        Parameters
        ----------
        site : SiteCalibration, optional
            The calibration.
        path : Path, optional
            Its file, for the options.
        """
        options = replace(self.options, calibration=path)
        other = Measurer(options, self._registry, self.plug_ins)
        other._finder, other.site = self._finder, site
        return other

    def load(self) -> Finder:
        """Load networks and calibration, if not loaded; SAM is loaded on first use.

        Raises
        ------
        CucumberVisionError
            If a network, the file of instances or the calibration cannot be loaded.
        """
        with self._finding:
            if self._finder is None:
                _ = self.site  # report an unreadable calibration before loading networks
                self._finder = Finder(self.options, self._registry, self.plug_ins)
            return self._finder

    def warm_up(self) -> None:
        """Load the detection networks and run them on a grey image; SAM is loaded on first use.

        Raises
        ------
        CucumberVisionError
            As `load`.
        """
        finder = self.load()
        instances = self.options.instances
        if instances not in ("auto", "models") and not instances.lower().endswith(".onnx"):
            return  # masks of a data set or file need no networks
        lens = Intrinsics(*_WARM_UP_PX, float(_WARM_UP_PX[0]), float(_WARM_UP_PX[0]), 320.0, 240.0)
        shape = _WARM_UP_PX[::-1]
        color = np.full((*shape, 3), 90, np.uint8)
        finder.find(Capture(color, np.zeros(shape, np.float32), lens, "warm-up"))
        if look_at_ends := finder.networks.look_at_ends:
            look_at_ends([])

    def measure(self, capture: Capture) -> CaptureResult:
        """Find and measure the fruit of one capture.

        Raises
        ------
        CucumberVisionError
            If a network cannot be loaded, or the calibration belongs to another camera.
        """
        detected = self.detect(capture)
        with self._measuring:
            return self.measure_detected(*detected)

    @OneThread()
    def detect(self, capture: Capture) -> tuple[Capture, Detections]:
        """Find the fruit of one capture: the first half of `measure`.

        Raises
        ------
        CucumberVisionError
            As `measure`.
        """
        if not isinstance(capture, Capture):
            raise CaptureError(
                f"measure takes a Capture, not {type(capture).__name__}",
                remedy="open files and folders with open_source(PATH), and load() what it lists",
            )
        finder = self.load()
        if self.site is not None:
            capture = calibration_file.calibrated_capture(capture, self.site)
        if self.options.camera_up is not None and capture.gravity is None:
            capture = replace(capture, gravity=GRAVITY_BY_EDGE[self.options.camera_up])
        with self._finding:
            return capture, finder.find(capture)

    @OneThread()
    def measure_detected(
        self, capture: Capture, detections: Detections, chosen: Collection[int] | None = None
    ) -> CaptureResult:
        """Measure detected fruit: the second half of `measure`.

        Parameters
        ----------
        capture, detections
            Result of `detect`.
        chosen : collection of int, optional
            Indices of the fruit to measure; all by default.
        """
        doubts = [Flag(doubt) for doubt in capture.doubts]
        pairs = list(zip_longest(detections.instances, detections.tubes))
        measured = [
            self._measured(capture, instance, tube)
            if chosen is None or k in chosen
            else Fruit(instance, {}, None, Choice.WAITING).flagged(*doubts)
            for k, (instance, tube) in enumerate(pairs)
        ]
        fruit = self._judged(capture, measured)
        for number, instance in enumerate(detections.instances):
            if instance.is_clipped:
                fruit[number] = fruit[number].flagged(Flag.BOX_CLIPPED)
        errors = {str(error): error for measurement in fruit for error in measurement.errors}
        refused = [
            Failure.of(error, capture.source, capture.name)
            for error in (*detections.refused, *errors.values())
        ]
        models = () if self._finder is None else self._finder.models
        reader = capture.provenance.get("reader")
        return CaptureResult(
            capture=capture,
            fruit=tuple(with_unit_doubts(fruit)),
            failures=tuple(refused),
            models=(*models, *self.plugged.models, *([reader] if isinstance(reader, dict) else [])),
            left_out=detections.left_out,
            fields=self.plugged.fields,
        )

    def measure_instance(
        self, capture: Capture, instance: Instance, tube: Measurement | None = None
    ) -> Fruit:
        """Measure one fruit of a capture with scaled depth; `tube` as in `Detections.tubes`."""
        return self._judged(capture, [self._measured(capture, instance, tube)])[0]

    def _measured(self, capture: Capture, instance: Instance, tube: Measurement | None) -> Fruit:
        options = self.options
        return measure_fruit(
            capture,
            instance,
            self.plugged.methods,
            options.selector,
            options.length,
            scale_known=self.scale_known,
            cut_beyond_m=options.cut_beyond_m,
            tube=tube,
        )

    def _judged(self, capture: Capture, measured: list[Fruit]) -> list[Fruit]:
        """Add the look at the ends, the calibration and the size limits to measured fruit.

        The ends of all fruit are evaluated in one batch. Implausible sizes get no length. Traits
        are added last.
        """
        options, scale_known = self.options, self.scale_known
        look = None if self._finder is None else self._finder.networks.look_at_ends
        if options.end_look and look is not None:
            measured = with_end_looks(
                capture, measured, look, options.length, scale_known=scale_known
            )
        if self.site is not None:
            measured = [
                calibration_file.calibrated_fruit(fruit, self.site, options.length)
                for fruit in measured
            ]
        sizes = options.accepted_m, options.accepted_diameter_m
        accepted = [accepted_fruit(fruit, *sizes, capture.intrinsics) for fruit in measured]
        traits = self.plugged.traits
        return [
            fruit if fruit.reason is Choice.WAITING else with_traits(capture, fruit, traits)
            for fruit in accepted
        ]

    @property
    def scale_known(self) -> bool:
        """Whether the calibration contains the depth scale of the camera."""
        return self.site is not None and self.site.depth_scale is not None

    def attempt(self, capture: Capture) -> CaptureResult:
        """Measure a capture; errors are returned in the result."""
        try:
            return self.measure(capture)
        except Exception as error:
            named = named_error(error, capture.source or capture.name)
            failure = Failure.of(named, capture.source, capture.name)
            return CaptureResult(capture, failures=(failure,), error=named)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle options and calibration, so that another process loads its own networks.

        The calibration is the one that was read here: its file may be replaced before that.
        """
        return _as_pickled, (self.options, self._registry, self.plug_ins, self.site)


def _as_pickled(
    options: MeasureOptions,
    registry: Registry | None,
    plug_ins: PlugIns,
    site: SiteCalibration | None,
) -> Measurer:
    return Measurer(options, registry, plug_ins).calibrated_by(site, options.calibration)


def plugin_failures(measurer: Measurer) -> list[Failure]:
    """Return the installed plug-ins that a run goes on without, and why."""
    return [Failure.of(fault, fault.source) for fault in measurer.plugged.faults]


_REFUSED = frozenset({Choice.IMPLAUSIBLE, Choice.IMPLAUSIBLE_DIAMETER})


def accepted_fruit(
    fruit: Fruit,
    lengths_m: tuple[float, float],
    diameters_m: tuple[float, float],
    intrinsics: Intrinsics,
) -> Fruit:
    """Return a fruit, without its length if the size is implausible for the crop.

    Parameters
    ----------
    fruit : Fruit
        The fruit with its length, a lower bound if it continues out of sight.
    lengths_m : tuple of float
        Shortest and longest, metres.
    diameters_m : tuple of float
        Least and largest mean diameter, metres.
    intrinsics : Intrinsics
        The camera, for the mean width of a mask whose tube was out of range.

    Returns
    -------
    Fruit
        If the size is outside the limits, nothing is selected, the reason is 'implausible-length'
        or 'implausible-diameter', and `fallback` ends with the rejected method. A fruit that is
        too large is flagged 'depth-unit'. The measurements of the methods are unchanged.
    """
    if fruit.length is None:
        return fruit
    length_m, diameter_m = fruit.length.value_m, _mean_diameter(fruit, intrinsics)
    large = length_m > lengths_m[1] or diameter_m > diameters_m[1]
    if length_m > lengths_m[1] or (length_m < lengths_m[0] and not fruit.at_least):
        reason = Choice.IMPLAUSIBLE
    elif large or diameter_m < diameters_m[0]:
        reason = Choice.IMPLAUSIBLE_DIAMETER
    else:
        return fruit
    tried = f"{fruit.method}:{Reason.OUT_OF_RANGE}"
    refused = replace(
        fruit,
        selected=None,
        reason=reason,
        fallback=(*fruit.fallback, tried),
        length=None,
        raw_length=None,
    )
    return refused.flagged(Flag.DEPTH_UNIT) if large else refused


def _mean_diameter(fruit: Fruit, intrinsics: Intrinsics) -> float:
    """Return the mean diameter, metres; NaN, which passes every limit, if it is unknown."""
    if fruit.traits is not None:
        return fruit.traits.diameter_mean_m
    tube = fruit.measurements.get(MethodName.M6)
    out = tube is not None and tube.reason is Reason.OUT_OF_RANGE
    if not out or fruit.mask is None or fruit.distance_m is None or fruit.length is None:
        return np.nan
    pixel_m2 = fruit.distance_m**2 / (intrinsics.fx_px * intrinsics.fy_px)
    return float(fruit.mask.sum() * pixel_m2 / fruit.length.value_m)


def with_unit_doubts(fruit: Sequence[Fruit]) -> tuple[Fruit, ...]:
    """Return the fruit of one image, all flagged 'depth-unit' if half of them are too large.

    They share one depth image: if its unit is wrong, fruit of plausible size are wrong, too.
    """
    is_sized = [measured.length is not None or measured.reason in _REFUSED for measured in fruit]
    large = sum(Flag.DEPTH_UNIT in measured.flags for measured in fruit)
    if not large or 2 * large < sum(is_sized):
        return tuple(fruit)
    return tuple(
        measured.flagged(Flag.DEPTH_UNIT) if sized else measured
        for measured, sized in zip(fruit, is_sized, strict=True)
    )
