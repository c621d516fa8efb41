"""Tables that people write: commas or semicolons, decimal points or commas, Excel's codes."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from typing import TYPE_CHECKING

from cucumbervision.errors import CucumberVisionError

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["Line", "Table", "parse_number", "read_table"]

SEPARATORS = (",", ";", "\t")
FORMULA_STARTS = ("=", "+", "-", "@")


@dataclass(frozen=True)
class Line:
    """One line of a table: its number in the file, and its cells by column."""

    number: int
    cells: dict[str, str]


@dataclass(frozen=True)
class Table:
    """A table: names of columns, in lower case, and the lines that are not blank."""

    columns: tuple[str, ...]
    lines: tuple[Line, ...]


def read_table(path: Path, error: type[CucumberVisionError] = CucumberVisionError) -> Table:
    r"""Read a CSV as any spreadsheet writes it.

    UTF-8 with or without byte order mark, UTF-16 with one, otherwise Windows-1252; separated by
    comma, semicolon or tab, whichever splits the head most; Excel's `sep=;` line is understood.
    An apostrophe that guards a text against being run as a formula is taken off.

    Parameters
    ----------
    path : Path
        The file.
    error : type of CucumberVisionError
        What to raise.

    Raises
    ------
    CucumberVisionError
        If the file cannot be read, is empty, or a line has more cells than the head.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "a.csv"
    >>> _ = path.write_bytes(b"\xef\xbb\xbfCapture;length_cm\r\nrow-3;23,5\r\n")
    >>> table = read_table(path)
    >>> table.columns, table.lines[0]
    (('capture', 'length_cm'), Line(number=2, cells={'capture': 'row-3', 'length_cm': '23,5'}))
    """
    text = _text(path, error)
    first, _, rest = text.partition("\n")
    skipped = 0
    if first.strip().strip('"').lower().startswith("sep="):
        text, skipped = rest, 1
        first = rest.partition("\n")[0]
    if not text.strip():
        raise error("the file is empty", source=path, remedy="write a head and a line a length")
    separator = max(SEPARATORS, key=first.count)
    reader = csv.reader(io.StringIO(text), delimiter=separator)
    head = tuple(name.strip().lower() for name in next(reader))
    double = {name for name in head if name and head.count(name) > 1}
    if double:
        raise error(
            f"line {1 + skipped}: column '{min(double)}' is there twice",
            source=path,
            remedy="leave one of them out",
        )
    lines = []
    for cells in reader:
        if not any(cell.strip() for cell in cells):
            continue
        number = reader.line_num + skipped
        if any(cell.strip() for cell in cells[len(head) :]):
            raise error(
                f"line {number} has {len(cells)} cells, the head {len(head)}",
                source=path,
                remedy="put texts that hold the separator in quotes; decimal commas need "
                "semicolons between cells",
            )
        padded = [*cells, *[""] * len(head)]
        lines.append(Line(number, {n: _cell(c) for n, c in zip(head, padded, strict=False)}))
    return Table(head, tuple(lines))


def parse_number(text: str) -> float | None:
    """Read a number with a decimal point or comma; None if it is none or not finite.

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
    return plain[1:] if plain[:1] == "'" and plain[1:2] in FORMULA_STARTS else plain


def _text(path: Path, error: type[CucumberVisionError]) -> str:
    try:
        data = path.read_bytes()
    except OSError as fault:
        raise error(
            f"cannot be read ({fault.strerror})", source=path, remedy="check the path"
        ) from None
    for code in ("utf-16",) if data[:2] in (b"\xff\xfe", b"\xfe\xff") else ("utf-8-sig", "cp1252"):
        try:
            return data.decode(code)
        except UnicodeDecodeError:
            continue
    raise error("is no text", source=path, remedy="save the table as CSV UTF-8")
