"""Write a round as CSV, Excel, Parquet, JSON and printable page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from datetime import date
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from cucumbervision.errors import MissingExtraError, wrap_os_errors
from cucumbervision.files import write_csv, write_json
from cucumbervision.run.fields import Cell
from cucumbervision.run.tables import Workbook, write_parquet
from cucumbervision_greenhouse import words as texts
from cucumbervision_greenhouse.exports import ExportFormat
from cucumbervision_greenhouse.exports.build import COLUMNS, RoundTables
from cucumbervision_greenhouse.forecast.picking import PickKind
from cucumbervision_greenhouse.language import day_month_words, language, marked, number_words
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.row_drawing import draw_rows
from cucumbervision_greenhouse.settings import Units
from cucumbervision_greenhouse.store.records import FruitRow

_CENTIMETRES = Units()


def write_exports(
    tables: RoundTables,
    out: Path,
    formats: Collection[ExportFormat] = tuple(ExportFormat),
    *,
    units: Units = _CENTIMETRES,
) -> list[Path]:
    """Write a round in one or more formats; files that are there are replaced when all are whole.

    Parameters
    ----------
    tables : RoundTables
        The round.
    out : Path
        Output folder; created if missing.
    formats : collection of ExportFormat
        Formats to write.
    units : Units
        Unit of lengths on the printed page. Its language is that of the pages; columns are English.

    Returns
    -------
    list of Path
        The written files.

    Raises
    ------
    MissingExtraError
        If a format needs a package that is not installed.
    CucumberVisionError
        If the folder is not writable.
    """
    writers: dict[ExportFormat, Callable[[RoundTables, Path], list[Path]]] = {
        ExportFormat.CSV: _write_csv,
        ExportFormat.XLSX: _write_workbook,
        ExportFormat.PARQUET: _write_parquet,
        ExportFormat.JSON: _write_json_round,
        ExportFormat.HTML: partial(_write_sheet, units=units),
    }
    with wrap_os_errors("cannot be written", out, "choose another folder, and close its files"):
        out.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=".export-", dir=out) as folder:
            half = Path(folder)
            kinds = [kind for kind in ExportFormat if kind in formats]
            written = [path for kind in kinds for path in writers[kind](tables, half)]
            return [path.replace(out / path.name) for path in written]


def _write_csv(tables: RoundTables, out: Path) -> list[Path]:
    """Write each table as CSV (UTF-8, commas, decimal points) with escaped formulas."""
    for name, rows in tables.tables.items():
        write_csv(out / f"{name}.csv", [column.name for column in COLUMNS[name]], rows)
    return sorted(out.glob("*.csv"))


def _write_json_round(tables: RoundTables, out: Path) -> list[Path]:
    """Write all tables as one JSON file with units and descriptions of the columns."""
    keys = ("name", "unit", "type", "says")
    columns = {
        name: [{key: getattr(column, key) for key in keys} for column in COLUMNS[name]]
        for name in tables.tables
    }
    report = {
        "format": "cucumbervision-round",
        "version": 1,
        **tables.provenance,
        "note": tables.note,
        "columns": columns,
        "tables": tables.tables,
    }
    write_json(out / "round.json", report)
    return [out / "round.json"]


def _write_parquet(tables: RoundTables, out: Path) -> list[Path]:
    """Write each table as Parquet with units, descriptions and hashes as metadata."""
    for name, rows in tables.tables.items():
        write_parquet(out / f"{name}.parquet", COLUMNS[name], rows, tables.provenance)
    return sorted(out.glob("*.parquet"))


SHEETS = {
    "fruit": ("Fruit", 5),
    "stops": ("Stops", 2),
    "forecast": ("Forecast", 0),
    "picks": ("Pick list", 0),
    "work": ("Work", 0),
    "rows": ("Rows", 0),
    "provenance": ("Provenance", 0),
}
_NOT_PRINTED = frozenset({"key", "config_sha256"})


def _write_workbook(tables: RoundTables, out: Path) -> list[Path]:
    """Write `round.xlsx` with a summary, a sheet per table, and the column descriptions."""
    path, origin = out / "round.xlsx", tables.provenance
    with Workbook(path) as book:
        book.book.set_properties(
            {
                "title": tables.title,
                "comments": f"{origin['software']}, {origin['licence']}, {origin['source']}",
            }
        )
        summary = book.sheet("Summary", (20, 26, 6, 66), pages_high=1)
        summary.set_portrait()
        facts = COLUMNS["summary"]
        book.lines(summary, [[tables.title], ("what", "value", "unit", "meaning")])
        for line, column in enumerate(facts, 2):
            line_cells = (
                column.title.split(" [")[0],
                tables.summary[column.name],
                column.unit,
                column.says,
            )
            for place, cell in enumerate(line_cells):
                book.write(summary, line, place, cell, column if place == 1 else None)
        book.lines(summary, _notes(tables), 3 + len(facts))
        for name, (title, frozen) in SHEETS.items():
            book.table(title, COLUMNS[name], tables[name], frozen, _printed(name))
        meaning = (
            (name, column.name, column.unit, column.says)
            for name in tables.tables
            for column in COLUMNS[name]
        )
        head = ("table", "column", "unit", "meaning")
        book.lines(book.sheet("Columns", (18, 18, 18, 70)), (head, *meaning))
    return [path]


def _notes(tables: RoundTables) -> Iterator[Sequence[Cell]]:
    if tables.note:
        yield "no forecast", tables.note
    for name in ("software", "licence", "source", "written_utc"):
        yield name.replace("_", " "), tables.provenance[name]
    for artifact in tables.provenance["hashes"]:
        yield f"{artifact['kind']} SHA-256", artifact["name"], "", artifact["sha256"]


def _printed(table: str) -> int:
    """Return the number of columns to print."""
    names = [column.name for column in COLUMNS[table]]
    # A leading key column identifies the rows.
    return next((n for n, name in enumerate(names) if n > 1 and name in _NOT_PRINTED), len(names))


_FILLS = ("#2F6B3A", "#8BB174", "#D9D9D9", "#7A7A7A", "#C9A227", "#5B7DB1")
_DIGITS = {"h": 1, "g": 0, "ml": 0, "deg": 0}
_NUMBERS = (
    *("ready_today", "surely_ready", "may_be_ready", "fruit", "picked", "mean_length_cm"),
    *("sd_length_cm", "shortest_cm", "longest_cm", "measured", "rows", "stops", "failures"),
)
_WORTH_SAYING = frozenset({"picked", "failures"})  # unless there are none
# Words of cells, translated where they are printed.
_KINDS = (marked("ready"), marked("may be ready"), marked("no crop profile was named"))


def _write_sheet(tables: RoundTables, out: Path, units: Units) -> list[Path]:
    path = out / "round.html"
    path.write_text(render_sheet(tables, units), encoding="utf-8")
    return [path]


def render_sheet(tables: RoundTables, units: Units = _CENTIMETRES) -> str:
    """Return the printable page as self-contained HTML with escaped text, in the language shown.

    Raises
    ------
    MissingExtraError
        If Jinja is not installed.
    """
    summary = tables.summary
    columns = {column.name: column for column in COLUMNS["summary"]}
    house = [line for line in tables["forecast"] if line["scope"] == "house"]
    picks = tables["picks"]
    kinds = Counter(str(line["kind"]) for line in picks)
    page: str = _template(units).render(
        language=language(),
        title=tables.title,
        about=tables.provenance,
        note=tables.note,
        numbers=[
            (columns[name], summary[name])
            for name in _NUMBERS
            if summary[name] is not None and (summary[name] or name not in _WORTH_SAYING)
        ],
        where=filter(None, (summary["house"], tables.crop and _(tables.crop))),
        walked=tables.walked,
        simulated=summary["simulated"],
        bins=tables.bins,
        most=max((count for *_, count in tables.bins), default=0) or 1,
        fills=_FILLS,
        house=house,
        classes=[*dict.fromkeys(str(line["class"]) for line in house)],
        work=tables["work"],
        picks=picks,
        rows=[*_drawings(tables, units)],
        kinds=[(kind, kinds[kind]) for kind in PickKind if kinds[kind]],
        fruit=[
            (row, "–" if graded is None else texts.grade_words(graded), _remarks(fruit, units))
            for row, (fruit, graded) in zip(tables["fruit"], tables.fruit, strict=True)
        ],
    )
    return page


_PIECE_M = 4.0  # of a row that is as wide as a page


def _drawings(tables: RoundTables, units: Units) -> Iterator[tuple[str, str]]:
    """Draw the rows in pieces that are as wide as a page."""
    grades = {fruit.key: graded for fruit, graded in tables.fruit if graded is not None}
    pieces: dict[float, list[FruitRow]] = {}
    for fruit, graded in tables.fruit:
        if graded is not None and fruit.along_m is not None:
            pieces.setdefault(fruit.along_m // _PIECE_M, []).append(fruit)
    for piece in sorted(pieces):
        of_piece = [stop for stop in tables.stops if (stop.at_m or 0.0) // _PIECE_M == piece]
        yield from draw_rows(pieces[piece], of_piece, grades, units).items()


def _remarks(fruit: FruitRow, units: Units) -> str:
    picked = _("picked") if fruit.picked_s else ""
    drawn = _("computer-made") if fruit.simulated else ""
    return "; ".join(filter(None, (picked, drawn, texts.remarks(fruit, units))))


def _template(units: Units) -> Any:
    try:
        from jinja2 import Environment, PackageLoader, StrictUndefined
    except ModuleNotFoundError:
        raise MissingExtraError("jinja2", "export") from None
    environment = Environment(
        loader=PackageLoader("cucumbervision_greenhouse.exports", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["_"] = _
    environment.filters.update(
        figure=partial(_figure, units),
        # One time where both ends are written alike.
        hours=lambda low, high: "–".join(
            dict.fromkeys([texts.hours_words(low), texts.hours_words(high)])
        ),
        unit=lambda unit: {"cm": units.name, "m": units.along[0]}.get(unit, unit),
        day=lambda day: day_month_words(date.fromisoformat(day)),
        words=lambda cell: "–" if cell is None else _(str(cell)),
        class_name=texts.class_words,
    )
    return environment.get_template("round.html")


def _figure(units: Units, cell: Cell, unit: str = "") -> Any:
    """Format a cell for the page."""
    if isinstance(cell, int | float) and unit == "cm":
        return number_words(units.value(cell / 100) or 0.0, units.digits)
    if isinstance(cell, int | float) and unit == "m":
        return texts.position_words(cell, units).split()[0]
    if isinstance(cell, float):
        return number_words(cell, _DIGITS.get(unit, 1))
    return "–" if cell is None else cell
