"""Convert values to table cells and back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np
from sqlalchemy import insert, select, update
from sqlalchemy.dialects import postgresql, sqlite

from cucumbervision.errors import StoreError, wrap_reader_errors
from cucumbervision.files import adapter
from cucumbervision.measurement.result import IntervalBasis, Length, LengthDefinition, LengthKind
from cucumbervision_greenhouse.store.engine import named
from cucumbervision_greenhouse.store.records import DetectionRecord, ImageRef, Point, checked_key
from cucumbervision_greenhouse.store.schema import (
    DETECTION_CELLS,
    LENGTH_CELLS,
    RAW_LENGTH_CELLS,
    Base,
    RoundLine,
    Row,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from contextlib import AbstractContextManager

    from sqlalchemy import Connection

T = TypeVar("T")

_KINDS: dict[Any, Any] = {str(kind): kind for kind in (*LengthKind, *LengthDefinition)}
_BASES = {str(basis): basis for basis in IntervalBasis}

_REACH_M = 2000.0  # what 32 bits of micrometres hold, with room to spare


def columns_of(table: type[Base], names: Sequence[str]) -> list[Any]:
    """Return a table's columns of these names, for a query."""
    return [getattr(table, name) for name in names]


def cells_by_name(record: Any, names: Sequence[str]) -> dict[str, Any]:
    """Return fields of a record as cells by their names."""
    return {name: getattr(record, name) for name in names}


def pack_um(values_m: Sequence[float] | Sequence[Point]) -> bytes:
    """Pack lengths as whole micrometres: little-endian, 32 bits each.

    Raises
    ------
    StoreError
        If one is not finite or beyond 2 km.

    Examples
    --------
    >>> unpack_um(pack_um([0.1234567, -0.5]))
    (0.123457, -0.5)
    """
    values = np.asarray(values_m, np.float64).ravel()
    if not (np.abs(values) < _REACH_M).all():
        raise StoreError("a path holds a number that is not a position", remedy="give metres")
    return np.rint(values * 1e6).astype("<i4").tobytes()


def unpack_um(data: bytes) -> tuple[float, ...]:
    """Return metres from what `pack_um` packed."""
    return tuple((np.frombuffer(data, "<i4") / 1e6).tolist())


def points(data: bytes) -> tuple[Point, ...]:
    """Return points (x, y, z) in metres from what `pack_um` packed."""
    flat = unpack_um(data)
    return tuple(zip(flat[0::3], flat[1::3], flat[2::3], strict=True))


def detection_from_json(values: Mapping[str, Any]) -> DetectionRecord:
    """Return the detection that `record_json` was given.

    Raises
    ------
    ValidationError
        If a value is not of its field's kind.

    Examples
    --------
    >>> from cucumbervision_greenhouse.store.records import MethodRecord, record_json
    >>> fruit = DetectionRecord(1, methods=(MethodRecord("M1", 0.2, path_m=((0.0, 0.0, 1.0),)),))
    >>> detection_from_json(record_json(fruit)) == fruit
    True
    """
    record: DetectionRecord = adapter(DetectionRecord).validate_python(values)
    return record


def decoding(connection: Connection) -> AbstractContextManager[None]:
    """Report any error in the block as damaged data; for code that only reads cells.

    Raises
    ------
    StoreError
        For any error but a named one.
    """
    remedy = "copy the database away, and check it with `round check`"
    return wrap_reader_errors(named(connection.engine.url), StoreError, remedy)


def cells_of(connection: Connection, query: Any) -> list[tuple[Any, ...]]:
    """Run a query and return its rows as plain tuples."""
    return cast("list[tuple[Any, ...]]", connection.execute(query).all())


def change(connection: Connection, table: Any, which: Any, **values: Any) -> int:
    """Change lines of a table, and return how many there were."""
    return connection.execute(update(table).where(which).values(**values)).rowcount


def record_of(kind: type[T], *cells: Any) -> T:
    """Make a record from its fields in order.

    Examples
    --------
    >>> from cucumbervision_greenhouse.store.records import MethodRecord
    >>> record_of(MethodRecord, "M1", 0.2).length_m
    0.2
    """
    make: Callable[..., T] = kind
    return make(*cells)


