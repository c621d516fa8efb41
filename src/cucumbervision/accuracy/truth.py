"""Read tables of manual lengths, and estimate their repeatability."""

from __future__ import annotations

import csv
import hashlib
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path
from unicodedata import normalize

import numpy as np

from cucumbervision.errors import CucumberVisionError, TruthError, as_errors_of, wrap_reader_errors
from cucumbervision.files import read_text
from cucumbervision.methods.result import LengthDefinition

_SEPARATORS = (",", ";", "\t")
_MOST_COLUMNS = 1000

_FORMULA_GUARD = re.compile(r"^'(?=[=+@-])")


def read_table(
    path: Path, error: type[CucumberVisionError] = CucumberVisionError
) -> tuple[list[str], dict[int, dict[str, str]]]:
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

    Returns
    -------
    columns : list of str
        Names in lower case.
    lines : dict of int to dict of str to str
        The cells by column of each line that is not blank, by its number.

    Raises
    ------
    CucumberVisionError
        If the file cannot be read, is empty, or a line has more cells than the header.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "a.csv"
    >>> _ = path.write_bytes(b"\xef\xbb\xbfCapture;length_cm\r\nrow-3;23,5\r\n")
    >>> read_table(path)
    (['capture', 'length_cm'], {2: {'capture': 'row-3', 'length_cm': '23,5'}})
    """
    text, first_line = read_text(path, error), 1
    if text.partition("\n")[0].strip().strip('"').lower().startswith("sep="):
        text, first_line = text.partition("\n")[2], 2
    separator = max(_SEPARATORS, key=text.partition("\n")[0].count)
    remedy = "write one line a length, and close every quote"
    lines: dict[int, dict[str, str]] = {}
    with as_errors_of(path), wrap_reader_errors(path, error, remedy):
        if not text.strip():
            raise error("the file is empty", remedy="write a head and a line a length")
        reader = csv.reader(io.StringIO(text), delimiter=separator)
        head = [name.strip().lower() for name in next(reader)]
        if len(head) > _MOST_COLUMNS:
            remedy = f"a table has at most {_MOST_COLUMNS}; write the columns' names on line 1"
            raise error(f"line {first_line} names {len(head)} columns", remedy=remedy)
        if double := {name for name in head if name and head.count(name) > 1}:
            fault = f"line {first_line}: column '{min(double)}' is there twice"
            raise error(fault, remedy="leave one of them out")
        for row in reader:
            cells, number = [*map(str.strip, row)], reader.line_num + first_line - 1
            if any(cells[len(head) :]):
                raise error(
                    f"line {number} has {len(cells)} cells, the head {len(head)}",
                    remedy="put texts that hold the separator in quotes; decimal commas need "
                    "semicolons between cells",
                )
            if any(cells):
                plain = (_FORMULA_GUARD.sub("", cell) for cell in cells)
                lines[number] = dict(zip_longest(head, plain, fillvalue=""))
    return head, lines


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
    head, lines = read_table(path, TruthError)
    columns = [name for name in head if _LENGTH_COLUMN.fullmatch(name)]
    missing = [name for name in ("capture", "fruit", "kind") if name not in head]
    missing += [] if columns else ["length_cm"]
    with as_errors_of(path):
        if missing:
            remedy = "name the columns capture, fruit, length_cm (in centimetres), kind"
            raise TruthError("has no column {names}", remedy=remedy, names=", ".join(missing))
        if not lines:
            raise TruthError("has a head but no lines", remedy="write a line a length")
        read = [
            (_true_length(n, cells, columns), cells.get("repeat", "")) for n, cells in lines.items()
        ]
        lengths = _merged(read)
        _require_whole_specimens(lengths)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    unused = tuple(n for n in head if n and n not in {*_KNOWN, *columns})
    return Truth(path, lengths, "specimen" in head, digest, unused)


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


def _true_length(number: int, cells: Mapping[str, str], columns: Sequence[str]) -> TrueLength:
    fruit_text, kind = cells["fruit"].lower(), cells["kind"].lower()
    fruit = None if fruit_text == MISSED else parse_number(fruit_text) or 0.0
    lengths_cm = {name: parse_number(cells[name]) or 0.0 for name in columns if cells[name]}
    bad = next((name for name, length_cm in lengths_cm.items() if length_cm <= 0), None)
    if not cells["capture"]:
        fault, remedy = "names no capture", "fill the column capture"
    elif kind not in {*LengthDefinition}:
        fault = f"'{cells['kind']}' is not a kind of length"
        remedy = f"write {', '.join(LengthDefinition)}"
    elif fruit is not None and (fruit < 1 or fruit % 1):
        fault = f"'{cells['fruit']}' is not the number of a fruit"
        remedy = f"give its number in the overlay, or '{MISSED}' if the run did not find it"
    elif bad:
        fault = f"{bad} '{cells[bad]}' is not a positive number"
        remedy = "give centimetres, such as 23.5 or 23,5"
    elif not lengths_cm:
        fault, remedy = "has no length", "fill it or drop the line"
    else:
        place = f"{fruit:g}" if fruit else f"{MISSED} line {number}"
        return TrueLength(
            line=number,
            capture=normalize("NFC", cells["capture"]),
            fruit=int(fruit) if fruit else None,
            kind=LengthDefinition(kind),
            lengths_m=tuple(length_cm / 100 for length_cm in lengths_cm.values()),
            specimen=cells.get("specimen") or f"{cells['capture']} {place}",
        )
    raise TruthError(f"line {number}: {fault}", remedy=remedy)


def _merged(read: Iterable[tuple[TrueLength, str]]) -> tuple[TrueLength, ...]:
    first_of_repeat: dict[tuple[object, ...], TrueLength] = {}
    merged: dict[tuple[object, ...], TrueLength] = {}
    for length, number in read:
        # Missed fruit have no number and are distinguished by their specimen.
        fruit = length.capture, length.fruit or length.specimen, length.kind
        before = first_of_repeat.setdefault((*fruit, number), length)
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
