"""`cucumbervision record`: captures of a live camera into a folder, without a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import typer

from cucumbervision.cli.choices import Burst, Quiet, Retries, Serial

Preset: TypeAlias = Literal["default", "hand", "high-accuracy", "high-density", "medium-density"]


Out = Annotated[Path, typer.Argument(metavar="OUT", help="Gets a folder a capture.")]
FilledFolder = Annotated[
    Path | None,
    typer.Option(
        "--from",
        help="A folder that another program fills, in the camera's place.",
        show_default=False,
    ),
]
Every = Annotated[
    float | None,
    typer.Option(min=0.0, help="Seconds from one capture to the next; else Enter takes one."),
]
Count = Annotated[int | None, typer.Option(min=1, help="End after so many.", show_default=False)]
RowName = Annotated[str | None, typer.Option(help="Row in the house.")]
Side = Annotated[str | None, typer.Option(help="Side of the row: left or right.")]
Position = Annotated[float | None, typer.Option(help="Metres along the row of the first capture.")]
Step = Annotated[float, typer.Option(help="Metres from one capture to the next.")]
CapturesName = Annotated[str, typer.Option(help="What the captures are called.")]
DepthPreset = Annotated[
    Preset | None, typer.Option(help="The depth camera's preset; its own without.")
]
Exposure = Annotated[
    float | None,
    typer.Option(min=1, help="Colour exposure in microseconds; automatic without."),
]


def record(
    out: Out,
    serial: Serial = None,
    folder: FilledFolder = None,
    every: Every = None,
    count: Count = None,
    burst: Burst = 5,
    row: RowName = None,
    side: Side = None,
    position: Position = None,
    step: Step = 0.0,
    name: CapturesName = "capture",
    preset: DepthPreset = None,
    exposure: Exposure = None,
    retries: Retries = 3,
    quiet: Quiet = False,
) -> None:
    """Write captures of a live camera: one at each Enter, or every so many seconds.

    What is written is read by `cucumbervision measure` and every other command.
    """
    from itertools import islice

    from cucumbervision.capture.camera import FolderCamera, RgbdCamera
    from cucumbervision.capture.realsense import CameraConfig, RealSenseCamera
    from cucumbervision.capture.realsense_device import CameraSettings
    from cucumbervision.capture.recorder import Walk, record_captures
    from cucumbervision.cli.live import clock, enter_keys, print_recording

    config = CameraConfig(serial, fps=15, burst=burst, settings=CameraSettings(preset, exposure))

    def open_camera() -> RgbdCamera:
        return RealSenseCamera(config) if folder is None else FolderCamera(folder)

    signals = clock(every) if every is not None else enter_keys(quiet=quiet)
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
    """List the RealSense cameras that are plugged in, with their serial numbers."""
    from cucumbervision.capture.realsense_device import list_cameras
    from cucumbervision.cli.console import columns_table, screen

    found = list_cameras()
    if not found:
        typer.echo("No RealSense camera is connected; plug a D4xx into a USB 3 port")
        raise typer.Exit(2)
    table = columns_table(None, ["camera", "serial number", "firmware", "USB"])
    for one in found:
        table.add_row(one.name, one.serial, one.firmware, one.usb)
    screen().print(table)