def detection_cells(record: DetectionRecord) -> dict[str, Any]:
    """Return a detection's cells by the names of `DETECTION_CELLS`."""
    cells = {name: getattr(record, name, None) for name in DETECTION_CELLS}
    for names, length in ((LENGTH_CELLS, record.length), (RAW_LENGTH_CELLS, record.raw_length)):
        values = vars(length).values() if length is not None else ()
        cells |= zip(names, (str(v) if isinstance(v, str) else v for v in values), strict=False)
    return cells


def detection_of(cells: Sequence[Any], *further: Any) -> DetectionRecord:
    """Return a detection from its cells in the order of `DETECTION_CELLS`, and its last fields.

    Examples
    --------
    >>> fruit = DetectionRecord(1, length=Length(0.3, low_m=0.29, high_m=0.31))
    >>> detection_of(list(detection_cells(fruit).values())) == fruit
    True
    """
    raw, length = -len(RAW_LENGTH_CELLS), -len(RAW_LENGTH_CELLS) - len(LENGTH_CELLS)
    lengths = _length_of(*cells[length:raw]), _length_of(*cells[raw:])
    return record_of(DetectionRecord, *cells[:length], *lengths, *further)


def _length_of(
    value_m: float | None,
    kind: str | None,
    low_m: float | None = None,
    high_m: float | None = None,
    definition: str | None = None,
    basis: str | None = None,
) -> Length | None:
    if value_m is None:
        return None
    length_definition: Any = None if definition is None else _KINDS[definition]
    return Length(
        value_m=value_m,
        kind=_KINDS[kind],
        low_m=low_m,
        high_m=high_m,
        interval_of=length_definition,
        basis=None if basis is None else _BASES[basis],
    )


def image_ref(cells: Sequence[Any]) -> ImageRef | None:
    """Return a picture from its five cells, or None where the first is empty."""
    return None if cells[0] is None else ImageRef(*cells)


def insert_new(
    connection: Connection, table: type[Base], cells: dict[str, Any], *unique: str
) -> int | None:
    """Insert one line and return its id; None where one with that key is there already.

    Where another transaction is just inserting the same key, PostgreSQL waits for its end.
    """
    dialect = sqlite if connection.dialect.name == "sqlite" else postgresql
    line = dialect.insert(table).values(**cells).on_conflict_do_nothing(index_elements=unique)
    key: Any = next(iter(table.__table__.primary_key))
    return cast("int | None", connection.execute(line.returning(key)).scalar())


def id_of(connection: Connection, table: Any, cells: dict[str, Any], *unique: str) -> int:
    """Return the id of the line with these cells, inserted where it is not there yet."""
    query = select(table.id).where(*(getattr(table, name) == cells[name] for name in unique))
    line_id = connection.execute(query).scalar()
    if line_id is None:
        line_id = insert_new(connection, table, cells, *unique)
    return cast("int", connection.execute(query).scalar_one() if line_id is None else line_id)


def row_id_of(connection: Connection, round_id: int, name: str) -> int:
    """Return the id of a row of a round's house, inserted where it is not there yet."""
    house = connection.execute(select(RoundLine.house).where(RoundLine.id == round_id)).scalar_one()
    return id_of(connection, Row, {"house": house, "name": name}, "house", "name")


def insert_all(connection: Connection, table: type[Base], lines: list[dict[str, Any]]) -> None:
    """Insert lines, if there are any."""
    if lines:
        connection.execute(insert(table), lines)


def round_id_of(connection: Connection, key: str, *, remedy: str = "see `round list`") -> int:
    """Return a round's number in the tables.

    Parameters
    ----------
    connection : Connection
        Of the store.
    key : str
        Key of the round.
    remedy : str
        What to do where it is not there.

    Raises
    ------
    StoreError
        If it is not there.
    """
    query = select(RoundLine.id).where(RoundLine.key == checked_key(key, "round"))
    line_id = connection.execute(query).scalar()
    if line_id is None:
        raise StoreError("round {key} is not in the store", remedy=remedy, key=key)
    return line_id
