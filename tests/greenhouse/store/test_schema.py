"""The tables hold every field of the records, and the rules that the database keeps itself."""

from __future__ import annotations

import re
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import pytest
from sqlalchemy import insert, inspect, select, text

from cucumbervision.errors import StoreError
from cucumbervision_greenhouse.store.engine import begin
from cucumbervision_greenhouse.store.records import (
    CaptureRecord,
    DetectionRecord,
    MethodRecord,
    key_of,
)
from cucumbervision_greenhouse.store.repository import Store
from cucumbervision_greenhouse.store.schema import (
    CAPTURE_CELLS,
    DETECTION_CELLS,
    LENGTH_CELLS,
    METHOD_CELLS,
    Base,
    DetectionLine,
    LinkLine,
    Mark,
)
from cucumbervision_greenhouse.store.views import Verdict

if TYPE_CHECKING:
    from tests.greenhouse.store.conftest import MakeStop

WALK = key_of("walk")


def test_a_database_has_every_table_with_every_column(store: Store) -> None:
    found = inspect(store.engine)
    assert set(found.get_table_names()) >= set(Base.metadata.tables)
    for name, table in Base.metadata.tables.items():
        columns = {column["name"]: column["nullable"] for column in found.get_columns(name)}
        assert columns == {column.name: column.nullable for column in table.columns}


@pytest.mark.parametrize(
    ("record", "cells", "apart"),
    [
        (CaptureRecord, CAPTURE_CELLS, {"color", "depth", "thumbnail", "fruit"}),
        (MethodRecord, METHOD_CELLS, {"path_m", "diameter_m"}),
        (
            DetectionRecord,
            DETECTION_CELLS,
            {"length", "raw_length", "keypoints", "mask", "methods"},
        ),
    ],
)
def test_a_field_of_a_record_is_a_column_or_stored_elsewhere(
    record: type[Any], cells: tuple[str, ...], apart: set[str]
) -> None:
    names = {field.name for field in fields(record)}
    lengths = {*LENGTH_CELLS, *(f"raw_{name}" for name in LENGTH_CELLS)}
    assert names - apart == set(cells) - (lengths if record is DetectionRecord else set())
    assert apart <= names
    assert len(set(cells)) == len(cells)


def test_an_optional_field_may_be_empty_and_others_not() -> None:
    columns = DetectionLine.__table__.columns
    nullable = {name: columns[name].nullable for name in ("score", "flags", "mask_px", "cut_x_m")}
    assert nullable == {"score": False, "flags": False, "mask_px": True, "cut_x_m": True}
    types = [str(columns[name].type) for name in ("score", "mask_px", "label")]
    assert types == ["DOUBLE", "INTEGER", "TEXT"]


@pytest.fixture
def fruit(store: Store, make_stop: MakeStop) -> list[int]:
    """Numbers of two fruit in the database; the first is accepted."""
    store.save_stop(make_stop(1))
    store.set_verdict([store.detections(WALK)[0].key], Verdict.ACCEPTED)
    with begin(store.engine) as connection:
        return list(connection.execute(select(DetectionLine.id)).scalars())


def refused(store: Store, statement: Any) -> str:
    with pytest.raises(StoreError) as told, begin(store.engine, write=True) as connection:
        connection.execute(statement)
    return str(told.value)


def test_a_fruit_has_one_verdict_at_a_time(store: Store, fruit: list[int]) -> None:
    second = {"slot": "verdict", "value": "rejected", "details": {}, "sha256": "", "action_id": 1}
    told = refused(store, insert(Mark).values(fruit_id=fruit[0], **second))
    assert re.search("uq_marks_active|marks.fruit_id, marks.slot", told)
    # Another fruit's, and one after the first has ended, are taken.
    with begin(store.engine, write=True) as connection:
        connection.execute(insert(Mark).values(fruit_id=fruit[1], **second))
        connection.execute(text("UPDATE marks SET ended_by_id = 1"))
        connection.execute(insert(Mark).values(fruit_id=fruit[0], **second))


def test_a_fruit_is_not_linked_to_itself_nor_twice_to_another(
    store: Store, fruit: list[int]
) -> None:
    link: dict[str, Any] = {"kind": "same", "sha256": "", "first_round_id": 1, "second_round_id": 1}
    first, second = fruit
    assert "ck_links_two" in refused(
        store, insert(LinkLine).values(first_id=first, second_id=first, **link)
    )
    pair = insert(LinkLine).values(first_id=first, second_id=second, **link)
    with begin(store.engine, write=True) as connection:
        connection.execute(pair)
    assert re.search("uq_links_active|links.first_id, links.second_id", refused(store, pair))


def test_a_line_of_nothing_that_is_there_is_refused(store: Store, fruit: list[int]) -> None:
    told = refused(store, text("UPDATE fruit SET round_id = 999"))
    assert "foreign key" in told.lower()
    assert len(fruit) == 2
