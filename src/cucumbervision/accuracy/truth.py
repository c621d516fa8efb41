"""Read tables of manual lengths, and estimate their repeatability."""

from __future__ import annotations

import csv
import hashlib
import io
import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING
from unicodedata import normalize

import numpy as np

from cucumbervision.errors import CucumberVisionError, TruthError, as_errors_of, wrap_reader_errors
from cucumbervision.files import read_text
from cucumbervision.methods.result import LengthDefinition

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

_SEPARATORS = (",", ";", "\t")
_MOST_COLUMNS = 1000

_FORMULA_STARTS = ("=", "+", "-", "@")


@dataclass(frozen=True)
class Line:
    """A line of a table with its line number and its cells by column."""

    number: int
    cells: dict[str, str]


@dataclass(frozen=True)
class CsvTable:
    """A table with lower-case column names and all lines that are not blank."""

    columns: tuple[str, ...]
    lines: tuple[Line, ...]


def read_table(path: Path, error: type[CucumberVisionError] = CucumberVisionError) -> CsvTable:
    r"""Read a CSV file as written by any spreadsheet.

    UTF-8 with or without byte order mark, UTF-16 with one, otherwise Windows-1252. The separator is
    the comma, semicolon or tab that splits the header most; Excel's `sep=;` line is supported. The
    apostrophe that prevents a text from being run as a formula is removed.

    Parameters
    ----------
    path : Path
        The file.
    error : type of CucumberVisionError
        Class of the error to raise.

    Raises
    ------
    CucumberVisionError
        If the file cannot be read, is empty, or a line has more cells than the header.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "a.csv"
    >>> _ = path.write_bytes(b"\xef\xbb\xbfCapture;length_cm\r\nrow-3;23,5\r\n")
    >>> table = read_table(path)
    >>> table.columns, table.lines[0]
    (('capture', 'length_cm'), Line(number=2, cells={'capture': 'row-3', 'length_cm': '23,5'}))
    """
    text = read_text(path, error)
    first, _, further_lines = text.partition("\n")
    skipped = 0
    if first.strip().strip('"').lower().startswith("sep="):
        text, skipped = further_lines, 1
        first = further_lines.partition("\n")[0]
    separator = max(_SEPARATORS, key=first.count)
    with as_errors_of(path):
        if not text.strip():
            raise error("the file is empty", remedy="write a head and a line a length")
        with wrap_reader_errors(path, error, "write one line a length, and close every quote"):
            return _table_of(text, skipped, separator, error)


def _table_of(
    text: str, skipped: int, separator: str, error: type[CucumberVisionError]
) -> CsvTable:
    reader = csv.reader(io.StringIO(text), delimiter=separator)
    head = tuple(name.strip().lower() for name in next(reader))
    if len(head) > _MOST_COLUMNS:
        remedy = f"a table has at most {_MOST_COLUMNS}; write the columns' names on line 1"
        raise error(f"line {1 + skipped} names {len(head)} columns", remedy=remedy)
    if double := {name for name in head if name and head.count(name) > 1}:
        fault = f"line {1 + skipped}: column '{min(double)}' is there twice"
        raise error(fault, remedy="leave one of them out")
    lines = []
    for cells in reader:
        if not any(cell.strip() for cell in cells):
            continue
        number = reader.line_num + skipped
        if any(cell.strip() for cell in cells[len(head) :]):
            raise error(
                f"line {number} has {len(cells)} cells, the head {len(head)}",
                remedy="put texts that hold the separator in quotes; decimal commas need "
                "semicolons between cells",
            )
        padded = [*cells, *[""] * len(head)]
        lines.append(Line(number, {n: _cell(c) for n, c in zip(head, padded, strict=False)}))
    return CsvTable(head, tuple(lines))


def parse_number(text: str) -> float | None:
    """Parse a number with a decimal point or comma; None if it is invalid or not finite.

    Examples
    --------
    >>> parse_number("23,5"), parse_number(" 23.5"), parse_number("1.234,5"), parse_number("inf")
    (23.5, 23.5, None, None)
    """
    plain = text.strip().replace("\u00a0", "")
    if plain.count(",") == 1 and "." not in plain:
        plain = plain.replace(",", ".")
    try:
        value = float(plain)
    except ValueError:
        return None
    return value if abs(value) < float("inf") else None


