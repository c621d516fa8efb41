"""The command `cucumbervision`: its sub-commands, error messages and exit codes.

Exit codes are in `cli.choices.exit_codes`.
"""

from __future__ import annotations

import logging
import sys
import traceback
from io import TextIOWrapper
from typing import Annotated

import typer

from cucumbervision._version import __version__
from cucumbervision.cli import live, measure, models, own_truth
from cucumbervision.cli.choices import EXIT_CODES, exit_codes
from cucumbervision.errors import InternalError, named_error
from cucumbervision.plugins import installed

_COMMANDS = "cucumbervision.commands"
"""Entry points of further commands: each is called with the program and its groups."""

app = typer.Typer(
    name="cucumbervision",
    help="Measure greenhouse cucumbers without touching them, from RGB-D images.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.command("measure", epilog=EXIT_CODES)(measure.measure)
app.command("detect", epilog=exit_codes("every image was read"))(measure.detect)
app.command("stream", epilog=exit_codes("the stream ended or was stopped", "a frame failed"))(
    live.stream
)
app.command("record", epilog=exit_codes("every capture was written", "one failed"))(live.record)
app.command("cameras")(live.cameras)
app.command("demo", epilog=EXIT_CODES)(measure.demo)
app.command("serve")(live.serve)
app.command("schema")(live.schema)
app.command("calibrate")(own_truth.calibrate)
_GROUPS = {"crop": models.crops, "models": models.app}
for _name, _group in _GROUPS.items():
    app.add_typer(_group, name=_name)
for _further in installed(_COMMANDS):
    _further.load()(app, _GROUPS)


def _show_version(is_asked: bool) -> None:
    if is_asked:
        from cucumbervision.tube.compiled import kernel_name

        typer.echo(f"cucumbervision {__version__} (kernel: {kernel_name()})")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    """Measure greenhouse cucumbers without touching them, from RGB-D images."""


def main() -> None:
    """Run the command line; the console script's entry point."""
    for output in (sys.stdout, sys.stderr):
        if isinstance(output, TextIOWrapper):  # print question marks on a console that is not UTF-8
            output.reconfigure(errors="replace")
    logging.basicConfig(level=logging.WARNING, format="cucumbervision: %(message)s")
    try:
        app()
    except KeyboardInterrupt:
        sys.stderr.write(
            "cucumbervision: interrupted; finished captures are in the output folder\n"
        )
        sys.exit(130)
    except Exception as error:
        named = named_error(error)
        if isinstance(named, InternalError):
            traceback.print_exc()
        sys.stderr.write(f"cucumbervision: {named}\n")
        sys.exit(70 if isinstance(named, InternalError) else 2)
