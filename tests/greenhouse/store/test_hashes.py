"""A store of an earlier version stays sound; later columns are hashed as well."""

from __future__ import annotations

import gzip
import math
import sqlite3
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from textwrap import dedent

import pytest

from cucumbervision.measurement.result import Length
from cucumbervision_greenhouse.store.check import changed_lines
from cucumbervision_greenhouse.store.hashes import content_sha256
from cucumbervision_greenhouse.store.records import DetectionRecord, new_key
from cucumbervision_greenhouse.store.repository import open_store

STORE = Path(__file__).parent / "stores" / "house-9771f34.db.gz"
"""Written by 9771f34: two rounds of bundled captures, links, a verdict, a picked fruit."""

# What every version of the software with one more trait does as it loads.
NEW_TRAIT = dedent(
    """
    from dataclasses import field, make_dataclass
    from cucumbervision_greenhouse.store import records
    Plain = records.DetectionRecord
    Wider = make_dataclass(
        "DetectionRecord",
        [("wax_share", float | None, field(default=None))],
        bases=(Plain,),
        frozen=True,
        kw_only=True,
    )
    records.DetectionRecord = Wider
    from cucumbervision_greenhouse.store.schema import DetectionLine
    assert "wax_share" in DetectionLine.__table__.columns
    """
)


@pytest.fixture
def database(tmp_path: Path) -> Path:
    path = tmp_path / "house.db"
    path.write_bytes(gzip.decompress(STORE.read_bytes()))
    return path


def with_new_trait(script: str, database: Path) -> str:
    """Run a script in software that knows one trait more; return what it prints."""
    code = NEW_TRAIT + dedent(script)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code, str(database)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


CHECK = """
    import sys
    from cucumbervision_greenhouse.store.check import changed_lines
    from cucumbervision_greenhouse.store.repository import open_store
    with open_store(sys.argv[1]) as store:
        print(changed_lines(store))
    """


def execute(database: Path, statement: str) -> None:
    connection = sqlite3.connect(database)
    connection.execute(statement)
    connection.commit()
    connection.close()


def test_a_store_of_an_earlier_version_is_sound(database: Path) -> None:
    with open_store(database) as store:
        assert len(store.rounds()) == 2
        assert changed_lines(store) == []


def test_an_earlier_store_takes_what_captures_have_gained(database: Path) -> None:
    with open_store(database) as store:
        old = store.stop(store.stops(store.rounds()[0].key)[0].key)
        [capture] = old.captures
        assert (capture.gravity, capture.fruit[0].raw_length) == (None, None)
        turned = replace(capture, name="turned", gravity=(0.0, 0.6, 0.8))
        new = replace(old, key=new_key(), captures=(turned,))
        store.save_stop(new)
        assert store.stop(new.key).captures[0].gravity == (0.0, 0.6, 0.8)
        assert changed_lines(store) == []
    execute(database, "UPDATE captures SET gravity = '[0.0, 1.0, 0.0]' WHERE name = 'turned'")
    with open_store(database) as store:
        assert len(changed_lines(store)) == 1


def test_a_change_of_an_earlier_store_is_found(database: Path) -> None:
    execute(database, "UPDATE fruit SET length_m = length_m + 1e-9 WHERE id = 2")
    with open_store(database) as store:
        assert len(changed_lines(store)) == 1


def test_a_new_trait_leaves_an_earlier_store_sound(database: Path) -> None:
    assert with_new_trait(CHECK, database) == "[]\n"
    assert "wax_share" in {row[1] for row in _columns(database)}
    with open_store(database) as store:  # and back: this version, with a column it does not know
        assert changed_lines(store) == []


def _columns(database: Path) -> list[tuple[int, str]]:
    connection = sqlite3.connect(database)
    rows = connection.execute("PRAGMA table_info(fruit)").fetchall()
    connection.close()
    return rows


def test_a_value_of_a_new_trait_is_hashed(database: Path) -> None:
    with_new_trait(CHECK, database)
    execute(database, "UPDATE fruit SET wax_share = 0.25 WHERE id = 1")
    assert "is not as it was saved" in with_new_trait(CHECK, database)
    with open_store(database) as store:
        assert len(changed_lines(store)) == 1


def test_a_stop_sealed_with_a_new_trait_is_sound_in_both_versions(database: Path) -> None:
    with_new_trait(CHECK, database)
    execute(database, "UPDATE fruit SET wax_share = 0.25 WHERE id = 1")
    seal = """
        import sys
        from sqlalchemy import true
        from cucumbervision_greenhouse.store.hashes import seal_stops
        from cucumbervision_greenhouse.store.repository import open_store
        with open_store(sys.argv[1]) as store, store.writing() as connection:
            seal_stops(connection, true())
        """
    with_new_trait(seal, database)
    assert with_new_trait(CHECK, database) == "[]\n"
    with open_store(database) as store:
        assert changed_lines(store) == []


STOP = """
    from cucumbervision_greenhouse.store.hashes import content_sha256
    from cucumbervision_greenhouse.store.records import CaptureRecord, StopRecord, key_of
    capture = CaptureRecord("a", camera={"note": None}, fruit=(records.DetectionRecord(1),))
    print(content_sha256(StopRecord(key_of("stop"), key_of("round"), 1.5, captures=(capture,))))
    """
# What 9771f34 prints for it.
FIRST_SHA256 = "871bfa8736fee52e18fd71b2ed14d61cf7507892e126eee5b9c0f28a27392236"


def test_the_same_stop_is_already_there_after_a_new_trait(database: Path) -> None:
    plain = "from cucumbervision_greenhouse.store import records\n" + dedent(STOP)
    done = subprocess.run([sys.executable, "-c", plain], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == FIRST_SHA256
    assert with_new_trait(STOP, database).strip() == FIRST_SHA256


def test_a_content_hash_tells_records_apart_to_the_last_digit() -> None:
    record = DetectionRecord(1, length=Length(0.3))
    assert content_sha256(record) == content_sha256(DetectionRecord(1, length=Length(0.3)))
    later = DetectionRecord(1, length=Length(math.nextafter(0.3, 1)))
    assert content_sha256(record) != content_sha256(later)
