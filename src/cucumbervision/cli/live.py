"""`cucumbervision stream`, `record`, `cameras`, `serve` and `schema`."""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, TypeVar

import typer

from cucumbervision.cli import choices
from cucumbervision.errors import CameraError, CucumberVisionError, MissingExtraError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from cucumbervision.capture.camera import Recorded
    from cucumbervision.run.measurer import Failure
    from cucumbervision.run.options import MeasureOptions
    from cucumbervision.stream.fruit_stream import StreamedFrame


T = TypeVar("T")


def _without_failures(
    arrivals: Iterator[T | Failure | CucumberVisionError], failures: list[Failure]
) -> Iterator[T]:
    """Yield what arrives until Ctrl-C or the loss of the camera; failures are printed and kept."""
    from cucumbervision.cli.console import plain_console
    from cucumbervision.run.measurer import Failure

    errors = plain_console(stderr=True)
    try:
        for arrival in arrivals:
            if isinstance(arrival, Failure | CucumberVisionError):
                if isinstance(arrival, CucumberVisionError):
                    arrival = Failure.of(arrival, arrival.source)
                failures.append(arrival)
                errors.print(f"failed {arrival.message}", soft_wrap=True)
            else:
                yield arrival
    except KeyboardInterrupt:
        pass
    except CameraError as error:
        failures.append(Failure.of(error, error.source))
        errors.print(f"ended {error}", soft_wrap=True)


def print_stream(
    frames: Iterator[StreamedFrame | Failure],
    most_frames: int | None = None,
    *,
    quiet: bool = False,
) -> int:
    """Print a stream's frames as JSON lines and return the exit code.

    Failures and a summary go to the standard error. The stream ends with its source, after
    `most_frames` frames, on Ctrl-C, and when its output is closed.
    """
    from cucumbervision.cli.console import plain_console
    from cucumbervision.run.measurer import exit_code

    failures: list[Failure] = []
    count = dropped = 0
    began_s, busy_s = time.perf_counter(), time.process_time()
    try:
        for frame in _without_failures(frames, failures):
            if not count:
                # The networks are loaded and warm by now.
                began_s, busy_s = time.perf_counter(), time.process_time()
            sys.stdout.write(json.dumps(frame.as_json()) + "\n")
            sys.stdout.flush()
            count, dropped = count + 1, dropped + frame.dropped
            if count == most_frames:
                break
    except BrokenPipeError:
        # Otherwise Python flushes it again at exit and prints an error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if not quiet and count > 1:
        elapsed_s = time.perf_counter() - began_s
        each_ms = 1e3 * (time.process_time() - busy_s) / (count - 1)
        plain_console(stderr=True).print(
            f"{count} frames, {dropped} dropped, {(count - 1) / elapsed_s:.1f} frames/s after the "
            f"first, {each_ms:.0f} ms of processor time each"
        )
    return exit_code(count, failures)


def enter_keys(*, quiet: bool = False) -> Iterator[None]:
    """Yield at each line of the standard input, from the keyboard or a program."""
    if not quiet and sys.stdin.isatty():
        sys.stderr.write("Press Enter for a capture, Ctrl-D to stop\n")
    for _ in sys.stdin:
        yield None


def clock(every_s: float) -> Iterator[None]:
    """Yield now and then at fixed intervals; delays are not caught up."""
    due_s = time.monotonic()
    while True:
        time.sleep(max(due_s - time.monotonic(), 0.0))
        now_s = time.monotonic()
        due_s = due_s + every_s if due_s + every_s > now_s else now_s + every_s
        yield None


