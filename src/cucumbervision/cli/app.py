"""The command `cucumbervision`: its sub-commands, and how errors and exit codes come out.

Exit codes: 0 every input could be read, even if a fruit could not be measured; 1 some input could
not be read, the others were measured; 2 the command could not be carried out at all (a wrong
option, a missing model, a folder that cannot be written); 130 interrupted.
"""

from __future__ import annotations

import logging
import sys
from importlib.metadata import entry_points
from typing import Annotated

import typer

from cucumbervision._version import __version__
from cucumbervision.cli import (
    calibrate,
    dashboard,
    demo,
    detect,
    evaluate,
    export,
    measure,
    models,
    round,
)
from cucumbervision.errors import CucumberVisionError

__all__ = ["app", "main"]

_COMMANDS = "cucumbervision.commands"
"""Entry points of further commands: each is called with the program and its groups."""

app = typer.Typer(
    name="cucumbervision",
    help="Measure greenhouse cucumbers without touching them, from RGB-D pictures.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.command("measure", epilog=measure.EPILOG)(measure.measure)
app.command("detect", epilog=detect.EPILOG)(detect.detect)
app.command("demo")(demo.demo)
app.command("calibrate")(calibrate.calibrate)
app.command("export")(export.export)
_GROUPS = {
    "dashboard": dashboard.app,
    "evaluate": evaluate.app,
    "models": models.app,
    "round": round.app,
}
for _name, _group in _GROUPS.items():
    app.add_typer(_group, name=_name)
for _further in entry_points(group=_COMMANDS):
    _further.load()(app, _GROUPS)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"cucumbervision {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    """Measure greenhouse cucumbers without touching them, from RGB-D pictures."""


def main() -> None:
    """Run the command line; the console script's entry point."""
    logging.basicConfig(level=logging.WARNING, format="cucumbervision: %(message)s")
    try:
        app()
    except CucumberVisionError as error:
        sys.stderr.write(f"cucumbervision: {error}\n")
        sys.exit(2)
    except KeyboardInterrupt:
        sys.stderr.write("cucumbervision: interrupted; what was measured is in the output folder\n")
        sys.exit(130)
