"""The fields of a fruit's row: name, unit, type, description and path to the value."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, TypeAlias, cast

import numpy as np
from pydantic import BaseModel, create_model
from pydantic import Field as Described

from cucumbervision.arrays import Array
from cucumbervision.capture.frames import Capture
from cucumbervision.methods.flags import SHOWS_LESS
from cucumbervision.methods.result import Fruit, IntervalBasis, Length, LengthDefinition, LengthKind
from cucumbervision.methods.table import Trait
from cucumbervision.plugins import Plugin, own

Cell: TypeAlias = str | int | float | bool | None
CellType: TypeAlias = Literal["text", "whole", "number", "yes/no"]


# By unit of the tables: the SI unit, its conversion factor, and the decimals that are written.
_UNITS = {
    "cm": ("m", 100.0, 3),
    "mm": ("m", 1e3, 2),
    "mm2": ("m2", 1e6, 2),
    "ml": ("m3", 1e6, 1),
    "g": ("kg", 1e3, 1),
}
_PLAIN: tuple[str, float, int | None] = ("", 1.0, None)
_STORED_DIGITS = 9


_PYTHON: dict[str, type] = {"text": str, "whole": int, "number": float, "yes/no": bool}


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Parameters
    ----------
    name : str
        Name in CSV, Parquet and JSON; ends with the unit, if there is one.
    unit : str
        The unit; empty if there is none.
    type : {'text', 'whole', 'number', 'yes/no'}
        Type of its cells, each of which may also be empty.
    says : str
        Description for people.

    Examples
    --------
    >>> column = Column("volume_ml", "ml", "number", "volume of the fitted tube")
    >>> column.title, column.si_name, column.cell(0.00025128)
    ('volume [ml]', 'volume_m3', 251.3)
    """

    name: str
    unit: str
    type: CellType
    says: str

    @property
    def title(self) -> str:
        """The heading for people, with the unit."""
        plain = self.name.removesuffix(f"_{self.unit}") if self.unit else self.name
        words = plain.replace("_", " ")
        return f"{words} [{self.unit}]" if self.unit else words

    @property
    def si_name(self) -> str:
        """The name in the store, with the SI unit instead of the unit of the tables."""
        si, _, _ = self._scale
        return f"{self.name.removesuffix(self.unit)}{si}" if si else self.name

    @property
    def python_type(self) -> Any:
        """The type of its cells in Python."""
        return _PYTHON[self.type]

    @property
    def _scale(self) -> tuple[str, float, int | None]:
        # A ratio per 10 cm has no SI unit.
        scaled = self.name.endswith(f"_{self.unit}")
        return _UNITS.get(self.unit, _PLAIN) if scaled else _PLAIN

    def cell(self, value: Any, digits: int | None = None) -> Any:
        """Return an SI value in the column's unit, rounded to `digits` or as usual for the unit."""
        _, scale, usual = self._scale
        digits = usual if digits is None else digits
        if value is None or digits is None:
            return value
        return round(scale * value, digits)


@dataclass(frozen=True)
class Field(Column):
    """A column, and the path to its value in the record of a row (of a fruit: `_line`).

    Parameters
    ----------
    name, unit, type, says
        As in `Column`.
    path : str
        Attributes, keys and indices that lead to the value in SI units, joined by dots. The cell
        is empty if a part of the path is None.
    digits : int, optional
        Number of decimals; by default that of the unit.
    owner : {'fruit', 'capture', 'stop', 'store'}
        What it is a property of; 'store': of the fruit, in a store and not in the tables.

    Examples
    --------
    >>> chord = Field("chord_cm", "cm", "number", "straight", "record.chord_m")
    >>> chord.of({"record": {"chord_m": 0.31234567}}), chord.of({"record": None})
    (31.235, None)
    """

    path: str
    digits: int | None = None
    owner: str = "fruit"

    def value(self, line: Any) -> Any:
        """Return the value in SI units, or None."""
        value = line
        for part in self.path.split("."):
            if value is None:
                return None
            if isinstance(value, Mapping):
                value = value.get(part)
            else:
                value = value[int(part)] if part.isdigit() else getattr(value, part)
        return value

    def of(self, line: Any) -> Cell:
        """Return the cell of a table: in `unit`, rounded, of the column's type; times in UTC."""
        cell = self.cell(self.value(line), self.digits)
        if cell is None or cell != cell:  # not a number
            return None
        if self.name.endswith("_utc") and not isinstance(cell, str):
            return utc(cell)
        of_type: Cell = self.python_type(cell)
        return of_type

    def stored(self, line: Any) -> Cell:
        """Return the cell of a store: in SI units, of the column's type."""
        value = self.value(line)
        if value is None or value != value:
            return None
        cell: Cell = self.python_type(value)
        digits = _STORED_DIGITS if self._scale[0] else self.digits
        return round(cell, digits) if isinstance(cell, float) and digits is not None else cell


