"""`cucumbervision stream`: frames in as they come, one JSON line a frame out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from cucumbervision.cli.choices import Fps, Quiet, Retries, Serial, measure_options, takes

if TYPE_CHECKING:
    from cucumbervision.pipeline.options import MeasureOptions

Source = Annotated[
    str,
    typer.Argument(
        metavar="SOURCE",
        help="camera (a RealSense D4xx), a .bag or .db3 recording, or a folder of captures.",
    ),
]
FastWay = Annotated[
    bool,
    typer.Option(
        "--fast",
        help="For speed: the detector's masks at 640 pixels, no SAM, no keypoints, half "
        "precision where the processor can, and one fruit measured a frame.",
    ),
]
Follow = Annotated[
    bool, typer.Option("--follow", help="Wait for what comes into a folder, from now on.")
]
EveryFrame = Annotated[
    bool,
    typer.Option("--every", help="Drop no frame of a recording or followed folder."),
]
Frames = Annotated[
    int | None, typer.Option(min=1, help="End after so many frames.", show_default=False)
]


@takes("options", measure_options, {"fast", "depth", "burst"})
def stream(
    source: Source,
    fast: FastWay = False,
    follow: Follow = False,
    every: EveryFrame = False,
    serial: Serial = None,
    fps: Fps = 15,
    retries: Retries = 3,
    frames: Frames = None,
    quiet: Quiet = False,
    *,
    options: MeasureOptions,
) -> None:
    """Measure frames as they come, the newest first, and know each fruit again.

    Every frame is one line of JSON on the standard output: when it was taken, how late the line
    is, how many frames were dropped, and its fruit with numbers that stay and lengths from all
    frames.
    """
    from cucumbervision.capture.realsense import CameraConfig
    from cucumbervision.cli.live import print_stream
    from cucumbervision.pipeline.measurer import Measurer
    from cucumbervision.streaming.sources import open_stream
    from cucumbervision.streaming.stream import FruitStream

    fruit = FruitStream.fast(options) if fast else FruitStream(Measurer(options))
    config = CameraConfig(serial=serial, fps=fps)
    arrivals = open_stream(
        source,
        options.reading,
        config=config,
        every=every,
        follow=follow,
        retries=retries,
    )
    raise typer.Exit(print_stream(fruit.follow(arrivals), frames, quiet=quiet))
