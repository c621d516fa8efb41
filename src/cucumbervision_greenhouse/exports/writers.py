"""Write a round as CSV, Excel, Parquet, JSON and printable page."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from cucumbervision.crop.grades import WITHOUT_CLASS
from cucumbervision.errors import MissingExtraError, wrap_os_errors
from cucumbervision.files import write_csv, write_json
from cucumbervision.run.tables import Workbook, write_parquet
from cucumbervision_greenhouse.exports import ExportFormat
from cucumbervision_greenhouse.exports.build import ExportTable
from cucumbervision_greenhouse.forecast.picking import PickKind, hours_words

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from jinja2 import Template

    from cucumbervision.run.fields import Cell
    from cucumbervision_greenhouse.exports.build import RoundTables


@dataclass(frozen=True)
class PageWords:
    """The language of the printed page.

    Parameters
    ----------
    code : str
        Its code, as in HTML.
    text : callable
        Translates a text of the page, or of a table's cell, from English.
    decimals : callable
        Writes the decimal mark of a number that has a point.
    day : callable
        Writes a date that is given as in ISO 8601.
    hours : callable
        Writes hours of work.
    crop : callable
        Gives the title of a crop profile by its name.
    inches : bool
        Lengths are in inches and positions in feet, instead of in centimetres and metres.

    Examples
    --------
    >>> PageWords().class_name("I"), PageWords().class_name("too long")
    ('class I', 'too long')
    """

    code: str = "en"
    text: Callable[[str], str] = str
    decimals: Callable[[str], str] = str
    day: Callable[[str], str] = str
    hours: Callable[[float], str] = hours_words
    crop: Callable[[str], str] = str
    inches: bool = False

    def class_name(self, name: str) -> str:
        """Return the name of a class for people."""
        if name in WITHOUT_CLASS:
            return self.text(name)
        return self.text("class {name}").format(name=name)


ENGLISH = PageWords()


def write_exports(
    tables: RoundTables,
    out: Path,
    formats: Collection[ExportFormat] = tuple(ExportFormat),
    *,
    words: PageWords = ENGLISH,
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
    words : PageWords
        Language of the printed page; names and descriptions of columns stay English.

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
        ExportFormat.HTML: partial(_write_sheet, words=words),
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
    paths = [out / f"{name}.csv" for name in tables.tables]
    for path, table in zip(paths, tables.tables.values(), strict=True):
        write_csv(path, [column.name for column in table.columns], table.rows)
    return paths


def _write_json_round(tables: RoundTables, out: Path) -> list[Path]:
    """Write all tables as one JSON file with units and descriptions of the columns."""
    keys = ("name", "unit", "type", "says")
    columns = {
        name: [{key: getattr(column, key) for key in keys} for column in table.columns]
        for name, table in tables.tables.items()
    }
    report = {
        "format": "cucumbervision-round",
        "version": 1,
        **tables.provenance,
        "note": tables.note,
        "columns": columns,
        "tables": {name: table.rows for name, table in tables.tables.items()},
    }
    write_json(out / "round.json", report)
    return [out / "round.json"]


def _write_parquet(tables: RoundTables, out: Path) -> list[Path]:
    """Write each table as Parquet with units, descriptions and hashes as metadata."""
    paths = [out / f"{name}.parquet" for name in tables.tables]
    for path, table in zip(paths, tables.tables.values(), strict=True):
        write_parquet(path, table.columns, table.rows, tables.provenance)
    return paths


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
        facts = tables["summary"]
        book.lines(summary, [[tables.title], ("what", "value", "unit", "meaning")])
        for line, column in enumerate(facts.columns, 2):
            line_cells = (
                column.title.split(" [")[0],
                facts.rows[0][column.name],
                column.unit,
                column.says,
            )
            for place, cell in enumerate(line_cells):
                book.write(summary, line, place, cell, column if place == 1 else None)
        book.lines(summary, _notes(tables), 3 + len(facts.columns))
        for name, (title, frozen) in SHEETS.items():
            table = tables[name]
            book.table(title, table.columns, table.rows, frozen, _printed(table))
        meaning = (
            (name, column.name, column.unit, column.says)
            for name, table in tables.tables.items()
            for column in table.columns
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


def _printed(table: ExportTable) -> int:
    """Return the number of columns to print."""
    names = [column.name for column in table.columns]
    # A leading key column identifies the rows.
    return next((n for n, name in enumerate(names) if n > 1 and name in _NOT_PRINTED), len(names))


_FILLS = ("#2F6B3A", "#8BB174", "#D9D9D9", "#7A7A7A", "#C9A227", "#5B7DB1")
_TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ")
_DIGITS = {"cm": 1, "mm": 1, "m": 2, "h": 1, "g": 0, "ml": 0, "deg": 0}
_IN_INCHES = {"cm": ("in", 2.54, 2), "m": ("ft", 0.3048, 2)}
"""Unit that is shown, its size in the column's unit, and its decimals."""
_NUMBERS = (
    *(
        "ready_today",
        "surely_ready",
        "may_be_ready",
        "fruit",
        "picked",
        "mean_length_cm",
        "sd_length_cm",
    ),
    *("shortest_cm", "longest_cm", "measured", "rows", "stops", "failures"),
)


