"""CSV, JSON and Parquet of a round, and all formats at once."""

from __future__ import annotations

import json
import shutil
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cucumbervision.errors import CucumberVisionError, MissingExtraError
from cucumbervision.pipeline.exports import CsvSink, write_json

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from cucumbervision.exports.tables import RoundTables, Table

__all__ = ["ExportFormat", "write_csv", "write_exports", "write_json_round", "write_parquet"]


class ExportFormat(StrEnum):
    """What a round can be written as."""

    CSV = "csv"
    XLSX = "xlsx"
    PARQUET = "parquet"
    JSON = "json"
    HTML = "html"


def write_exports(
    tables: RoundTables, out: Path, formats: Collection[ExportFormat] = tuple(ExportFormat)
) -> list[Path]:
    """Write a round in one or more formats; what is there already is written anew.

    Parameters
    ----------
    tables : RoundTables
        The round.
    out : Path
        Folder; made if it is missing. Small pictures go into `pictures/` in it.
    formats : collection of ExportFormat
        Which.

    Returns
    -------
    list of Path
        The files, without the pictures.

    Raises
    ------
    MissingExtraError
        If a format needs a package that is not installed.
    CucumberVisionError
        If the folder cannot be written.
    """
    from cucumbervision.exports.sheet import write_sheet
    from cucumbervision.exports.workbook import write_round_workbook

    writers: dict[ExportFormat, Callable[[RoundTables, Path], list[Path]]] = {
        ExportFormat.CSV: write_csv,
        ExportFormat.XLSX: write_round_workbook,
        ExportFormat.PARQUET: write_parquet,
        ExportFormat.JSON: write_json_round,
        ExportFormat.HTML: write_sheet,
    }
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, path in tables.pictures.items():
            (out / name).parent.mkdir(exist_ok=True)
            shutil.copyfile(path, out / name)
        return [
            path for one in ExportFormat if one in formats for path in writers[one](tables, out)
        ]
    except OSError as error:
        raise CucumberVisionError(
            f"cannot be written ({error.strerror or error})",
            source=out,
            remedy="choose another folder, and close its files elsewhere",
        ) from None


def write_csv(tables: RoundTables, out: Path) -> list[Path]:
    """Write each table as CSV: UTF-8, commas, decimal points; texts defused."""
    paths = []
    for table in tables.tables.values():
        paths.append(out / f"{table.name}.csv")
        with CsvSink(paths[-1], [column.name for column in table.columns]) as sink:
            for record in table.records():
                sink.write(record)
    return paths


def write_json_round(tables: RoundTables, out: Path) -> list[Path]:
    """Write all tables as one JSON file, with the columns' units and meaning."""
    path = out / "round.json"
    write_json(
        path,
        {
            "format": "cucumbervision-round",
            "version": 1,
            **tables.provenance,
            "note": tables.note,
            "columns": {name: _columns(table) for name, table in tables.tables.items()},
            "tables": {name: table.records() for name, table in tables.tables.items()},
        },
    )
    return [path]


def _columns(table: Table) -> list[dict[str, str]]:
    return [{"name": c.name, "unit": c.unit, "type": c.type, "says": c.says} for c in table.columns]


def write_parquet(tables: RoundTables, out: Path) -> list[Path]:
    """Write each table as Parquet; units and meaning with the columns, hashes with the file.

    Raises
    ------
    MissingExtraError
        If pyarrow is not installed.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ModuleNotFoundError:
        raise MissingExtraError("pyarrow", "export") from None
    kinds: dict[str, Any] = {
        "text": pa.string(),
        "whole": pa.int64(),
        "number": pa.float64(),
        "yes/no": pa.bool_(),
    }
    about = {"cucumbervision": json.dumps(dict(tables.provenance), ensure_ascii=False)}
    paths = []
    for table in tables.tables.values():
        schema = pa.schema(
            [
                pa.field(c.name, kinds[c.type], metadata={"unit": c.unit, "says": c.says})
                for c in table.columns
            ],
            metadata=about,
        )
        paths.append(out / f"{table.name}.parquet")
        pq.write_table(pa.Table.from_pylist(table.records(), schema=schema), paths[-1])
    return paths
