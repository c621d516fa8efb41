"""The fields of a fruit's row: name, unit, type, description and path to the value."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, cast

import numpy as np
from pydantic import BaseModel, create_model
from pydantic import Field as Described

from cucumbervision.plugins import own

if TYPE_CHECKING:
    from cucumbervision.capture.frames import Capture
    from cucumbervision.measurement.result import FruitMeasurement
    from cucumbervision.plugins import Plugin
    from cucumbervision.protocols import Trait

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


_PYTHON: dict[str, type[str | int | float | bool]] = {
    "text": str,
    "whole": int,
    "number": float,
    "yes/no": bool,
}


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
    """A column, and the path to its value in a `NumberedFruit` (for the table of fruit).

    Parameters
    ----------
    name, unit, type, says
        As in `Column`.
    path : str
        Attributes, keys and indices that lead to the value in SI units, joined by dots. The cell
        is empty if a part of the path is None.
    digits : int, optional
        Number of decimals; by default that of the unit.

    Examples
    --------
    >>> chord = Field("chord_cm", "cm", "number", "straight", "record.chord_m")
    >>> chord.of({"record": {"chord_m": 0.31234567}}), chord.of({"record": None})
    (31.235, None)
    """

    path: str
    digits: int | None = None

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
        return _PYTHON[self.type](cell)

    def stored(self, line: Any) -> Cell:
        """Return the cell of the store: in SI units."""
        value: Cell = self.value(line)
        if isinstance(value, str):
            return str(value)
        if isinstance(value, float):
            value = float(value)  # of an array
        digits = _STORED_DIGITS if self._scale[0] else self.digits
        return value if digits is None or value is None else round(value, digits)


@dataclass(frozen=True, eq=False)
class NumberedFruit:
    """One fruit of one capture: the source of a row.

    Parameters
    ----------
    capture : Capture
        The frame.
    number : int
        The fruit's number in it, from 1.
    fruit : FruitMeasurement
        The fruit.
    """

    capture: Capture
    number: int
    fruit: FruitMeasurement

    @property
    def fallback(self) -> str:
        """The methods tried before, as one text."""
        return " > ".join(self.fruit.fallback)

    @property
    def flags(self) -> str:
        """The flags, as one text."""
        return " ".join(self.fruit.flags)

    @property
    def box(self) -> dict[str, float]:
        """The edges of the box, pixels."""
        edges = self.fruit.instance.box.tolist()
        return dict(zip(("x1", "y1", "x2", "y2"), edges, strict=True))

    @property
    def mask_px(self) -> int | None:
        """Number of pixels of the measured mask."""
        return None if self.fruit.mask is None else int(np.count_nonzero(self.fruit.mask))


def read_fields(path: Path) -> list[tuple[dict[str, str], Field]]:
    """Return the fields that a CSV file describes, each with its line.

    Parameters
    ----------
    path : Path
        CSV with the columns name, unit, type, digits, says and path; without a path it is the name.
    """
    fields = []
    for line in csv.DictReader(path.read_text(encoding="utf-8").splitlines()):
        digits = int(line["digits"]) if line["digits"] else None
        description = line["name"], line["unit"], cast("CellType", line["type"]), line["says"]
        fields.append((line, Field(*description, line["path"] or line["name"], digits)))
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


FIELDS = _fields()
"""The columns of `measurements.csv`, in order, as the package itself fills them."""


def fields_with(
    methods: Iterable[str], traits: Iterable[tuple[Plugin, Trait]]
) -> tuple[Field, ...]:
    """Return the columns of a run: `FIELDS`, then those of other packages' methods and traits."""
    names = {field.name for field in FIELDS}
    added = [method_field(name) for name in methods]
    added += [trait_field(plugin, trait) for plugin, trait in traits]
    return (*FIELDS, *{field.name: field for field in added if field.name not in names}.values())


def fruit_row(fruit: NumberedFruit, fields: Iterable[Field] = FIELDS) -> dict[str, Cell]:
    """Return a fruit's row: a cell for every field, in the units of the tables."""
    return {fruit_field.name: fruit_field.of(fruit) for fruit_field in fields}


def si_values(fruit: NumberedFruit) -> dict[str, Cell]:
    """Return the values of a fruit in SI units, by `Column.si_name`."""
    return {fruit_field.si_name: fruit_field.stored(fruit) for fruit_field in FIELDS}


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
        row_field.name: (
            _PYTHON[row_field.type] | None,
            Described(None, description=row_field.says),
        )
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
