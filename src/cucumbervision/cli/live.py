"""What the commands print that run until they are stopped: `stream` and `record`."""

from __future__ import annotations

import json
import sys
import time
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape

from cucumbervision.errors import CameraError
from cucumbervision.pipeline.measurer import Failure, exit_code

if TYPE_CHECKING:
    from collections.abc import Iterator

    from cucumbervision.streaming.stream import StreamedFrame

__all__ = ["print_stream"]


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
        sys.stdout = None  # type: ignore[assignment] - else it is flushed again at exit
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
