"""Measure captures in one call, from Python: results by capture, as rows, or as a data frame."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.readers import open_source
from cucumbervision.errors import CaptureError, MissingExtraError
from cucumbervision.files import as_path
from cucumbervision.fruit.instance import Instance
from cucumbervision.run.batch import Item, ResultWorker, measure_all
from cucumbervision.run.fields import FIELDS
from cucumbervision.run.inputs import (
    Listed,
    instance_notes,
    label_file,
    labelled_once,
    list_captures,
)
from cucumbervision.run.measurer import Boundary, CaptureResult, Failure, Measurer, plugin_failures
from cucumbervision.run.options import MeasureOptions, PlugIns

if TYPE_CHECKING:
    from collections.abc import Iterator

    import pandas as pd
    from numpy.typing import ArrayLike, NDArray

    from cucumbervision.capture.intrinsics import Intrinsics
    from cucumbervision.methods.result import Fruit
    from cucumbervision.methods.table import Method, Trait
    from cucumbervision.plugins import Detector, Reader, Segmenter
    from cucumbervision.run.fields import Cell
    from cucumbervision.run.inputs import Opener


@dataclass(frozen=True, eq=False)
class Results:
    """Measured captures.

    Parameters
    ----------
    captures : tuple of CaptureResult
        One entry for each capture that could be read, in order.
    failures : tuple of Failure
        Captures that could not be read or measured.
    """

    captures: tuple[CaptureResult, ...]
    failures: tuple[Failure, ...] = ()

    @property
    def fruit(self) -> tuple[Fruit, ...]:
        """The fruit of all captures."""
        return tuple(fruit for result in self.captures for fruit in result.fruit)

    def rows(self) -> list[dict[str, Cell]]:
        """Return one row per fruit, with the columns of `measurements.csv`."""
        return [row for result in self.captures for row in result.rows()]

    def to_dataframe(self) -> pd.DataFrame:
        """Return the rows as a data frame.

        Raises
        ------
        MissingExtraError
            If pandas is not installed.
        """
        try:
            import pandas as pd
        except ModuleNotFoundError:
            raise MissingExtraError("pandas") from None
        fields = self.captures[0].fields if self.captures else FIELDS
        return pd.DataFrame(self.rows(), columns=[fruit_field.name for fruit_field in fields])

    def __iter__(self) -> Iterator[CaptureResult]:
        return iter(self.captures)

    def __len__(self) -> int:
        return len(self.captures)

    def __repr__(self) -> str:
        count, failed = len(self.fruit), len(self.failures)
        return f"<Results: {count} fruit in {len(self)} captures, {failed} failures>"


def measure(
    captures: Capture | Path | str | NDArray[np.uint8] | Iterable[Capture | Path | str],
    depth: NDArray[Any] | None = None,
    intrinsics: Intrinsics | ArrayLike | None = None,
    *,
    masks: Iterable[NDArray[Any]] | None = None,
    instances: str | Path | Sequence[Instance] | Detector | None = None,
    segmenter: str | Segmenter | None = None,
    methods: str | Iterable[str | Method] = "all",
    traits: Iterable[Trait] = (),
    readers: Iterable[Reader] = (),
    depth_unit_m: float | None = None,
    options: MeasureOptions | None = None,
    **choices: Any,
) -> Results:
    """Measure captures, or the arrays of one.

    For repeated calls, use a `Measurer`: its networks are loaded once.

    Parameters
    ----------
    captures : Capture, Path or str, or several of them; or ndarray of uint8, shape (H, W, 3)
        Captures in memory; folders, files and URLs that `open_source` reads; or a picture, red
        first.
    depth, intrinsics, depth_unit_m
        For a picture, as in `Capture.from_arrays`.
    masks : iterable of ndarray, shape (H, W), optional
        The fruit of one capture, one mask each, as people drew them.
    instances : str, Path, sequence of Instance or Detector, optional
        Source of the fruit: as in `MeasureOptions.instances`; the instances of one capture; or a
        detector, which is called with each `Capture` and returns its instances.
    segmenter : str or Segmenter, optional
        Draws all masks: a name, as `MeasureOptions.segmenter`, or an object with `segment`.
    methods : str or iterable of str or Method
        Methods to run, as `MeasureOptions.methods`, and methods of your own.
    traits : iterable of Trait
        Traits of your own, each a column.
    readers : iterable of Reader
        Readers of your own, which see a folder before those of the package.
    options : MeasureOptions, optional
        How to measure.
    **choices
        Fields of `MeasureOptions`, in place of `options`.

    Returns
    -------
    Results
        A capture that cannot be read or measured is among its failures; the others are measured.

    Raises
    ------
    CucumberVisionError
        If arrays do not fit each other, a network or the calibration cannot be loaded, or an option
        is unknown.

    Examples
    --------
    >>> from cucumbervision import example_captures, measure
    >>> results = measure(example_captures(), instances="dataset")
    >>> results
    <Results: 8 fruit in 3 captures, 0 failures>
    >>> [f"{fruit.length.value_m:.2f} m" for fruit in results.fruit[:3]]
    ['0.16 m', '0.12 m', '0.25 m']

    Of arrays:

    >>> capture = results.captures[0].capture
    >>> measure(capture.color, capture.depth_m, capture.intrinsics.matrix, masks=capture.masks)
    <Results: 3 fruit in 1 captures, 0 failures>
    """
    if masks is not None:
        instances = [Instance.of_mask(mask) for mask in masks]
    detector: Detector | None = None
    if isinstance(instances, str | Path):
        choices = {**choices, "instances": str(instances)}
    elif instances is not None:
        detector = instances if callable(instances) else _always(instances)
    if isinstance(segmenter, str):
        choices, segmenter = {**choices, "segmenter": segmenter}, None
    method_names, own_methods = _sorted_methods(methods)
    if method_names != ["all"]:
        choices = {**choices, "methods": method_names}
    if options is not None and choices:
        raise TypeError("give options or their fields, not both")
    plug_ins = PlugIns(detector, segmenter, own_methods, tuple(traits))
    measurer = Measurer(options or MeasureOptions(**choices), plug_ins=plug_ins)
    measurer.load()
    if isinstance(captures, np.ndarray):
        if depth is None or intrinsics is None:
            raise CaptureError(
                "a picture alone has no lengths", remedy="give measure(color, depth, intrinsics)"
            )
        captures = Capture.from_arrays(captures, depth, intrinsics, depth_unit_m=depth_unit_m)
    elif not depth is intrinsics is depth_unit_m is None:
        raise CaptureError(
            "depth, intrinsics and depth_unit_m belong to a picture in memory",
            remedy="for files give options=MeasureOptions(reading=ReadOptions(...))",
        )
    inputs = [captures] if isinstance(captures, Capture | Path | str) else captures
    return _measured(measurer, inputs, partial(open_source, readers=tuple(readers)))


def _measured(
    measurer: Measurer, inputs: Iterable[Capture | Path | str], opener: Opener
) -> Results:
    """Measure captures in memory and those below paths."""

    def items() -> Iterator[Item]:
        for source in inputs:
            if isinstance(source, Capture):
                yield Listed.of(source)
            else:
                yield from list_captures([as_path(source)], measurer.options.reading, opener)

    chosen = measurer.options.instances
    labels = label_file(chosen) if measurer.plug_ins.detector is None else None
    listed = labelled_once(labels, items())
    outcomes = [outcome for _, outcome in measure_all(listed, ResultWorker(measurer))]
    results = [
        outcome.value
        for outcome in outcomes
        if outcome.value is not None and outcome.value.error is None
    ]
    failures = plugin_failures(measurer)
    failures += [failure for outcome in outcomes for failure in outcome.failures]
    if labels is not None:
        names = [((r.capture.name, r.capture.source), r.capture.frame) for r in results]
        with Boundary(failures, chosen):
            instance_notes(labels, names)
    return Results(tuple(results), tuple(failures))


def _sorted_methods(methods: str | Iterable[str | Method]) -> tuple[list[str], tuple[Method, ...]]:
    """Return the names among methods, 'all' if there are none, and the methods themselves."""
    listed = methods.split(",") if isinstance(methods, str) else list(methods)
    names = [method for method in listed if isinstance(method, str)]
    return names or ["all"], tuple(method for method in listed if not isinstance(method, str))


def _always(instances: Sequence[Instance]) -> Detector:
    return lambda _: instances
