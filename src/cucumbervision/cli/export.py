"""`cucumbervision export`: a round as CSV, Excel, Parquet, JSON and a page to print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cucumbervision.cli.choices import Images, Profile, StoreName
from cucumbervision.cli.round import chosen_profile, opened_round
from cucumbervision.exports import ExportFormat


def export(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the files.")],
    round_: Annotated[
        str,
        typer.Argument(metavar="[ROUND]", help="Name, key or start of a key; the newest without."),
    ] = "",
    store: StoreName = "house.db",
    images: Images = None,
    formats: Annotated[
        list[ExportFormat] | None,
        typer.Option("--format", "-f", help="Repeat for several; csv, xlsx, json without."),
    ] = None,
    profile: Profile = None,
) -> None:
    """Write a round: summary, fruit, stops, forecast, pick list; with the hashes it rests on."""
    from cucumbervision.exports.build import round_tables
    from cucumbervision.exports.writers import write_exports

    usual = [ExportFormat.CSV, ExportFormat.XLSX, ExportFormat.JSON]
    with opened_round(store, round_, images) as (opened, one):
        tables = round_tables(
            opened,
            one.key,
            chosen_profile(profile, one),
            profile_name=profile or one.record.profile,
        )
        for path in write_exports(tables, out, formats or usual):
            typer.echo(path)
    if tables.note:
        typer.echo(f"no forecast: {tables.note}", err=True)
