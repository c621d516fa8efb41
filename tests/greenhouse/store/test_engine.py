from __future__ import annotations

import os
import sqlite3
import tempfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from threading import Timer

import pytest
from sqlalchemy import inspect, text
from sqlalchemy.exc import OperationalError

from cucumbervision.errors import (
    CucumberVisionError,
    DiskFullError,
    StoreAwayError,
    StoreError,
    StoreVersionError,
)
from cucumbervision.methods.result import Length
from cucumbervision_greenhouse.store.engine import (
    VERSION_TABLE,
    begin,
    database_url,
    make_engine,
    named,
)
from cucumbervision_greenhouse.store.records import (
    CaptureRecord,
    FruitRow,
    Round,
    StopRecord,
    key_of,
)
from cucumbervision_greenhouse.store.repository import open_store
from cucumbervision_greenhouse.store.schema import VERSION


@pytest.mark.parametrize("where", ["", ":memory:", "sqlite://", "mysql://u@h/d", "http://x", "://"])
def test_what_is_no_place_for_a_store_is_refused(where: str) -> None:
    with pytest.raises(StoreError, match="give the path of a file, or postgresql"):
        database_url(where)


def test_a_password_is_never_shown() -> None:
    url = database_url("postgresql://u:secret@127.0.0.1:1/d")
    assert "secret" not in named(url)
    pytest.importorskip("psycopg")
    with pytest.raises(StoreError) as refused:
        open_store("postgresql://u:secret@127.0.0.1:1/d?connect_timeout=2")
    assert "secret" not in str(refused.value)
    assert "check that the PostgreSQL server runs" in str(refused.value)


def test_sqlite_runs_as_safely_as_it_can(tmp_path: Path) -> None:
    with open_store(tmp_path / "a.db") as store, begin(store.engine) as connection:

        def pragma(name: str) -> object:
            return connection.exec_driver_sql(f"PRAGMA {name}").scalar()

        assert pragma("journal_mode") == "wal"
        assert pragma("synchronous") == 2  # FULL
        assert pragma("foreign_keys") == 1
        assert pragma("busy_timeout") == 30000


def test_a_file_that_is_no_database_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("not a database, " * 100)
    with pytest.raises(StoreError, match=r"notes\.txt: file is not a database; name another file"):
        open_store(path)
    assert path.read_text() == "not a database, " * 100


def test_who_only_reads_makes_no_store(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"hous\.db: is not there; check the path"):
        open_store(tmp_path / "hous.db", create=False)
    assert list(tmp_path.iterdir()) == []
    open_store(tmp_path / "hous.db").close()
    open_store(tmp_path / "hous.db", create=False).close()


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(StoreError, match=r"cannot be made .File exists.; name another folder"):
        open_store(tmp_path / "file" / "house.db")


@pytest.mark.parametrize(
    ("said", "kind", "remedy"),
    [
        ('could not extend file "b": wrote only 4096 of 8192 bytes', DiskFullError, "make room"),
        ("connection failed: the database system is in recovery mode", StoreAwayError, "try again"),
        (
            "connection failed: Connection refused",
            StoreAwayError,
            "check that the PostgreSQL server",
        ),
    ],
)
def test_what_a_server_says_has_a_remedy(
    said: str, kind: type[CucumberVisionError], remedy: str, tmp_path: Path
) -> None:
    with open_store(tmp_path / "a.db") as store:
        with pytest.raises(kind, match=f"; .*{remedy}") as caught, begin(store.engine):
            raise OperationalError("SELECT 1", None, Exception(said))
        assert type(caught.value) is kind
        assert "own words" not in str(caught.value)


def test_a_file_that_another_writes_to_just_now_is_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "house.db"
    with closing(sqlite3.connect(path, isolation_level=None, check_same_thread=False)) as other:
        # No WAL yet: SQLite refuses to switch to it now, and does not wait by itself.
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(sqlite3.OperationalError), closing(sqlite3.connect(path)) as eager:
            eager.execute("PRAGMA journal_mode = WAL")
        end = Timer(0.3, lambda: other.execute("COMMIT"))
        end.start()
        with open_store(path) as store:
            assert store.rounds() == []
        end.join()


def test_a_store_that_may_not_be_written_can_be_read() -> None:
    with tempfile.TemporaryDirectory() as name:  # pytest's own are closed to others
        folder = Path(name)
        with open_store(folder / "house.db") as store:
            store.save_round(Round(key_of("walk"), "morning"))
        for path, mode in ((folder / "house.db", 0o444), (folder, 0o555)):
            path.chmod(mode)
        before, files = os.geteuid(), sorted(folder.iterdir())
        if before == 0:  # whom modes do not stop
            os.seteuid(65534)
        try:
            with open_store(folder / "house.db") as store:
                assert [one.name for one in store.rounds()] == ["morning"]
                with pytest.raises(StoreError, match="readonly database; check the file's perm"):
                    store.rename_round(key_of("walk"), "noon")
        finally:
            os.seteuid(before)
            folder.chmod(0o755)
        assert sorted(folder.iterdir()) == files


def test_damage_that_sqlite_cannot_say_in_utf_8_is_named(tmp_path: Path) -> None:
    path = tmp_path / "house.db"
    open_store(path).close()
    data = path.read_bytes()
    at = data.index(b"CREATE TABLE rounds")
    path.write_bytes(data[:at] + b"CREATE T\xc1BLE rounds" + data[at + 19 :])
    with pytest.raises(StoreError, match="damaged"):
        open_store(path)


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
        store.save_stop(StopRecord(key=stop, round_key=walk.key, captures=(capture,)))
        # As if the software that made the store had not known this trait.
        with begin(store.engine, write=True) as connection:
            connection.execute(text("ALTER TABLE fruit DROP COLUMN tilt_deg"))
    with open_store(address) as store:
        [old] = store.detections(walk.key)
        assert (old.length_m, old.tilt_deg) == (0.3, None)
        again = replace(capture, fruit=(FruitRow(1, tilt_deg=5.0),))
        store.save_stop(StopRecord(key=key_of("next"), round_key=walk.key, captures=(again,)))
        assert store.detections(walk.key)[1].tilt_deg == 5.0