def print_recording(
    recorded: Iterator[Recorded | CucumberVisionError], *, quiet: bool = False
) -> int:
    """Print a line for each written capture, and return the exit code."""
    from cucumbervision.cli.console import plain_console
    from cucumbervision.run.measurer import exit_code

    lines, failures, count = plain_console(quiet=quiet), list["Failure"](), 0
    for recording in _without_failures(recorded, failures):
        count += 1
        quality = recording.quality
        distance = "" if quality.distance_m is None else f", {100 * quality.distance_m:.0f} cm"
        fill = f"depth {100 * quality.fill:.0f} %{distance}"
        lines.print(f"{recording.path.parent}  {fill}  {quality.advice}", soft_wrap=True)
    if not quiet:
        errors = plain_console(stderr=True)
        errors.print(f"{count} captures written, {len(failures)} failed")
    return exit_code(count, failures)


Serial = Annotated[str | None, typer.Option(help="The camera's serial number; default: any.")]
Retries = Annotated[int, typer.Option(min=0, help="Attempts to reconnect to a lost camera.")]
Preset: TypeAlias = Literal["default", "hand", "high-accuracy", "high-density", "medium-density"]


@choices.takes("options", choices.measure_options, {"depth", "burst"} | choices.OF_CAMERA_FILE)
def stream(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help="camera (a RealSense D4xx), a .bag or .db3 recording, or a folder of captures.",
        ),
    ],
    fast: Annotated[
        bool,
        typer.Option(
            "--fast", help="Masks at 640 pixels, no SAM or keypoints, one fruit measured a frame."
        ),
    ] = False,
    follow: Annotated[
        bool, typer.Option("--follow", help="Wait for new captures in a folder.")
    ] = False,
    every_frame: Annotated[
        bool, typer.Option("--every", help="Drop no frame of a recording or followed folder.")
    ] = False,
    serial: Serial = None,
    fps: Annotated[int, typer.Option(min=1, max=90, help="Frame rate of the camera.")] = 15,
    retries: Retries = 3,
    frames: Annotated[
        int | None, typer.Option(min=1, help="Number of frames.", show_default=False)
    ] = None,
    quiet: choices.Quiet = False,
    *,
    options: MeasureOptions,
) -> None:
    """Measure the newest frames of a camera or recording, and track each fruit.

    Each frame is one line of JSON on the standard output: time, delay, number of dropped frames,
    and its fruit with permanent numbers and lengths from all frames.
    """
    from cucumbervision.capture.realsense import CameraConfig
    from cucumbervision.run.measurer import Measurer
    from cucumbervision.stream.fruit_stream import FruitStream, open_stream

    fruit = FruitStream.fast(options) if fast else FruitStream(Measurer(options))
    config = CameraConfig(serial=serial, fps=fps)
    arrivals = open_stream(
        source,
        options.reading,
        config=config,
        every_frame=every_frame,
        follow=follow,
        retries=retries,
    )
    raise typer.Exit(print_stream(fruit.follow(arrivals), frames, quiet=quiet))


def record(
    out: Annotated[
        Path,
        typer.Argument(metavar="OUT", help="Output folder; each capture gets a folder of its own."),
    ],
    serial: Serial = None,
    folder: Annotated[
        Path | None,
        typer.Option("--from", help="Folder that another program fills.", show_default=False),
    ] = None,
    every_s: Annotated[
        float | None, typer.Option(min=0.0, help="Seconds between captures; default: by Enter.")
    ] = None,
    count: Annotated[
        int | None, typer.Option(min=1, help="Number of captures.", show_default=False)
    ] = None,
    burst: choices.Burst = 5,
    row: Annotated[str | None, typer.Option(help="Row in the house.")] = None,
    side: Annotated[str | None, typer.Option(help="Side of the row: left or right.")] = None,
    position: Annotated[
        float | None, typer.Option(help="Metres along the row of the first capture.")
    ] = None,
    step: Annotated[float, typer.Option(help="Metres from one capture to the next.")] = 0.0,
    name: Annotated[str, typer.Option(help="Prefix of the captures' names.")] = "capture",
    preset: Annotated[
        Preset | None, typer.Option(help="Preset of the depth camera; default: the current one.")
    ] = None,
    exposure: Annotated[
        float | None,
        typer.Option(min=1, help="Colour exposure in microseconds; default: automatic."),
    ] = None,
    retries: Retries = 3,
    quiet: choices.Quiet = False,
) -> None:
    """Save captures of a live camera: one for each Enter, or at fixed intervals.

    Every command reads the saved captures.
    """
    from itertools import islice

    from cucumbervision.capture.camera import FolderCamera, RgbdCamera, Walk, record_captures
    from cucumbervision.capture.realsense import CameraConfig, CameraSettings, RealSenseCamera

    config = CameraConfig(serial, fps=15, burst=burst, settings=CameraSettings(preset, exposure))

    def open_camera() -> RgbdCamera:
        return RealSenseCamera(config) if folder is None else FolderCamera(folder)

    signals = clock(every_s) if every_s is not None else enter_keys(quiet=quiet)
    recorded = record_captures(
        open_camera,
        out,
        islice(signals, count),
        Walk(row, side, position, step),
        name=name,
        retries=retries,
    )
    raise typer.Exit(print_recording(recorded, quiet=quiet))