def read_fields(path: Path) -> list[tuple[dict[str, str], Field]]:
    """Return the fields that a CSV file describes, each with its line.

    Parameters
    ----------
    path : Path
        CSV with the columns name, unit, type, digits, says and path; without a path it is the name.
        A column `of` is the `owner`.
    """
    fields = []
    for line in csv.DictReader(path.read_text(encoding="utf-8").splitlines()):
        digits = int(line["digits"]) if line["digits"] else None
        description = line["name"], line["unit"], cast("CellType", line["type"]), line["says"]
        path_to_value, owner = line["path"] or line["name"], line.get("of", "fruit")
        fields.append((line, Field(*description, path_to_value, digits, owner)))
    return fields


_METHOD, _TRAIT = "{method}_cm", "{trait}"  # names of the lines that stand for all of them
_TRAIT_DIGITS = 4  # of one without a unit that the tables round


_LINES = [line for _, line in read_fields(Path(__file__).with_name("fields.csv"))]
_LINE_OF_METHODS = next(line for line in _LINES if line.name == _METHOD)


def method_field(method: str) -> Field:
    """Return the column of a method: the line of the table that stands for all, with its name."""
    line = _LINE_OF_METHODS
    return replace(
        line,
        name=line.name.format(method=method.lower()),
        says=line.says.format(method=method),
        path=line.path.format(method=method),
    )


def trait_field(plugin: Plugin, trait: Trait) -> Field:
    """Return the column of a trait.

    Raises
    ------
    PluginError
        If it does not say its unit and meaning, or a column cannot have its name.
    """
    unit, says = getattr(trait, "unit", None), getattr(trait, "says", None)
    if not isinstance(unit, str) or not isinstance(says, str):
        raise plugin.error("is no trait: it has no texts `unit` and `says`")
    name = plugin.name
    if not name.isidentifier() or name != name.lower() or (unit and not name.endswith(f"_{unit}")):
        raise plugin.error("is called as no column: lower case letters, then _ and the unit")
    digits = None if unit in _UNITS else _TRAIT_DIGITS
    path = f"fruit.trait_values.{plugin.name}.value"
    return Field(plugin.name, unit, "number", says, path, digits)


def _fields() -> tuple[Field, ...]:
    table: list[Field] = []
    for line in _LINES:
        if line.name == _METHOD:
            table += [method_field(name) for name in own("methods")]
        elif line.name == _TRAIT:
            table += [trait_field(plugin, plugin.load()) for plugin in own("traits").values()]
        else:
            table.append(line)
    return tuple(table)


ALL_FIELDS = _fields()
"""Every column of a fruit's row, as the package itself fills them."""

FIELDS = tuple(column for column in ALL_FIELDS if column.owner != "store")
"""The columns of `measurements.csv`, in order."""

STORED_FIELDS = tuple(column for column in ALL_FIELDS if column.owner in ("fruit", "store"))
"""The columns of a store's table of fruit: all but those of the capture and its stop."""


def fields_with(
    methods: Iterable[str], traits: Iterable[tuple[Plugin, Trait]]
) -> tuple[Field, ...]:
    """Return the columns of a run: `FIELDS`, then those of other packages' methods and traits."""
    names = {field.name for field in FIELDS}
    added = [method_field(name) for name in methods]
    added += [trait_field(plugin, trait) for plugin, trait in traits]
    return (*FIELDS, *{field.name: field for field in added if field.name not in names}.values())


def fruit_row(
    capture: Capture, number: int, fruit: Fruit, fields: Iterable[Field] = FIELDS
) -> dict[str, Cell]:
    """Return the row of a capture's fruit by its number from 1, in the units of the tables."""
    line = _line(capture, number, fruit)
    return {column.name: column.of(line) for column in fields}


def stored_row(
    capture: Capture, number: int, fruit: Fruit, fields: Iterable[Field] = STORED_FIELDS
) -> dict[str, Cell]:
    """Return a fruit's row in SI units, by `Column.si_name`, as a store keeps it."""
    line = _line(capture, number, fruit)
    return {column.si_name: column.stored(line) for column in fields}


