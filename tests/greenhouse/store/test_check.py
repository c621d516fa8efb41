from __future__ import annotations

import os
import time
from pathlib import Path

import pytest
from tests.greenhouse.store.conftest import MakeStop

from cucumbervision_greenhouse.store.check import check_store
from cucumbervision_greenhouse.store.records import CaptureRecord, key_of
from cucumbervision_greenhouse.store.repository import Store

WALK, NEXT_DAY = key_of("walk"), key_of("next day")


def age(path: Path, seconds: float = 7200) -> Path:
    then = time.time() - seconds
    os.utime(path, (then, then))
    return path


@pytest.fixture
def refs(store: Store, make_stop: MakeStop) -> list[str]:
    """Three pictures of one stop, two hours old."""
    refs = [store.images.put(b"picture %d" % k, ".png") for k in range(3)]
    capture = CaptureRecord("a", color=refs[0], depth=refs[1], thumbnail=refs[2])
    store.save_stop(make_stop(1, captures=(capture,)))
    for ref in refs:
        age(store.images.path(ref))
    return refs


def test_a_sound_store(store: Store, refs: list[str]) -> None:
    report = check_store(store, remove=True)
    assert (report.pictures, report.sound) == (3, True)
    assert (report.orphans, report.removed) == ((), ())
    assert store.stop(store.stops(store.rounds()[1].key)[0].key).captures[0].depth == refs[1]
    assert store.stops(store.rounds()[1].key)[0].thumbnail == refs[2]


def test_what_is_missing_or_damaged_is_named_and_left(store: Store, refs: list[str]) -> None:
    missing, damaged = (store.images.path(ref) for ref in refs[:2])
    missing.unlink()
    damaged.write_bytes(b"something else")
    report = check_store(store, remove=True)
    assert (report.missing, report.damaged, report.sound) == ((missing,), (damaged,), False)
    assert damaged.exists()


def test_orphans_are_found_and_removed_once_they_are_old(store: Store, refs: list[str]) -> None:
    old = age(store.images.path(store.images.put(b"orphan", ".png")))
    young = store.images.path(store.images.put(b"on its way", ".png"))
    found = check_store(store)
    assert (found.orphans, found.removed) == ((old,), ())
    assert old.exists()
    assert check_store(store, remove=True).removed == found.orphans
    left = {store.images.path(ref) for ref in refs} | {young}
    assert {p for p in store.images.folder.rglob("*") if p.is_file()} == left


def test_sqlites_own_faults_are_told(store: Store, refs: list[str]) -> None:
    if store.engine.dialect.name != "sqlite":
        pytest.skip("PostgreSQL checks its keys itself, always")
    # Past the store, as another program might do it.
    raw = store.engine.raw_connection()
    raw.cursor().execute("PRAGMA foreign_keys = OFF")
    raw.cursor().execute("UPDATE captures SET stop_id = 999")
    raw.close()
    report = check_store(store)
    assert report.faults == ("captures names a line of stops that is not there",)
    assert not report.sound