def cameras() -> None:
    """List the connected RealSense cameras with their serial numbers."""
    from cucumbervision.capture.realsense import list_cameras
    from cucumbervision.cli.console import columns_table, screen

    devices = list_cameras()
    if not devices:
        typer.echo("No RealSense camera is connected; plug a D4xx into a USB 3 port")
        raise typer.Exit(2)
    table = columns_table(None, ["camera", "serial number", "firmware", "USB"])
    for device in devices:
        table.add_row(device.name, device.serial, device.firmware, device.usb)
    screen().print(table)


@choices.takes("options", choices.measure_options, {"depth"} | choices.OF_CAMERA_FILE)
def serve(
    address: choices.ListenOn = "127.0.0.1",
    port: choices.Port = 8600,
    most_mb: Annotated[
        int, typer.Option("--max-mb", min=1, help="Maximum size of a request, megabytes.")
    ] = 200,
    waiting: Annotated[int, typer.Option(min=0, help="Maximum number of waiting requests.")] = 8,
    *,
    options: MeasureOptions,
) -> None:
    """Serve POST /measure and POST /detect, /health and /metrics. Needs the extra 'serve'.

    If the environment variable CUCUMBERVISION_TOKEN is set, requests must contain this token. It is
    required for addresses that other machines can reach.
    """
    from importlib.util import find_spec

    from cucumbervision.access import TOKEN_VARIABLE, check_access
    from cucumbervision.run.measurer import Measurer

    for package in ("fastapi", "uvicorn", "prometheus_client", "python_multipart"):
        if find_spec(package) is None:
            raise MissingExtraError(package.replace("_", "-"), "serve")
    token = os.environ.get(TOKEN_VARIABLE, "")
    check_access(address, token)
    from cucumbervision.service.app import ServiceSettings, create_app, request_limits
    from cucumbervision.service.requests import listen

    measurer = Measurer(options)
    measurer.warm_up()
    service = create_app(measurer, ServiceSettings(token, request_limits(most_mb), waiting))
    words = f"http://{address}:{port} (Ctrl-C ends)"
    listen(service, address, port, ready=lambda: typer.echo(words, err=True))


def schema(
    kind: Annotated[
        Literal["stream", "measure", "detect"],
        typer.Argument(help="A line of stream; or the reply to /measure or /detect."),
    ],
) -> None:
    """Print the JSON Schema of a stream's line or a reply of the service."""
    from cucumbervision.service.app import DetectReply, MeasureReply
    from cucumbervision.stream.fruit_stream import line_model

    models: dict[str, Any] = {
        "stream": line_model(),
        "measure": MeasureReply,
        "detect": DetectReply,
    }
    typer.echo(json.dumps(models[kind].model_json_schema(mode="serialization"), indent=1))
