"""Measure many captures: one after the other, each written before the next is read."""

from __future__ import annotations

import platform
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from cucumbervision._version import __version__
from cucumbervision.about import LICENCE, installed_versions, source_offer
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import unique_names
from cucumbervision.errors import CucumberVisionError
from cucumbervision.measurement.selector import measure_fruit
from cucumbervision.session.exports import FAILURE_COLUMNS, CsvSink, write_json, write_workbook
from cucumbervision.session.finders import Finder, make_finder
from cucumbervision.session.rows import COLUMNS, fruit_row
from cucumbervision.session.summary import summary_lines

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from cucumbervision.capture.frames import Capture
    from cucumbervision.capture.source import CaptureRef, CaptureSource
    from cucumbervision.measurement.results import Fruit, Measurement
    from cucumbervision.session.options import MeasureOptions
    from cucumbervision.session.rows import Cell

__all__ = ["Failure", "RunResult", "count_captures", "measure_capture", "measure_inputs"]

Report: TypeAlias = Callable[["Capture | None", "Sequence[Fruit]", "Failure | None"], None]


@dataclass(frozen=True)
class Failure:
    """An input or a capture that could not be read, in one line."""

    input: str
    capture: str
    error: str
    message: str


@dataclass(frozen=True, eq=False)
class RunResult:
    """What one run gave.

    Parameters
    ----------
    rows : list of dict
        One a fruit, as `session.rows.fruit_row` fills them.
    failures : list of Failure
        What could not be read; the rest was measured.
    captures : int
        How many captures were measured, those without fruit included.
    out : Path
        Where the files are.
    """

    rows: list[dict[str, Cell]] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    captures: int = 0
    out: Path = Path()


def measure_capture(capture: Capture, finder: Finder, options: MeasureOptions) -> tuple[Fruit, ...]:
    """Find and measure the fruit of one capture.

    Parameters
    ----------
    capture : Capture
        The frame.
    finder : Finder
        What finds the fruit.
    options : MeasureOptions
        The run's choices.

    Returns
    -------
    tuple of Fruit
        One for every detection.
    """
    return tuple(
        measure_fruit(capture, instance, options.methods, options.selector)
        for instance in finder.find(capture)
    )


def measure_inputs(
    inputs: Sequence[Path], out: Path, options: MeasureOptions, report: Report | None = None
) -> RunResult:
    """Measure every capture of every input into a folder.

    `out` gets `measurements.csv`, `measurements.xlsx`, `measurements.json`, `overlays/` with one
    annotated PNG a capture, and `failures.csv`. A capture that cannot be read is noted and the
    others go on.

    Parameters
    ----------
    inputs : sequence of Path
        Folders and files that `open_source` knows.
    out : Path
        Made where it is missing; its tables are written anew.
    options : MeasureOptions
        The run's choices.
    report : callable, optional
        Called after each capture with the capture (or None), its fruit, and the failure (or
        None); for progress bars.

    Returns
    -------
    RunResult

    Raises
    ------
    CucumberVisionError
        If the run cannot start at all: `out` cannot be written, or a network cannot be loaded.
    """
    finder = make_finder(options)
    result = RunResult(out=out)
    captures = []
    try:
        (out / "overlays").mkdir(parents=True, exist_ok=True)
        stack = ExitStack()
        rows = stack.enter_context(CsvSink(out / "measurements.csv", [c.name for c in COLUMNS]))
        bad = stack.enter_context(CsvSink(out / "failures.csv", FAILURE_COLUMNS))
    except OSError as error:
        raise CucumberVisionError(
            f"cannot be written ({error.strerror})", source=out, remedy="choose another --out"
        ) from error
    started = datetime.now(UTC)
    with stack:
        for capture, failure in _read_all(inputs, options):
            fruit: tuple[Fruit, ...] = ()
            if capture is not None:
                try:
                    fruit = measure_capture(capture, finder, options)
                except CucumberVisionError as error:
                    failure = _failure(capture.source, capture.name, error)
            if failure is None and capture is not None:
                lines = [
                    fruit_row(capture, n, one, options.length) for n, one in enumerate(fruit, 1)
                ]
                for line in lines:
                    rows.write(line)
                _write_overlay(out / "overlays" / f"{capture.name}.png", capture, fruit)
                captures.append(_capture_json(capture, fruit, lines))
                result.rows.extend(lines)
            elif failure is not None:
                bad.write(vars(failure))
                result.failures.append(failure)
            if report is not None:
                report(capture, fruit, failure)
    done = RunResult(result.rows, result.failures, len(captures), out)
    _write_reports(done, captures, finder, options, started)
    return done


