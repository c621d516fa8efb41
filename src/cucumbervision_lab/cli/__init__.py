"""Commands of the laboratory, registered through an entry point."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    import typer

__all__ = ["register"]


def register(program: typer.Typer, groups: Mapping[str, typer.Typer]) -> None:
    """Register the laboratory's commands.

    Parameters
    ----------
    program : typer.Typer
        The command `cucumbervision`.
    groups : mapping of str to typer.Typer
        Its command groups; `evaluate` gets two commands.
    """
    from cucumbervision_lab.cli import data, evaluate, train

    program.command("benchmark")(evaluate.benchmark)
    program.command("synth")(data.synth)
    program.add_typer(data.app, name="data")
    program.add_typer(train.app, name="train")
    groups["evaluate"].command("models")(evaluate.evaluate_models)
    groups["evaluate"].command("photos")(evaluate.evaluate_photos)
