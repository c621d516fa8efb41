"""A round as CSV, JSON, Parquet and a page to print, and in all formats at once."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cucumbervision.agronomy.picking import hours_words
from cucumbervision.errors import CucumberVisionError, MissingExtraError
from cucumbervision.exports import ExportFormat
from cucumbervision.exports.tables import ExportTable
from cucumbervision.exports.workbook import fruit_remarks, write_round_workbook
from cucumbervision.pipeline.tables import (
    CsvSink,
    arrow_schema,
    import_arrow,
    write_json,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from jinja2 import Template

    from cucumbervision.exports.tables import Charts, RoundTables
    from cucumbervision.pipeline.fields import Cell


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
    writers: dict[ExportFormat, Callable[[RoundTables, Path], list[Path]]] = {
        ExportFormat.CSV: _write_csv,
        ExportFormat.XLSX: write_round_workbook,
        ExportFormat.PARQUET: _write_parquet,
        ExportFormat.JSON: _write_json_round,
        ExportFormat.HTML: _write_sheet,
    }
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, make in tables.pictures.items():
            (out / name).parent.mkdir(exist_ok=True)
            (out / name).write_bytes(make())
        return [
            path for one in ExportFormat if one in formats for path in writers[one](tables, out)
        ]
    except OSError as error:
        raise CucumberVisionError(
            f"cannot be written ({error.strerror or error})",
            source=out,
            remedy="choose another folder, and close its files elsewhere",
        ) from None


def _write_csv(tables: RoundTables, out: Path) -> list[Path]:
    """Write each table as CSV: UTF-8, commas, decimal points; texts defused."""
    paths = []
    for table in tables.tables.values():
        paths.append(out / f"{table.name}.csv")
        with CsvSink(paths[-1], [column.name for column in table.columns]) as sink:
            for record in table.records():
                sink.write(record)
    return paths


def _write_json_round(tables: RoundTables, out: Path) -> list[Path]:
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


def _columns(table: ExportTable) -> list[dict[str, str]]:
    return [{"name": c.name, "unit": c.unit, "type": c.type, "says": c.says} for c in table.columns]


def _write_parquet(tables: RoundTables, out: Path) -> list[Path]:
    """Write each table as Parquet; units and meaning with the columns, hashes with the file.

    Raises
    ------
    MissingExtraError
        If pyarrow is not installed.
    """
    pa = import_arrow()
    paths = []
    for table in tables.tables.values():
        schema = arrow_schema(table.columns, tables.provenance)
        paths.append(out / f"{table.name}.parquet")
        pa.parquet.write_table(pa.Table.from_pylist(table.records(), schema=schema), paths[-1])
    return paths


_HEIGHT = 100.0

_FILLS = ("#2F6B3A", "#8BB174", "#D9D9D9", "#7A7A7A", "#C9A227", "#5B7DB1")

_TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ")

_DIGITS = {"cm": 1, "mm": 1, "m": 2, "h": 1, "g": 0, "ml": 0, "deg": 0}


@dataclass(frozen=True)
class Bar:
    """One bar of a chart: what it is of, its number, and its place from the top, 0 to 100."""

    label: str
    number: float
    top: float
    height: float
    fill: str = _FILLS[0]


def bars(charts: Charts) -> tuple[Bar, ...]:
    """Lay out the histogram of lengths.

    Examples
    --------
    >>> from cucumbervision.exports.tables import Charts
    >>> [(bar.label, bar.height) for bar in bars(Charts(bins=((20, 22, 1), (22, 24, 2))))]
    [('20', 50.0), ('22', 100.0)]
    """
    most = max((count for *_, count in charts.bins), default=0) or 1
    return tuple(
        Bar(str(low), count, _HEIGHT * (1 - count / most), _HEIGHT * count / most)
        for low, _, count in charts.bins
    )


def stacks(charts: Charts) -> tuple[tuple[int, tuple[Bar, ...]], ...]:
    """Lay out the forecast: for each day its classes, one on the other.

    Examples
    --------
    >>> from cucumbervision.exports.tables import Charts
    >>> found = stacks(Charts(classes=("I", "II"), days=((0, (1.0, 3.0)),)))
    >>> [(bar.label, bar.top, bar.height) for bar in found[0][1]]
    [('I', 75.0, 25.0), ('II', 0.0, 75.0)]
    """
    most = max((sum(counts) for _, counts in charts.days), default=0.0) or 1.0
    found = []
    for day, counts in charts.days:
        top, day_bars = _HEIGHT, []
        for k, (name, count) in enumerate(zip(charts.classes, counts, strict=True)):
            height = _HEIGHT * count / most
            top -= height
            day_bars.append(Bar(name, count, top, height, _FILLS[k % len(_FILLS)]))
        found.append((day, tuple(day_bars)))
    return tuple(found)


def _write_sheet(tables: RoundTables, out: Path) -> list[Path]:
    """Write `round.html`.

    Raises
    ------
    MissingExtraError
        If Jinja is not installed.
    """
    path = out / "round.html"
    path.write_text(render_sheet(tables), encoding="utf-8")
    return [path]


_NUMBERS = (
    *("ready_today", "fruit", "expected_fruit", "picked", "mean_length_cm", "sd_length_cm"),
    *("shortest_cm", "longest_cm", "measured", "rows", "stops", "failures"),
)


def render_sheet(tables: RoundTables) -> str:
    """Return the page: numbers, charts, forecast, work, pick list, fruit, and what it rests on.

    Every text of it is escaped, and it loads nothing from anywhere.
    """
    house = [line for line in tables["forecast"].records() if line["scope"] == "house"]
    columns = {column.name: column for column in tables["summary"].columns}
    return _template().render(
        title=tables.title,
        about=tables.provenance,
        note=tables.note,
        numbers=[
            (columns[name], tables.summary[name])
            for name in _NUMBERS
            if tables.summary[name] is not None
        ],
        where=[tables.summary[name] for name in ("house", "profile") if tables.summary[name]],
        day=str(tables.summary["started_utc"])[:10],
        simulated=tables.summary["simulated"],
        bars=bars(tables.charts),
        stacks=stacks(tables.charts),
        classes=tables.charts.classes,
        fills=_FILLS,
        house=house,
        work=tables["work"].records(),
        picks=tables["picks"].records(),
        fruit=tables["fruit"].records(),
    )


def _template() -> Template:
    try:
        from jinja2 import Environment, PackageLoader, StrictUndefined
    except ModuleNotFoundError:
        raise MissingExtraError("jinja2", "export") from None
    environment = Environment(
        loader=PackageLoader("cucumbervision.exports", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(figure=_figure, fruit_remarks=fruit_remarks, hours=hours_words)
    return environment.get_template("round.html")


def _figure(cell: Cell, unit: str = "") -> Any:
    """Return a cell as people read it."""
    if cell is None:
        return "–"
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    if isinstance(cell, str) and _TIME.fullmatch(cell):
        return cell.replace("T", " ").removesuffix("Z")
    if isinstance(cell, float):
        return f"{cell:.{_DIGITS.get(unit, 1)}f}"
    return cell
