"""`cucumbervision demo`: measure the captures that come with the package."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["demo"]


def demo(
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for tables and pictures.")
    ] = Path("cucumbervision-demo"),
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the rows as JSON instead of a table.")
    ] = False,
) -> None:
    """Measure the bundled simulated captures: found by the package's own networks, if it has any.

    Masks by MobileSAM, lengths by M1 to M6.
    """
    from cucumbervision.capture.source import bundled_captures
    from cucumbervision.cli.console import run_and_show
    from cucumbervision.perception.registry import load_registry
    from cucumbervision.pipeline.finders import demo_options

    options, line = demo_options(load_registry())
    if not (quiet or as_json):
        typer.echo(line)
    code = run_and_show([bundled_captures()], out, options, quiet=quiet, as_json=as_json)
    raise typer.Exit(code)