def table_row(stored: Mapping[str, Cell], fields: Iterable[Field] = FIELDS) -> dict[str, Cell]:
    """Return a row of a store in the units of the tables; a column that it lacks is empty.

    Examples
    --------
    >>> row = table_row({"length_m": 0.1622941, "method": "M6"})
    >>> row["length_cm"], row["method"], row["flags"]
    (16.229, 'M6', None)
    """
    return {
        column.name: column.cell(stored.get(column.si_name), column.digits) for column in fields
    }


def stored_length(stored: Mapping[str, Any], before: str = "") -> Length | None:
    """Return the length of a row of a store; `before='raw_'` for that before the calibration.

    Examples
    --------
    >>> row = {"length_m": 0.3, "length_kind": "centreline", "interval_low_m": 0.29}
    >>> stored_length(row | {"interval_high_m": 0.31}).kind
    <LengthDefinition.CENTRELINE: 'centreline'>
    """
    value_m = stored[f"{before}length_m"]
    if value_m is None:
        return None
    kind = stored[f"{before}length_kind"]
    low_m, high_m, of, basis = (
        stored.get(f"{before}interval_{part}") for part in ("low_m", "high_m", "of", "basis")
    )
    return Length(
        value_m,
        LengthDefinition(kind) if kind in tuple(LengthDefinition) else LengthKind(kind),
        low_m,
        high_m,
        of and LengthDefinition(of),
        basis and IntervalBasis(basis),
    )


def _line(capture: Capture, number: int, fruit: Fruit) -> dict[str, Any]:
    """Return what the paths of `fields.csv` lead through."""
    box = dict(zip(("x1", "y1", "x2", "y2"), fruit.instance.box.tolist(), strict=True))
    return {
        "capture": capture,
        "number": number,
        "fruit": fruit,
        "fallback": " > ".join(fruit.fallback),
        "flags": " ".join(fruit.flags),
        "box": box,
        "mask_px": None if fruit.mask is None else np.count_nonzero(fruit.mask),
        "centre_m": _centre_m(capture, fruit),
        "view_score": _view_score(fruit),
    }


def _centre_m(capture: Capture, fruit: Fruit) -> Array | None:
    """Return the middle of the measured line, or of the box at the fruit's distance."""
    path = None if fruit.selected is None else fruit.selected.path_m
    if path is not None and len(path):
        return np.asarray(path.mean(axis=0))
    if fruit.distance_m is None:
        return None
    left, top, right, bottom = fruit.instance.box
    x, y = capture.intrinsics.rays((left + right) / 2, (top + bottom) / 2)
    return fruit.distance_m * np.array([float(x), float(y), 1.0])


def _view_score(fruit: Fruit) -> float:
    """Return how well a view shows its fruit, 0 to 1; 0 where nothing was measured.

    The detector's confidence times the share of readings in the mask times the share that
    nothing hides; half of that without a fitted tube, and half again for each flag that
    questions it. An order among views of one fruit, and no probability.
    """
    if fruit.selected is None:
        return 0.0
    hidden = 0.0 if fruit.fit is None else fruit.fit.hidden_share
    score = fruit.instance.confidence * (fruit.fill or 0.0) * (1.0 - hidden)
    return float(score * 0.5 ** (len(SHOWS_LESS & set(fruit.flags)) + (fruit.fit is None)))


def row_model(name: str, fields: Iterable[Field], **extra_fields: Any) -> type[BaseModel]:
    """Return the pydantic model of a JSON object with these fields, any of which may be missing.

    Parameters
    ----------
    name : str
        Name of the model.
    fields : iterable of Field
        Fields of the object.
    **extra_fields
        Further members, as in `pydantic.create_model`.

    Examples
    --------
    >>> schema = row_model("Row", FIELDS[:3]).model_json_schema()
    >>> list(schema["properties"]), schema["properties"]["fruit"]["description"]
    (['capture', 'frame', 'fruit'], 'number of the fruit in the capture, from 1')
    """
    cells: dict[str, Any] = {
        row_field.name: (row_field.python_type | None, Described(None, description=row_field.says))
        for row_field in fields
    }
    # Columns of other packages come with the rows.
    return create_model(name, __config__={"extra": "allow"}, **cells, **extra_fields)


def utc(seconds: float) -> str:
    """Return a time as people and programs read it.

    Examples
    --------
    >>> utc(86400.5)
    '1970-01-02T00:00:00Z'
    """
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