def count_captures(inputs: Sequence[Path], options: MeasureOptions) -> int | None:
    """Say how many captures the inputs hold; None where only reading them would tell."""
    total = 0
    for path in inputs:
        try:
            source = open_source(path, options.reading)
        except CucumberVisionError:
            total += 1  # its failure is reported as one step
            continue
        if source.total is None:
            return None
        total += source.total
    return total


def _read_all(
    inputs: Sequence[Path], options: MeasureOptions
) -> Iterator[tuple[Capture | None, Failure | None]]:
    taken: list[str] = []
    for path in inputs:
        try:
            source = open_source(path, options.reading)
        except CucumberVisionError as error:
            yield None, _failure(str(path), "", error)
            continue
        yield from _read_source(source, path, taken)


def _read_source(
    source: CaptureSource, path: Path, taken: list[str]
) -> Iterator[tuple[Capture | None, Failure | None]]:
    refs = iter(source)
    while True:
        name = ""
        try:
            ref: CaptureRef | None = next(refs, None)
            if ref is None:
                return
            name = ref.name
            capture = ref.load()
        except CucumberVisionError as error:
            yield None, _failure(str(path), name, error)
            if not name:  # the source itself broke: nothing more will come
                return
            continue
        taken.append(unique_names([*taken, capture.name])[-1])
        yield replace(capture, name=taken[-1]), None


def _failure(source: str, capture: str, error: CucumberVisionError) -> Failure:
    return Failure(source, capture, error.code, str(error))


def _write_overlay(path: Path, capture: Capture, fruit: Sequence[Fruit]) -> None:
    import cv2

    from cucumbervision.session.overlay import draw_overlay

    ok, data = cv2.imencode(".png", draw_overlay(capture, fruit)[..., ::-1])
    if ok:
        path.write_bytes(data.tobytes())


def _capture_json(
    capture: Capture, fruit: Sequence[Fruit], rows: Sequence[dict[str, Cell]]
) -> dict[str, Any]:
    camera = capture.intrinsics
    return {
        "name": capture.name,
        "frame": capture.frame,
        "source": capture.source,
        "simulated": capture.simulated,
        "intrinsics": {
            "stream": str(camera.stream),
            "width": camera.width,
            "height": camera.height,
            "fx_px": camera.fx_px,
            "fy_px": camera.fy_px,
            "cx_px": camera.cx_px,
            "cy_px": camera.cy_px,
            "distortion": str(camera.distortion),
            "coefficients": list(camera.coefficients),
        },
        "provenance": dict(capture.provenance),
        "fill": round(capture.fill, 4),
        "fruit": [
            {**row, "methods": {str(m): _method_json(x) for m, x in one.measurements.items()}}
            for row, one in zip(rows, fruit, strict=True)
        ],
    }


def _method_json(measurement: Measurement) -> dict[str, Any]:
    path = measurement.path_m
    return {
        "length_m": measurement.length_m,
        "kind": measurement.kind and str(measurement.kind),
        "reason": str(measurement.reason),
        "fallback": list(measurement.fallback),
        "tips_m": None if path is None else np.round(path[[0, -1]], 5).tolist(),
    }


def _write_reports(
    result: RunResult,
    captures: list[dict[str, Any]],
    finder: Finder,
    options: MeasureOptions,
    started: datetime,
) -> None:
    provenance = {
        "software": f"cucumbervision {__version__}",
        "licence": LICENCE,
        "source": source_offer(),
        "started": started.isoformat(timespec="seconds"),
        "config": options.as_json(),
        "config_sha256": options.sha256,
        "models": finder.models,
        "versions": {"python": platform.python_version(), **installed_versions()},
    }
    failures = [vars(failure) for failure in result.failures]
    report = {**provenance, "captures": captures, "failures": failures}
    write_json(result.out / "measurements.json", report)
    write_workbook(result.out / "measurements.xlsx", result.rows, summary_lines(result, provenance))
