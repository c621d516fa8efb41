"""`cucumbervision faults`: faults on purpose, and what comes of them."""

from __future__ import annotations

from typing import Annotated

import typer


def faults(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            help="truncated, flipped, folder, disk, permission, unreadable, worker, measure, s3, "
            "postgres, camera, clock; all without one."
        ),
    ] = None,
    kills: Annotated[
        int, typer.Option(min=0, help="How often `round add` is killed with signal 9 besides.")
    ] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Of the moments of the kills.")] = 1,
) -> None:
    """Do the software harm; print what the user sees and what is left.

    Exit code 1 tells that something is lost. Everything happens in folders of its own; the full
    disk is a small file system in memory, which needs root; PostgreSQL and S3 are servers of their
    own on loopback, of which S3 goes for a minute.
    """
    from cucumbervision.accuracy.page import Table
    from cucumbervision_lab.cli.screen import show_tables, ticking
    from cucumbervision_lab.robustness.faults import FAULTS, try_faults

    chosen = names or list(FAULTS)
    with ticking("doing harm", len(chosen) + kills) as tick:
        found = try_faults(chosen, kills, seed, tick)
    rows = [(o.fault, o.seen, o.kept, "LOST" if o.lost else "no") for o in found]
    heads = ["fault", "what the user sees", "what is there", "lost"]
    show_tables([Table.of("Faults", heads, rows, "")])
    raise typer.Exit(1 if any(one.lost for one in found) else 0)
