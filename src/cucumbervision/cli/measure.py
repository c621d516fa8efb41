"""`cucumbervision measure`, `demo` and `detect`: captures or plain images in, fruit out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from cucumbervision.cli.choices import OF_CAMERA_FILE, Quiet, loop_options, measure_options, takes
from cucumbervision.files import as_path

if TYPE_CHECKING:
    from cucumbervision.run.batch import LoopOptions
    from cucumbervision.run.options import MeasureOptions


Inputs = Annotated[
    list[Path],
    typer.Argument(
        metavar="INPUT...",
        parser=as_path,
        help="Capture folders, BOP scenes, colour + depth pairs, Viewer exports, .bag or .db3; or "
        "URLs of such (s3://…, https://…).",
    ),
]
Out = Annotated[
    Path,
    typer.Option(
        "--out", "-o", metavar="PLACE", parser=as_path, help="Folder or URL for tables and images."
    ),
]


@takes("options", measure_options)
@takes("loop", loop_options)
def measure(
    inputs: Inputs,
    out: Out,
    parquet: Annotated[
        bool, typer.Option("--parquet", help="Write the rows as Parquet, too, in parts (parquet/).")
    ] = False,
    overlays: Annotated[
        Literal["png", "jpg", "none"],
        typer.Option(help="Kind of the annotated images; jpg takes a tenth of png's time."),
    ] = "png",
    quiet: Quiet = False,
    *,
    methods: str,
    profile: str,
    options: MeasureOptions,
    loop: LoopOptions,
) -> None:
    """Measure every fruit of every capture, by M1 to M6, and choose the best for each.

    Rerun the command to resume: only captures that are missing or affected by other options or
    networks are measured.
    """
    from cucumbervision.cli.console import measure_and_show
    from cucumbervision.run.whole_run import BatchOptions

    batch = BatchOptions(**vars(loop), parquet=parquet, overlays=overlays)
    code = measure_and_show(
        inputs, out, options, batch, quiet=quiet, profile=profile, by_method=bool(methods)
    )
    raise typer.Exit(code)


def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for tables and images.")] = Path(
        "cucumbervision-demo"
    ),
    quiet: Quiet = False,
) -> None:
    """Measure the bundled simulated captures, found by the package's own networks."""
    from cucumbervision.capture.source import example_captures
    from cucumbervision.cli.console import measure_and_show
    from cucumbervision.run.options import MeasureOptions
    from cucumbervision.run.whole_run import BatchOptions

    options, batch = MeasureOptions(instances="models"), BatchOptions()
    raise typer.Exit(measure_and_show([example_captures()], out, options, batch, quiet=quiet))


_MEASURING = {
    *("methods", "selector", "length", "calibration", "profile"),
    *("intrinsics", "depth", "burst"),
    *OF_CAMERA_FILE,
}


@takes("options", measure_options, _MEASURING)
def detect(
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="IMAGE...", help="Images (JPEG, PNG, WebP, TIFF, BMP), or folders of them."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for results and images.")],
    quiet: Quiet = False,
    *,
    options: MeasureOptions,
) -> None:
    """Find cucumbers in plain images: boxes, masks and keypoints, no lengths."""
    from cucumbervision.cli.console import detect_and_show

    raise typer.Exit(detect_and_show(inputs, out, options, quiet=quiet))
