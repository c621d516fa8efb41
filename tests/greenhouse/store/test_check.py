from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from cucumbervision.errors import StoreError
from cucumbervision.measurement.result import Length
from cucumbervision_greenhouse.store.check import changed_lines, check_store, refuse_changed
from cucumbervision_greenhouse.store.corrections import StopPlace
from cucumbervision_greenhouse.store.links import LinkKind, LinkRecord, Position
from cucumbervision_greenhouse.store.records import (
    ArtifactRecord,
    CaptureRecord,
    DetectionRecord,
    ImageRef,
    JointRecord,
    key_of,
)
from cucumbervision_greenhouse.store.repository import Store
from cucumbervision_greenhouse.store.views import Verdict

WALK, NEXT_DAY = key_of("walk"), key_of("next day")

if TYPE_CHECKING:
    from tests.greenhouse.store.conftest import MakeStop


def age(path: Path, seconds: float = 7200) -> Path:
    then = time.time() - seconds
    os.utime(path, (then, then))
    return path


@pytest.fixture
def refs(store: Store, make_stop: MakeStop) -> list[ImageRef]:
    """Three pictures of one stop, two hours old."""
    refs = [store.images.put(b"picture %d" % k, ".png", 1, 1) for k in range(3)]
    capture = CaptureRecord("a", color=refs[0], depth=refs[1], thumbnail=refs[2])
    store.save_stop(make_stop(1, captures=(capture,)))
    for ref in refs:
        age(store.images.path(ref))
    return refs


def test_a_sound_store(store: Store, refs: list[ImageRef]) -> None:
    report = check_store(store, remove=True)
    assert (report.pictures, report.sound) == (3, True)
    assert (report.orphans, report.removed) == ((), ())
    assert store.stop(store.stops(store.rounds()[1].key)[0].key).captures[0].depth == refs[1]
    assert store.stops(store.rounds()[1].key)[0].thumbnail == refs[2]


def test_what_is_missing_or_damaged_is_named_and_left(store: Store, refs: list[ImageRef]) -> None:
    missing, damaged = (store.images.path(ref) for ref in refs[:2])
    missing.unlink()
    damaged.write_bytes(b"something else")
    report = check_store(store, remove=True)
    assert (report.missing, report.damaged, report.sound) == ((missing,), (damaged,), False)
    assert damaged.exists()


def test_orphans_are_found_and_removed_once_they_are_old(
    store: Store, refs: list[ImageRef]
) -> None:
    old = age(store.images.path(store.images.put(b"orphan", ".png", 1, 1)))
    young = store.images.path(store.images.put(b"on its way", ".png", 1, 1))
    found = check_store(store)
    assert (found.orphans, found.removed) == ((old,), ())
    assert old.exists()
    assert check_store(store, remove=True).removed == found.orphans
    left = {store.images.path(ref) for ref in refs} | {young}
    assert {p for p in store.images.folder.rglob("*") if p.is_file()} == left


@pytest.mark.parametrize("used", ["named", "put"])
def test_an_orphan_that_somebody_uses_just_now_is_brought_back(
    store: Store, make_stop: MakeStop, monkeypatch: pytest.MonkeyPatch, used: str
) -> None:
    """Between finding an orphan and removing it another program saves a stop with it."""
    ref = store.images.put(b"orphan", ".png", 1, 1)
    path = age(store.images.path(ref))
    take_away = Path.replace

    def meanwhile(self: Path, target: Path) -> Path:
        if self == path:
            if used == "put":
                store.images.put(b"orphan", ".png", 1, 1)
            else:
                store.save_stop(make_stop(1, captures=(CaptureRecord("a", color=ref),)))
        return take_away(self, target)

    monkeypatch.setattr(Path, "replace", meanwhile)
    assert check_store(store, remove=True).removed == ()
    assert store.images.read(ref) == b"orphan"


def test_a_check_that_was_killed_is_made_good_by_the_next(
    store: Store, refs: list[ImageRef]
) -> None:
    path = store.images.path(refs[0])
    path.replace(path.with_name(f"{path.name}.removing"))
    assert check_store(store).missing == (path,)
    assert check_store(store, remove=True).sound
    assert store.images.read(refs[0]) == b"picture 0"


