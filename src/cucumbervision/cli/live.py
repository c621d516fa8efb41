"""What the commands print that run until they are stopped: `stream` and `record`."""

from __future__ import annotations

import json
import os
import sys
import time
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape

from cucumbervision.errors import CameraError
from cucumbervision.pipeline.measurer import Failure, exit_code

if TYPE_CHECKING:
    from collections.abc import Iterator

    from cucumbervision.capture.recorder import Recorded
    from cucumbervision.errors import CucumberVisionError
    from cucumbervision.streaming.stream import StreamedFrame


def print_stream(
    frames: Iterator[StreamedFrame | Failure], most: int | None = None, *, quiet: bool = False
) -> int:
    """Print a stream's frames as JSON lines and return the exit code.

    Failures and a summary go to the standard error. The stream ends with its source, after `most`
    frames, on Ctrl-C, and when nobody reads the lines any more.
    """
    errors = Console(stderr=True, highlight=False)
    failures: list[Failure] = []
    count = dropped = 0
    began_s, busy_s = time.perf_counter(), time.process_time()
    try:
        for one in frames:
            if isinstance(one, Failure):
                failures.append(one)
                errors.print(f"[red]failed[/red] {escape(one.message)}", soft_wrap=True)
                continue
            if not count:
                # The networks are loaded and warm by now.
                began_s, busy_s = time.perf_counter(), time.process_time()
            sys.stdout.write(json.dumps(one.as_json(), ensure_ascii=False) + "\n")
            sys.stdout.flush()
            count, dropped = count + 1, dropped + one.dropped
            if count == most:
                break
    except KeyboardInterrupt:
        pass
    except BrokenPipeError:
        # Else Python flushes it once more as it ends, and complains.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except CameraError as error:
        failures.append(Failure.of(error, error.source))
        errors.print(f"[red]ended[/red] {escape(str(error))}", soft_wrap=True)
    if not quiet and count > 1:
        elapsed_s = time.perf_counter() - began_s
        each_ms = 1e3 * (time.process_time() - busy_s) / (count - 1)
        errors.print(
            f"{count} frames, {dropped} dropped, {(count - 1) / elapsed_s:.1f} frames/s after the "
            f"first, {each_ms:.0f} ms of processor time each"
        )
    return exit_code(count, failures)


def enter_keys(*, quiet: bool = False) -> Iterator[None]:
    """Yield at each line of the standard input: an Enter, or whatever a program sends."""
    if not quiet and sys.stdin.isatty():
        sys.stderr.write("Enter takes a capture, Ctrl-D ends\n")
    for _ in sys.stdin:
        yield None


def clock(every_s: float) -> Iterator[None]:
    """Yield now, and then every so many seconds; what took longer is not made up for."""
    due_s = time.monotonic()
    while True:
        time.sleep(max(due_s - time.monotonic(), 0.0))
        due_s = max(due_s, time.monotonic() - every_s) + every_s
        yield None


def print_recording(
    recorded: Iterator[Recorded | CucumberVisionError], *, quiet: bool = False
) -> int:
    """Print a line a capture that is written, and return the exit code."""
    errors, lines = Console(stderr=True, highlight=False), Console(quiet=quiet, highlight=False)
    failures: list[Failure] = []
    count = 0

    def failed(error: CucumberVisionError) -> None:
        failures.append(Failure.of(error, error.source))
        errors.print(f"[red]failed[/red] {escape(str(error))}", soft_wrap=True)

    try:
        for one in recorded:
            if isinstance(one, Exception):
                failed(one)
                continue
            count += 1
            quality = one.quality
            far = "" if quality.distance_m is None else f", {100 * quality.distance_m:.0f} cm"
            shown = f"{one.path.parent}  depth {100 * quality.fill:.0f} %{far}  {quality.advice}"
            lines.print(escape(shown), soft_wrap=True)
    except KeyboardInterrupt:
        pass
    except CameraError as error:
        failed(error)
    if not quiet:
        errors.print(f"{count} captures written, {len(failures)} failed")
    return exit_code(count, failures)
