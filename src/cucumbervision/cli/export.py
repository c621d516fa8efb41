"""`cucumbervision export`: a round as CSV, Excel, Parquet, JSON and a page to print."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

__all__ = ["export"]


class FormatChoice(StrEnum):
    """Values of `--format`."""

    csv = "csv"
    xlsx = "xlsx"
    parquet = "parquet"
    json = "json"
    html = "html"


def export(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the files.")],
    round_: Annotated[
        str,
        typer.Argument(metavar="[ROUND]", help="Name, key or start of a key; the newest without."),
    ] = "",
    store: Annotated[
        str,
        typer.Option(
            "--store", envvar="CUCUMBERVISION_STORE", help="SQLite file, or postgresql://… address."
        ),
    ] = "house.db",
    images: Annotated[
        Path | None, typer.Option(help="Folder of the pictures; needed with PostgreSQL.")
    ] = None,
    formats: Annotated[
        list[FormatChoice] | None,
        typer.Option("--format", "-f", help="Repeat for several; csv, xlsx, json without."),
    ] = None,
    profile: Annotated[
        str | None, typer.Option(help="Crop profile; by default the round's own.")
    ] = None,
    days: Annotated[int, typer.Option(min=0, max=31, help="Days of the forecast.")] = 7,
    pictures: Annotated[
        bool, typer.Option("--pictures/--no-pictures", help="Copy the small pictures along.")
    ] = True,
) -> None:
    """Write a round: summary, fruit, stops, forecast, pick list; with the hashes it rests on."""
    from cucumbervision.agronomy.profiles import load_profile
    from cucumbervision.exports.build import round_tables
    from cucumbervision.exports.writers import ExportFormat, write_exports
    from cucumbervision.rounds.service import find_round
    from cucumbervision.store.repository import open_store

    usual = [FormatChoice.csv, FormatChoice.xlsx, FormatChoice.json]
    wanted = [ExportFormat(one.value) for one in formats or usual]
    with open_store(store, images=images, create=False) as opened:
        view = find_round(opened, round_)
        name = profile or view.record.profile
        tables = round_tables(
            opened,
            view.key,
            load_profile(name) if name else None,
            profile_name=name,
            days=days,
            pictures=pictures,
        )
        for path in write_exports(tables, out, wanted):
            typer.echo(path)
    if tables.note:
        typer.echo(f"no forecast: {tables.note}", err=True)