def test_sqlites_own_faults_are_told(store: Store, refs: list[ImageRef]) -> None:
    if store.engine.dialect.name != "sqlite":
        pytest.skip("PostgreSQL checks its keys itself, always")
    # Past the store, as another program might do it.
    raw = store.engine.raw_connection()
    raw.cursor().execute("PRAGMA foreign_keys = OFF")
    raw.cursor().execute("UPDATE captures SET stop_id = 999")
    raw.close()
    report = check_store(store)
    [stop] = [one.key for one in store.stops(WALK)]
    assert report.faults == (
        "captures names a line of stops that is not there",
        f"stop {stop} is not as it was saved",
    )
    assert not report.sound


CHANGED = {
    "stops SET position_m = 1.3": "stop",
    "rows SET name = '4'": "stop",
    "artifacts SET details = '{}'": "stop",
    "captures SET width_px = 641": "stop",
    "images SET width_px = 2": "stop",
    "fruit SET length_m = length_m + 0.0000000001": "stop",
    "masks SET rle = '124'": "stop",
    "measurements SET length_m = 0.3 WHERE method = 'M1'": "stop",
    "measurements SET reason = 'no-depth'": "stop",
    "marks SET details = '{\"at_s\": 6.0}' WHERE slot = 'picked'": "correction",
    "marks SET value = 'rejected' WHERE slot = 'verdict'": "correction",
    "marks SET ended_by_id = action_id WHERE slot = 'verdict'": "correction",
    "marks SET fruit_id = fruit_id - 1 WHERE slot = 'picked'": "correction",
    "joint_measurements SET views = 3": "joint measurement",
    "rounds SET name = 'Morning' WHERE id = 1": "round",
    "rounds SET started_s = 2000 WHERE id = 1": "round",
    "stops SET fitted_m = 1.26": "position of stop",
    "links SET score = 0.25": "link",
    "links SET kind = 'apart'": "link",
    "links SET ended_by_id = 1": "link",
}


@pytest.mark.parametrize("change", CHANGED)
def test_what_another_program_changed_is_found(
    store: Store, make_stop: MakeStop, refs: list[ImageRef], change: str
) -> None:
    capture = replace(make_stop(2).captures[0], color=refs[0])
    used = (ArtifactRecord("model", "detector", "ab", {"runtime": "x"}),)
    stop = make_stop(2, captures=(capture,), artifacts=used, row="3")
    store.save_stop(stop)
    first, second = (detection.key for detection in store.detections(WALK))
    store.set_verdict([first], Verdict.ACCEPTED)
    store.pick([second], at_s=5.0)
    store.save_joint(WALK, [JointRecord(key_of("joint"), "a", 2)], ())
    together = LinkRecord(LinkKind.SAME, first, second, 0.5)
    store.save_merging(WALK, [together], {stop.key: Position(1, 0.01)})
    store.add_fruit(stop.key, "a", DetectionRecord(1))
    assert changed_lines(store) == []
    with store.writing() as connection:
        connection.exec_driver_sql(f"UPDATE {change}")
    found = changed_lines(store)
    assert found
    assert all(line.startswith(CHANGED[change]) for line in found)
    assert not check_store(store).sound
    with pytest.raises(StoreError, match="is not as it was saved; copy the store back"):
        refuse_changed(store, WALK)
    refuse_changed(store, NEXT_DAY)  # nothing of it was changed


def test_what_the_store_changes_itself_is_sound(
    store: Store, make_stop: MakeStop, refs: list[ImageRef]
) -> None:
    del refs
    stop = make_stop(2)
    store.save_stop(stop)
    keys = [detection.key for detection in store.detections(WALK)]
    store.add_fruit(stop.key, stop.captures[0].name, DetectionRecord(1))
    store.correct(keys[0], replace(stop.captures[0].fruit[0], length=Length(0.5)))
    store.merge(*keys)
    store.save_merging(WALK, [], {stop.key: Position(1.25, 0.01)})
    store.place_stop(stop.key, StopPlace("9", "right", 4.0, 2, mirrored=True))
    store.rename_round(WALK, "noon")
    again = replace(stop, captures=(replace(stop.captures[0], fill=0.5),))
    store.measure_again(again, {keys[0]: ("a", 1)}, {keys[0]: DetectionRecord(1)})
    store.delete_stop(stop.key)
    store.undo(WALK)
    store.delete_round(NEXT_DAY)
    store.restore_round(NEXT_DAY)
    store.save_merging(WALK, [], {stop.key: Position(1, 0.01)})
    assert changed_lines(store) == changed_lines(store, WALK) == []
