"""`cucumbervision measure` and `demo`: RGB-D captures in, lengths out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from cucumbervision.capture.urls import as_path
from cucumbervision.cli.choices import AsJson, Crop, Methods, Quiet, takes_measure_options

if TYPE_CHECKING:
    from cucumbervision.pipeline.options import MeasureOptions

Inputs = Annotated[
    list[Path],
    typer.Argument(
        metavar="INPUT...",
        parser=as_path,
        help="Capture folders, BOP scenes, colour + depth pairs, Viewer exports, .bag or .db3; or "
        "URLs of such (s3://…, https://…).",
    ),
]
Guard = Annotated[
    bool,
    typer.Option(
        "--guard", help="Play recordings from untrusted senders in a separate, limited process."
    ),
]
Fresh = Annotated[
    bool,
    typer.Option(
        "--fresh",
        help="Measure everything anew; what the output folder holds is put aside in earlier/.",
    ),
]
Parquet = Annotated[
    bool, typer.Option("--parquet", help="Write the rows as Parquet, too, in parts (parquet/).")
]
EngineName = Annotated[
    Literal["local", "ray"],
    typer.Option(help="Where captures are measured: this machine, or a Ray cluster."),
]
Workers = Annotated[
    int,
    typer.Option(min=0, help="Processes that measure; by default 1, or with Ray one a CPU."),
]
Address = Annotated[
    str, typer.Option(help="Address of the Ray cluster; without it one is started here.")
]
Out = Annotated[
    Path,
    typer.Option(
        "--out",
        "-o",
        metavar="PLACE",
        parser=as_path,
        help="Folder or URL for tables and pictures.",
    ),
]


@takes_measure_options("methods", "profile")
def measure(
    inputs: Inputs,
    out: Out,
    methods: Methods = "",
    profile: Crop = "long-cucumber",
    guard: Guard = False,
    workers: Workers = 0,
    engine: EngineName = "local",
    address: Address = "",
    fresh: Fresh = False,
    parquet: Parquet = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
    *,
    options: MeasureOptions,
) -> None:
    """Measure every fruit of every capture, by M1 to M6, and choose the best for each.

    Rerun the command to resume: only captures that are missing or affected by other options or
    networks are measured.
    """
    from cucumbervision.agronomy.profiles import load_profile
    from cucumbervision.capture.readers import open_source
    from cucumbervision.cli.console import measure_and_show
    from cucumbervision.intake.recordings import open_guarded
    from cucumbervision.pipeline.batch import choose_engine
    from cucumbervision.pipeline.options import parse_methods
    from cucumbervision.pipeline.run import BatchOptions

    opener = open_guarded if guard else open_source
    where = choose_engine(engine, workers, address)
    batch = BatchOptions(fresh, parquet, opener=opener, engine=where)
    accepted_m = load_profile(profile).accepted_m
    options = replace(options, methods=parse_methods(methods or "all"), accepted_m=accepted_m)
    code = measure_and_show(
        inputs,
        out,
        options,
        batch,
        quiet=quiet,
        as_json=as_json,
        profile=profile,
        by_method=bool(methods),
    )
    raise typer.Exit(code)


def demo(
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for tables and pictures.")
    ] = Path("cucumbervision-demo"),
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Measure the bundled simulated captures: found by the package's own networks, if it has any.

    Masks by MobileSAM, lengths by M1 to M6.
    """
    from cucumbervision.capture.source import example_captures
    from cucumbervision.cli.console import measure_and_show
    from cucumbervision.perception.registry import load_registry
    from cucumbervision.pipeline.finders import demo_options
    from cucumbervision.pipeline.run import BatchOptions

    options, line = demo_options(load_registry())
    if not (quiet or as_json):
        typer.echo(line)
    batch = BatchOptions()
    code = measure_and_show([example_captures()], out, options, batch, quiet=quiet, as_json=as_json)
    raise typer.Exit(code)