_WORTH_SAYING = frozenset({"picked", "failures"})  # unless there are none


def _write_sheet(tables: RoundTables, out: Path, words: PageWords) -> list[Path]:
    path = out / "round.html"
    path.write_text(render_sheet(tables, words), encoding="utf-8")
    return [path]


def render_sheet(tables: RoundTables, words: PageWords = ENGLISH) -> str:
    """Return the printable page as self-contained HTML with escaped text, in a language.

    Raises
    ------
    MissingExtraError
        If Jinja is not installed.
    """
    summary = tables.summary
    columns = {column.name: column for column in tables["summary"].columns}
    house = [line for line in tables["forecast"].rows if line["scope"] == "house"]
    picks = tables["picks"].rows
    kinds = Counter(str(line["kind"]) for line in picks)
    return _template(words).render(
        language=words.code,
        title=tables.title,
        about=tables.provenance,
        note=tables.note,
        numbers=[
            (columns[name], summary[name])
            for name in _NUMBERS
            if summary[name] is not None and (summary[name] or name not in _WORTH_SAYING)
        ],
        where=filter(None, (summary["house"], words.crop(str(summary["profile"] or "")))),
        walked=tables.walked,
        simulated=summary["simulated"],
        bins=tables.bins,
        most=max((count for *_, count in tables.bins), default=0) or 1,
        fills=_FILLS,
        house=house,
        classes=[*dict.fromkeys(str(line["class"]) for line in house)],
        work=tables["work"].rows,
        picks=picks,
        kinds=[(kind, kinds[kind]) for kind in PickKind if kinds[kind]],
        fruit=tables["fruit"].rows,
    )


def _template(words: PageWords) -> Template:
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
    environment.globals["_"] = words.text
    environment.filters.update(
        figure=partial(_figure, words),
        hours=partial(_hours, words),
        unit=partial(_unit, words),
        day=words.day,
        words=lambda cell: "–" if cell is None else words.text(str(cell)),
        class_name=words.class_name,
    )
    return environment.get_template("round.html")


def _unit(words: PageWords, unit: str) -> str:
    """Return the unit that the page shows for a column's."""
    return _IN_INCHES[unit][0] if words.inches and unit in _IN_INCHES else unit


def _hours(words: PageWords, low: float, high: float) -> str:
    """Return an interval of hours; one length of time where both ends are written alike."""
    return "–".join(dict.fromkeys([words.hours(low), words.hours(high)]))


def _figure(words: PageWords, cell: Cell, unit: str = "") -> Any:
    """Format a cell for the page."""
    if cell is None:
        return "–"
    if isinstance(cell, bool):
        return words.text("yes" if cell else "no")
    if isinstance(cell, str) and _TIME.fullmatch(cell):
        return cell.replace("T", " ").removesuffix("Z")
    if words.inches and unit in _IN_INCHES and isinstance(cell, int | float):
        _, size, digits = _IN_INCHES[unit]
        return words.decimals(f"{(max(cell, 0.0) if unit == 'm' else cell) / size:.{digits}f}")
    if isinstance(cell, float):
        # A row begins at 0, as the pages show it, also where a fruit hangs before the first stop.
        cell = max(cell, 0.0) if unit == "m" else cell
        return words.decimals(f"{cell:.{_DIGITS.get(unit, 1)}f}")
    return cell
