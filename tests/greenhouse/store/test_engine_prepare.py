from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
from sqlalchemy import inspect, text

from cucumbervision.errors import StoreError, StoreVersionError
from cucumbervision.methods.result import Length
from cucumbervision_greenhouse.store.engine import VERSION_TABLE, begin, database_url, make_engine
from cucumbervision_greenhouse.store.records import (
    CaptureRecord,
    FruitRow,
    Round,
    StopRecord,
    key_of,
)
from cucumbervision_greenhouse.store.repository import open_store
from cucumbervision_greenhouse.store.schema import VERSION


def test_a_store_of_another_version_is_refused_and_stays_as_it_is(address: str) -> None:
    with open_store(address) as store, begin(store.engine, write=True) as connection:
        connection.execute(text(f"UPDATE {VERSION_TABLE} SET version = '999'"))
    with pytest.raises(
        StoreVersionError, match=f"has schema 999, .* schema 3 to {VERSION}; use the version"
    ):
        open_store(address)
    engine = make_engine(database_url(address))
    with begin(engine) as connection:
        found = connection.execute(text(f"SELECT version FROM {VERSION_TABLE}")).scalar()
    engine.dispose()
    assert found == "999"


def test_another_programs_tables_are_left_alone(address: str) -> None:
    engine = make_engine(database_url(address))
    with begin(engine, write=True) as connection:
        connection.execute(text("CREATE TABLE fruit (name TEXT)"))
        connection.execute(text("INSERT INTO fruit VALUES ('pear')"))
    with pytest.raises(StoreError, match=r"tables of another program \(fruit\); name another"):
        open_store(address)
    with begin(engine) as connection:
        assert connection.execute(text("SELECT name FROM fruit")).scalar() == "pear"
        assert inspect(connection).get_table_names() == ["fruit"]
    engine.dispose()


def test_several_may_open_a_new_store_at_once(address: str) -> None:
    with ThreadPoolExecutor(4) as pool:
        for store in pool.map(lambda _: open_store(address), range(4)):
            assert store.rounds() == []
            store.close()


def test_a_new_field_of_a_record_gets_its_column(address: str) -> None:
    walk, stop = Round(key_of("walk")), key_of("stop")
    capture = CaptureRecord("a", fruit=(FruitRow(1, length=Length(0.3), tilt_deg=4.0),))
    with open_store(address) as store:
        store.save_round(walk)
        store.save_stop(StopRecord(stop, walk.key, captures=(capture,)))
        # As if the software that made the store had not known this trait.
        with begin(store.engine, write=True) as connection:
            connection.execute(text("ALTER TABLE fruit DROP COLUMN tilt_deg"))
    with open_store(address) as store:
        [old] = store.detections(walk.key)
        assert (old.length_m, old.tilt_deg) == (0.3, None)
        again = replace(capture, fruit=(FruitRow(1, tilt_deg=5.0),))
        store.save_stop(StopRecord(key_of("next"), walk.key, captures=(again,)))
        assert store.detections(walk.key)[1].tilt_deg == 5.0