def _cell(text: str) -> str:
    plain = text.strip()
    return plain[1:] if plain[:1] == "'" and plain[1:2] in _FORMULA_STARTS else plain


MISSED = "missed"

_LENGTH_COLUMN = re.compile(r"length(_\d+)?_cm")

_KNOWN = {"capture", "fruit", "kind", "specimen", "repeat"}


@dataclass(frozen=True, kw_only=True)
class TrueLength:
    """Manual length of one fruit in one capture.

    Parameters
    ----------
    line : int
        First line of the fruit in the file.
    capture : str
        Name of the capture.
    fruit : int or None
        Number of the fruit in the capture; None if it was not detected.
    kind : LengthDefinition
        Definition of length.
    lengths_m : tuple of float
        All measurements, metres.
    specimen : str
        Name of the physical fruit.
    """

    line: int
    capture: str
    fruit: int | None
    kind: LengthDefinition
    lengths_m: tuple[float, ...]
    specimen: str

    @property
    def length_m(self) -> float:
        """Mean of the measurements, metres."""
        return float(np.mean(self.lengths_m))


@dataclass(frozen=True)
class Truth:
    """A table of manual lengths.

    Parameters
    ----------
    path : Path
        The file.
    lengths : tuple of TrueLength
        Lengths in the order of the file.
    specimens_named : bool
        Whether the table names the physical fruit.
    sha256 : str
        SHA-256 of the file.
    unused : tuple of str
        Unknown columns.
    """

    path: Path
    lengths: tuple[TrueLength, ...]
    specimens_named: bool
    sha256: str
    unused: tuple[str, ...] = ()


@dataclass(frozen=True)
class Floor:
    """Repeatability of manual measurements, the lower limit of any measurable error.

    Parameters
    ----------
    sd_mm, sd_percent : float
        Pooled standard deviation of one measurement, absolute and relative.
    specimens, measurements : int
        Number of fruit measured more than once, and of their measurements.
    """

    sd_mm: float
    sd_percent: float
    specimens: int
    measurements: int


def read_truth(path: Path) -> Truth:
    """Read a table of manual lengths.

    Columns: `capture`, `fruit` (the number in the run, or 'missed' if it was not detected),
    `length_cm` and/or `length_1_cm`, `length_2_cm` …, `kind` (thread, centreline or chord),
    optionally `specimen` (the physical fruit) and `repeat` (1, 2 … for repeated lines).

    Raises
    ------
    TruthError
        With file and line, for an empty file, a missing column, a length that is not a positive
        number, an unknown kind, or contradictory lines.
    """
    table = read_table(path, TruthError)
    columns = [name for name in table.columns if _LENGTH_COLUMN.fullmatch(name)]
    missing = [name for name in ("capture", "fruit", "kind") if name not in table.columns]
    missing += [] if columns else ["length_cm"]
    with as_errors_of(path):
        if missing:
            remedy = "name the columns capture, fruit, length_cm (in centimetres), kind"
            raise TruthError("has no column {names}", remedy=remedy, names=", ".join(missing))
        if not table.lines:
            raise TruthError("has a head but no lines", remedy="write a line a length")
        lengths = _merged([(line, _true_length(line, columns)) for line in table.lines])
        _require_whole_specimens(lengths)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    unused = tuple(n for n in table.columns if n and n not in {*_KNOWN, *columns})
    return Truth(path, lengths, "specimen" in table.columns, digest, unused)


def floor_of(lengths: Sequence[TrueLength]) -> Floor | None:
    """Return the pooled repeatability, or None without repeated measurements.

    Measurements of a fruit are counted once, although they are listed for each of its captures.

    Examples
    --------
    >>> twice = TrueLength(
    ...     line=2,
    ...     capture="a",
    ...     fruit=1,
    ...     kind=LengthDefinition.THREAD,
    ...     lengths_m=(0.200, 0.202),
    ...     specimen="s1",
    ... )
    >>> floor = floor_of([twice])
    >>> round(floor.sd_mm, 3), round(floor.sd_percent, 3)
    (1.414, 0.704)
    """
    repeated = {(t.specimen, t.kind, t.lengths_m) for t in lengths if len(t.lengths_m) > 1}
    if not repeated:
        return None
    series = [np.array(values) for _, _, values in sorted(repeated)]
    freedom = sum(len(x) - 1 for x in series)
    absolute = sum(float(((x - x.mean()) ** 2).sum()) for x in series)
    relative = sum(float(((x / x.mean() - 1) ** 2).sum()) for x in series)
    return Floor(
        sd_mm=1000 * float(np.sqrt(absolute / freedom)),
        sd_percent=100 * float(np.sqrt(relative / freedom)),
        specimens=len({name for name, _, _ in repeated}),
        measurements=sum(len(x) for x in series),
    )


