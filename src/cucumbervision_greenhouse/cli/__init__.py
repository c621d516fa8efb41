"""Commands of the greenhouse, registered through an entry point."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    import typer

__all__ = ["register"]


def register(program: typer.Typer, groups: Mapping[str, typer.Typer]) -> None:  # noqa: ARG001
    """Register the greenhouse's commands.

    Parameters
    ----------
    program : typer.Typer
        The command `cucumbervision`.
    groups : mapping of str to typer.Typer
        Its command groups.
    """
    from cucumbervision_greenhouse.cli import dashboard, round

    program.command("dashboard")(dashboard.dashboard)
    program.command("export")(round.export)
    program.add_typer(round.app, name="round")
