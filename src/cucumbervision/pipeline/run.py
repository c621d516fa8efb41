"""Measure many captures: one after the other, each written before the next is read."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, TypeAlias

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import unique_name
from cucumbervision.errors import CucumberVisionError
from cucumbervision.measurement.selector import measure_fruit
from cucumbervision.pipeline.exports import FAILURE_COLUMNS, CsvSink
from cucumbervision.pipeline.finders import Finder, make_finder
from cucumbervision.pipeline.intervals import with_simulated_interval
from cucumbervision.pipeline.report import capture_json, write_reports
from cucumbervision.pipeline.results import Failure, RunResult
from cucumbervision.pipeline.rows import COLUMNS, fruit_row

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from cucumbervision.calibration.calibration_file import SiteCalibration
    from cucumbervision.capture.frames import Capture
    from cucumbervision.capture.source import CaptureRef, CaptureSource, ReadOptions
    from cucumbervision.measurement.result import Fruit
    from cucumbervision.pipeline.options import MeasureOptions
    from cucumbervision.pipeline.rows import Cell

__all__ = ["capture_rows", "count_captures", "measure_capture", "measure_inputs"]

Opener: TypeAlias = Callable[["Path", "ReadOptions"], "CaptureSource"]
Report: TypeAlias = Callable[["Capture | None", "Sequence[Fruit]", "Sequence[Failure]"], None]


def measure_capture(
    capture: Capture, finder: Finder, options: MeasureOptions
) -> tuple[tuple[Fruit, ...], tuple[CucumberVisionError, ...]]:
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
    fruit : tuple of Fruit
        One for every detection.
    refused : tuple of CucumberVisionError
        What a file of instances gave that is no fruit in this picture.
    """
    found = finder.find(capture)
    fruit = []
    for index, instance in enumerate(found.instances):
        one = measure_fruit(capture, instance, options.methods, options.selector)
        cut = ("box-clipped",) if index in found.clipped else ()
        fruit.append(replace(one, flags=(*one.flags, *cut)))
    return tuple(fruit), found.refused


def measure_inputs(
    inputs: Sequence[Path],
    out: Path,
    options: MeasureOptions,
    report: Report | None = None,
    opener: Opener = open_source,
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
        Called after each capture with the capture (None if it could not be read), its fruit and
        the failures; for progress bars.
    opener : callable
        Opens each input; `intake.recordings.open_guarded` for recordings from strangers.

    Returns
    -------
    RunResult

    Raises
    ------
    CucumberVisionError
        If the run cannot start at all: `out` cannot be written, or a network or the calibration
        cannot be loaded.
    """
    site = _load_calibration(options)
    finder = make_finder(options)
    started = datetime.now(UTC)
    result = RunResult(out=out)
    captures = []
    with ExitStack() as stack:
        rows, failures = _open_tables(out, stack)
        for read, broken in _read_all(inputs, options, opener):
            capture, fruit, noted = _measure_or_note(read, broken, finder, options, site)
            if capture is not None:
                lines = capture_rows(capture, fruit, options, site)
                for line in lines:
                    rows.write(line)
                _write_overlay(out / "overlays" / f"{capture.name}.png", capture, fruit, lines)
                captures.append(capture_json(capture, fruit, lines))
                result.rows.extend(lines)
            for failure in noted:
                failures.write(vars(failure))
            result.failures.extend(noted)
            if report is not None:
                report(capture, fruit, noted)
    result = replace(result, captures=len(captures))
    write_reports(result, captures, finder, options, started, site)
    return result


def _load_calibration(options: MeasureOptions) -> SiteCalibration | None:
    if options.calibration is None:
        return None
    from cucumbervision.calibration.calibration_file import read_site_calibration

    return read_site_calibration(options.calibration)


def capture_rows(
    capture: Capture,
    fruit: Sequence[Fruit],
    options: MeasureOptions,
    site: SiteCalibration | None,
) -> list[dict[str, Cell]]:
    """Fill the rows of one capture's fruit: with intervals, and calibrated where a site is given.

    Parameters
    ----------
    capture : Capture
        The frame, its depth already scaled by the site's calibration.
    fruit : sequence of Fruit
        What `measure_capture` gave.
    options : MeasureOptions
        The run's choices.
    site : SiteCalibration, optional
        The site's calibration.

    Returns
    -------
    list of dict
        A value for every name in `session.rows.COLUMNS`, in the order of the fruit.
    """
    scale_known = site is not None and site.depth_scale is not None
    rows = [
        with_simulated_interval(
            fruit_row(capture, n, one, options.length), one, options.length, scale_known=scale_known
        )
        for n, one in enumerate(fruit, 1)
    ]
    if site is None:
        return rows
    from cucumbervision.pipeline.calibrated import calibrated_row

    return [calibrated_row(row, site, options.length) for row in rows]


def _open_tables(out: Path, stack: ExitStack) -> tuple[CsvSink, CsvSink]:
    try:
        (out / "overlays").mkdir(parents=True, exist_ok=True)
        rows = stack.enter_context(CsvSink(out / "measurements.csv", [c.name for c in COLUMNS]))
        return rows, stack.enter_context(CsvSink(out / "failures.csv", FAILURE_COLUMNS))
    except OSError as error:
        raise CucumberVisionError(
            f"cannot be written ({error.strerror})", source=out, remedy="choose another --out"
        ) from error


def _measure_or_note(
    capture: Capture | None,
    failure: Failure | None,
    finder: Finder,
    options: MeasureOptions,
    site: SiteCalibration | None,
) -> tuple[Capture | None, tuple[Fruit, ...], list[Failure]]:
    if capture is None:
        return None, (), [failure] if failure else []
    try:
        if site is not None:
            from cucumbervision.pipeline.calibrated import calibrated_capture

            capture = calibrated_capture(capture, site)
        fruit, refused = measure_capture(capture, finder, options)
    except CucumberVisionError as error:
        return None, (), [_failure(capture.source, capture.name, error)]
    return capture, fruit, [_failure(capture.source, capture.name, error) for error in refused]


def count_captures(
    inputs: Sequence[Path], options: MeasureOptions, opener: Opener = open_source
) -> int | None:
    """Say how many captures the inputs hold; None where only reading them would tell."""
    total = 0
    for path in inputs:
        try:
            source = opener(path, options.reading)
        except CucumberVisionError:
            total += 1  # its failure is reported as one step
            continue
        if source.total is None:
            return None
        total += source.total
    return total


def _read_all(
    inputs: Sequence[Path], options: MeasureOptions, opener: Opener
) -> Iterator[tuple[Capture | None, Failure | None]]:
    taken: set[str] = set()
    for path in inputs:
        try:
            source = opener(path, options.reading)
        except CucumberVisionError as error:
            yield None, _failure(str(path), "", error)
            continue
        yield from _read_source(source, path, taken)


def _read_source(
    source: CaptureSource, path: Path, taken: set[str]
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
        yield replace(capture, name=unique_name(capture.name, taken)), None


def _failure(source: str, capture: str, error: CucumberVisionError) -> Failure:
    return Failure(source, capture, error.code, str(error))


def _write_overlay(
    path: Path, capture: Capture, fruit: Sequence[Fruit], rows: Sequence[dict[str, Cell]]
) -> None:
    import cv2

    from cucumbervision.pipeline.overlay import draw_overlay

    ok, data = cv2.imencode(".png", draw_overlay(capture, fruit, rows)[..., ::-1])
    if ok:
        path.write_bytes(data.tobytes())
