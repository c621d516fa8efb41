"""A run's tables, made from the journal: each appears whole, and none needs them all in memory."""

from __future__ import annotations

import json
from itertools import islice
from typing import TYPE_CHECKING, Any

from cucumbervision.pipeline.fields import FIELDS
from cucumbervision.pipeline.measurer import Boundary, Failure
from cucumbervision.pipeline.parquet import arrow_schema, import_arrow
from cucumbervision.pipeline.tables import (
    FAILURE_COLUMNS,
    MOST_EXCEL_ROWS,
    CsvSink,
    write_workbook,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from cucumbervision.pipeline.fields import Cell
    from cucumbervision.pipeline.journal import Record
    from cucumbervision.pipeline.output import OutputFolder
    from cucumbervision.pipeline.summary import Summary

__all__ = ["PARQUET", "TABLES", "rows_of", "write_reports"]

PARQUET = "parquet"
TABLES = ("measurements.csv", "measurements.json", "measurements.xlsx", "failures.csv", PARQUET)
"""What `write_reports` makes in an output folder."""

PART_ROWS = 100_000


def rows_of(records: Iterable[Record]) -> Iterator[dict[str, Cell]]:
    """Yield the rows of all fruit, in order."""
    for record in records:
        yield from record.rows


def write_reports(
    out: OutputFolder,
    records: Callable[[], Iterator[Record]],
    summary: Summary,
    failures: Sequence[Failure],
    provenance: Mapping[str, Any],
    *,
    parquet: bool = False,
) -> list[Failure]:
    """Write the tables of a run; one that cannot be written leaves what was there before.

    Parameters
    ----------
    out : OutputFolder
        Where to.
    records : callable
        Begins anew with the run's captures, in order.
    summary : Summary
        Of the same captures.
    failures : sequence of Failure
        What could not be read, measured or written.
    provenance : mapping
        As `tables.provenance_of` returns it.
    parquet : bool
        Whether to write `parquet/`, too.

    Returns
    -------
    list of Failure
        Why a table could not be written.
    """
    written: list[Failure] = []
    with Boundary(written, str(out.path)):
        _write_csv(out, "measurements.csv", [one.name for one in FIELDS], rows_of(records()))
    with Boundary(written, str(out.path)):
        _write_json(out, provenance, records(), failures)
    with Boundary(written, str(out.path)), out.replacing("measurements.xlsx") as path:
        lines = [*excel_limit(summary.fruit), *summary.lines(len(failures), provenance)]
        write_workbook(path, rows_of(records()), lines)
    if parquet:
        with Boundary(written, str(out.path)):
            _write_parts(out, rows_of(records()), provenance)
    with Boundary(written, str(out.path)):
        failed = (vars(failure) for failure in (*failures, *written))
        _write_csv(out, "failures.csv", FAILURE_COLUMNS, failed)
    return written


def _write_csv(
    out: OutputFolder, name: str, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]
) -> None:
    with out.replacing(name) as path, CsvSink(path, columns) as sink:
        for row in rows:
            sink.write(row)


def _write_json(
    out: OutputFolder,
    provenance: Mapping[str, Any],
    records: Iterable[Record],
    failures: Iterable[Failure],
) -> None:
    with (
        out.replacing("measurements.json") as path,
        path.open("w", encoding="utf-8", errors="backslashreplace") as file,
    ):
        file.writelines(_json_pieces(provenance, records, failures))


def excel_limit(fruit: int, most: int = MOST_EXCEL_ROWS) -> list[tuple[str, str]]:
    """Return a line for the workbook's summary where a sheet of Excel does not take all fruit.

    Examples
    --------
    >>> excel_limit(5, most=5)
    []
    >>> excel_limit(7, most=5)[0][1]
    'Excel takes 5 rows a sheet: the last 2 fruit are in measurements.csv and .json alone'
    """
    if fruit <= most:
        return []
    rest = fruit - most
    text = f"Excel takes {most} rows a sheet: the last {rest} fruit are in measurements.csv"
    return [("Not all fruit are here", f"{text} and .json alone")]


def _json_pieces(
    provenance: Mapping[str, Any], records: Iterable[Record], failures: Iterable[Failure]
) -> Iterator[str]:
    """Yield the text of `measurements.json`, a capture at a time, one value a line."""
    yield json.dumps(dict(provenance), indent=1, ensure_ascii=False).removesuffix("\n}")
    yield ',\n "captures": ['
    yield from _json_items(record.capture for record in records)
    yield ',\n "failures": ['
    yield from _json_items(vars(failure) for failure in failures)
    yield "\n}\n"


def _json_items(values: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    first = True
    for value in values:
        text = json.dumps(value, indent=1, ensure_ascii=False).replace("\n", "\n  ")
        yield f"{'' if first else ','}\n  {text}"
        first = False
    yield "]" if first else "\n ]"


def _write_parts(
    out: OutputFolder, rows: Iterator[dict[str, Cell]], provenance: Mapping[str, Any]
) -> None:
    """Write `parquet/part-00000.parquet` and so on, and take away what an earlier run had more."""
    pa, schema = import_arrow(), arrow_schema(FIELDS, provenance)
    names = set[str]()
    # Without any fruit there is one part, which tells the columns.
    while (part := list(islice(rows, PART_ROWS))) or not names:
        name = f"part-{len(names):05d}.parquet"
        with out.replacing(f"{PARQUET}/{name}") as path:
            pa.parquet.write_table(pa.Table.from_pylist(part, schema=schema), path)
        names.add(name)
    for old in (out.path / PARQUET).glob("part-*.parquet"):
        if old.name not in names:
            old.unlink()
