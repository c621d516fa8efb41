"""`cucumbervision detect`: plain pictures in, cucumbers found."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cucumbervision.cli.choices import Quiet, measure_options, takes

if TYPE_CHECKING:
    from cucumbervision.pipeline.options import MeasureOptions

_MEASURING = {
    *("methods", "selector", "length", "calibration", "profile"),
    *("intrinsics", "depth", "depth_unit", "burst"),
}


@takes("options", measure_options, _MEASURING)
def detect(
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="IMAGE...",
            help="Pictures (JPEG, PNG, WebP, TIFF, BMP), or folders of them.",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for results and pictures.")],
    quiet: Quiet = False,
    *,
    options: MeasureOptions,
) -> None:
    """Find cucumbers in plain pictures: boxes, masks and keypoints, no lengths."""
    from cucumbervision.cli.console import detect_and_show

    raise typer.Exit(detect_and_show(inputs, out, options, quiet=quiet))
