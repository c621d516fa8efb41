"""Records as lines of tables, and back."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from cucumbervision.errors import StoreError
from cucumbervision.store.records import (
    CaptureRecord,
    FruitRecord,
    ImageRef,
    MethodRecord,
    Point,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from sqlalchemy import Connection

__all__ = [
    "CAPTURE_CELLS",
    "FRUIT_CELLS",
    "METHOD_CELLS",
    "built",
    "cells_of",
    "fruit_from_json",
    "image_ref",
    "pack_um",
    "points",
    "simple_cells",
    "unpack_um",
]

T = TypeVar("T")

_REACH_M = 2000.0  # what 32 bits of micrometres hold, with room to spare

# Fields that are columns as they stand, in the order of the dataclass.
FRUIT_CELLS = tuple(f.name for f in fields(FruitRecord))[:-3]
METHOD_CELLS = tuple(f.name for f in fields(MethodRecord))[:-2]
CAPTURE_CELLS = tuple(f.name for f in fields(CaptureRecord))[:-4]


def simple_cells(record: Any, names: Sequence[str]) -> dict[str, Any]:
    """Give some fields of a record by name.

    Examples
    --------
    >>> simple_cells(MethodRecord("M1", 0.2), ("method", "length_m"))
    {'method': 'M1', 'length_m': 0.2}
    """
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
        raise StoreError("a path holds a number that is no position", remedy="give metres")
    return np.rint(values * 1e6).astype("<i4").tobytes()


def unpack_um(data: bytes) -> tuple[float, ...]:
    """Give metres from what `pack_um` packed."""
    return tuple((np.frombuffer(data, "<i4") / 1e6).tolist())


def points(data: bytes) -> tuple[Point, ...]:
    """Give points (x, y, z) in metres from what `pack_um` packed."""
    flat = unpack_um(data)
    return tuple(zip(flat[0::3], flat[1::3], flat[2::3], strict=True))


def fruit_from_json(values: Mapping[str, Any]) -> FruitRecord:
    """Give a fruit from what `record_json` made of it.

    Examples
    --------
    >>> from cucumbervision.store.records import record_json
    >>> fruit = FruitRecord(1, methods=(MethodRecord("M1", 0.2, path_m=((0.0, 0.0, 1.0),)),))
    >>> fruit_from_json(record_json(fruit)) == fruit
    True
    """
    methods = tuple(
        MethodRecord(
            **{
                **method,
                "path_m": tuple(tuple(point) for point in method["path_m"]),
                "diameter_m": tuple(method["diameter_m"]),
            }
        )
        for method in values["methods"]
    )
    keypoints = tuple(tuple(point) for point in values["keypoints"])
    return FruitRecord(**{**values, "methods": methods, "keypoints": keypoints})


def cells_of(connection: Connection, query: Any) -> list[tuple[Any, ...]]:
    """Run a query and give its lines as plain cells."""
    return cast("list[tuple[Any, ...]]", connection.execute(query).all())


def built(kind: type[T], *cells: Any) -> T:
    """Make a record from its fields in order.

    Examples
    --------
    >>> built(MethodRecord, "M1", 0.2).length_m
    0.2
    """
    make: Callable[..., T] = kind
    return make(*cells)


def image_ref(cells: Sequence[Any]) -> ImageRef | None:
    """Give a picture from its five cells, or None where the first is empty."""
    return None if cells[0] is None else ImageRef(*cells)