def _true_length(line: Line, columns: Sequence[str]) -> TrueLength:
    cells, place = line.cells, f"line {line.number}"
    if not cells["capture"]:
        raise TruthError(f"{place}: names no capture", remedy="fill the column capture")
    kinds = [str(kind) for kind in LengthDefinition]
    kind = cells["kind"].lower()
    if kind not in kinds:
        fault = f"{place}: '{cells['kind']}' is not a kind of length"
        raise TruthError(fault, remedy=f"write {', '.join(kinds)}")
    fruit = _fruit(cells["fruit"], place)
    lengths = tuple(_length_m(cells[name], f"{place}: {name}") for name in columns if cells[name])
    if not lengths:
        raise TruthError(f"{place}: has no length", remedy="fill it or drop the line")
    fruit_name = f"{cells['capture']} {fruit or f'{MISSED} {place}'}"
    return TrueLength(
        line=line.number,
        capture=normalize("NFC", cells["capture"]),
        fruit=fruit,
        kind=LengthDefinition(kind),
        lengths_m=lengths,
        specimen=cells.get("specimen") or fruit_name,
    )


def _fruit(text: str, place: str) -> int | None:
    if text.lower() == MISSED:
        return None
    value = parse_number(text)
    if value is None or value < 1 or value != int(value):
        remedy = f"give its number in the overlay, or '{MISSED}' if the run did not find it"
        raise TruthError(f"{place}: '{text}' is not the number of a fruit", remedy=remedy)
    return int(value)


def _length_m(text: str, place: str) -> float:
    value = parse_number(text)
    if value is None or value <= 0:
        remedy = "give centimetres, such as 23.5 or 23,5"
        raise TruthError(f"{place} '{text}' is not a positive number", remedy=remedy)
    return value / 100


def _merged(read: Sequence[tuple[Line, TrueLength]]) -> tuple[TrueLength, ...]:
    first_of_repeat: dict[tuple[object, ...], TrueLength] = {}
    merged: dict[tuple[object, ...], TrueLength] = {}
    for line, length in read:
        # Missed fruit have no number and are distinguished by their specimen.
        fruit = length.capture, length.fruit or length.specimen, length.kind
        repeat = (*fruit, line.cells.get("repeat", ""))
        before = first_of_repeat.setdefault(repeat, length)
        if before.lengths_m != length.lengths_m:
            raise TruthError(
                f"lines {before.line} and {length.line} contradict each other: "
                f"{_cm(before)} and {_cm(length)} for fruit {length.fruit or MISSED} of "
                f"'{length.capture}'",
                remedy="drop one, or number repeated measurements in a column 'repeat'",
            )
        if before is not length:
            continue
        first = merged.setdefault(fruit, length)
        if first.specimen != length.specimen:
            raise TruthError(
                f"lines {first.line} and {length.line} call one fruit '{first.specimen}' and "
                f"'{length.specimen}'",
                remedy="correct the column specimen",
            )
        if first is not length:
            merged[fruit] = replace(first, lengths_m=(*first.lengths_m, *length.lengths_m))
    return tuple(merged.values())


def _require_whole_specimens(lengths: Sequence[TrueLength]) -> None:
    first_of_specimen: dict[tuple[str, str], TrueLength] = {}
    for length in lengths:
        first = first_of_specimen.setdefault((length.capture, length.specimen), length)
        if first.fruit != length.fruit:
            raise TruthError(
                f"lines {first.line} and {length.line}: specimen '{length.specimen}' is fruit "
                f"{first.fruit or MISSED} and {length.fruit or MISSED} of '{length.capture}'",
                remedy="a fruit is in a picture once; correct the column specimen",
            )


def _cm(length: TrueLength) -> str:
    return " / ".join(f"{100 * x:g} cm" for x in length.lengths_m)
