from __future__ import annotations

import sqlite3
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import inspect, text

from cucumbervision.errors import StoreError, StoreVersionError
from cucumbervision.store.engine import (
    HEAD,
    MIGRATIONS,
    REVISIONS,
    VERSION_TABLE,
    begin,
    database_url,
    make_engine,
    stored_revision,
)
from cucumbervision.store.records import (
    CaptureRecord,
    DetectionRecord,
    RoundRecord,
    StopRecord,
    key_of,
)
from cucumbervision.store.repository import open_store
from cucumbervision.store.schema import Base
from cucumbervision.store.views import Verdict


def test_the_known_revisions_are_those_of_the_files() -> None:
    scripts = ScriptDirectory(str(MIGRATIONS))
    assert scripts.get_heads() == [HEAD]
    assert [s.revision for s in reversed(list(scripts.walk_revisions()))] == list(REVISIONS)


def test_the_migrations_make_the_tables_that_the_code_speaks_of(address: str) -> None:
    with open_store(address) as store, store.engine.connect() as connection:
        options = {"version_table": VERSION_TABLE, "compare_type": True}
        context = MigrationContext.configure(connection, opts=options)
        assert compare_metadata(context, Base.metadata) == []
        assert set(inspect(connection).get_table_names()) == {*Base.metadata.tables, VERSION_TABLE}


def test_a_newer_store_is_refused_and_stays_as_it_is(address: str) -> None:
    with open_store(address) as store, begin(store.engine, write=True) as connection:
        connection.execute(text(f"UPDATE {VERSION_TABLE} SET version_num = '0999'"))
    with pytest.raises(StoreVersionError, match=f"0999 is newer .* {HEAD}; update cucumbervision"):
        open_store(address)
    engine = make_engine(database_url(address))
    with begin(engine) as connection:
        found = connection.execute(text(f"SELECT version_num FROM {VERSION_TABLE}")).scalar()
    engine.dispose()
    assert found == "0999"


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


def test_what_fails_half_way_leaves_nothing_behind(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The last table of all cannot be made: all before it must go again.
    engine = make_engine(database_url(address))
    with begin(engine, write=True) as connection:
        connection.execute(text("CREATE TABLE links (name TEXT)"))
    monkeypatch.setattr("cucumbervision.store.engine._check_free", lambda *_: None)
    with pytest.raises(StoreError, match="already exists"):
        open_store(address)
    with begin(engine) as connection:
        assert inspect(connection).get_table_names() == ["links"]
    engine.dispose()


def test_several_may_open_a_new_store_at_once(address: str) -> None:
    with ThreadPoolExecutor(4) as pool:
        for store in pool.map(lambda _: open_store(address), range(4)):
            assert store.rounds() == []
            store.close()


def test_an_empty_file_becomes_a_store(tmp_path: Path) -> None:
    (tmp_path / "a.db").touch()
    with open_store(tmp_path / "a.db") as store:
        assert store.rounds() == []


def test_a_new_field_of_a_record_gets_its_column(address: str) -> None:
    walk, stop = RoundRecord(key_of("walk")), key_of("stop")
    capture = CaptureRecord("a", fruit=(DetectionRecord(1, length_m=0.3, tilt_deg=4.0),))
    with open_store(address) as store:
        store.save_round(walk)
        store.save_stop(StopRecord(stop, walk.key, captures=(capture,)))
        # As if the software that made the store had not known this trait.
        with begin(store.engine, write=True) as connection:
            connection.execute(text("ALTER TABLE fruit DROP COLUMN tilt_deg"))
    with open_store(address) as store:
        [old] = store.detections(walk.key)
        assert (old.record.length_m, old.record.tilt_deg) == (0.3, None)
        again = replace(capture, fruit=(DetectionRecord(1, tilt_deg=5.0),))
        store.save_stop(StopRecord(key_of("next"), walk.key, captures=(again,)))
        assert store.detections(walk.key)[1].record.tilt_deg == 5.0


def test_a_store_of_the_first_version_keeps_its_stops_and_fruit(tmp_path: Path) -> None:
    path, walk = tmp_path / "house.db", key_of("walk")
    with closing(sqlite3.connect(path)) as raw:
        raw.executescript(Path(__file__).with_name("version_1.sql").read_text())
    with open_store(path) as store:
        stops, fruit = store.stops(walk), store.detections(walk)
        assert [(one.step, one.position_m, one.fruit, one.mirrored) for one in stops] == [
            (0, 0.0, 2, False),
            (1, 0.4, 2, False),
        ]
        assert [one.record.length_m for one in fruit] == pytest.approx([0.21, 0.22] * 2)
        assert [one.verdict for one in fruit] == [Verdict.REJECTED, None, None, None]
        assert [one.views for one in fruit] == [1, 2, 2, 1]
        first = store.stop(stops[0].key).captures[0].fruit[0]
        assert first.methods[1].path_m == ((0.0, 0.1, 0.5), (0.2, 0.1, 0.5))
        # What the newer tables are for works on the old lines, and so does taking it back.
        number = store.delete_stop(stops[1].key)
        assert [one.key for one in store.stops(walk)] == [stops[0].key]
        store.undo(number=number)
        assert store.detections(walk) == fruit
        with begin(store.engine) as connection:
            assert stored_revision(connection) == HEAD
