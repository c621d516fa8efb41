"""The tables: columns of `fields.csv`, rules of the database, and stores of old versions."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest
from sqlalchemy import inspect, text
from tests.greenhouse.store.conftest import MakeStop

from cucumbervision_greenhouse.store.engine import begin
from cucumbervision_greenhouse.store.records import LinkKind, Verdict, key_of
from cucumbervision_greenhouse.store.repository import Store, open_store
from cucumbervision_greenhouse.store.schema import METADATA, VERSION

WALK = key_of("walk")
STORES = Path(__file__).with_name("stores")


def columns_of(store: Store) -> dict[str, dict[str, bool]]:
    found = inspect(store.engine)
    return {
        name: {column["name"]: column["nullable"] for column in found.get_columns(name)}
        for name in found.get_table_names()
        if name != "cucumbervision_version"
    }


def expected_columns() -> dict[str, dict[str, bool]]:
    return {
        name: {column.name: bool(column.nullable) for column in table.columns}
        for name, table in METADATA.tables.items()
    }


def test_a_database_has_every_table_with_every_column(store: Store) -> None:
    assert columns_of(store) == expected_columns()


@pytest.fixture(params=["0.1.0", "9771f34", "64d81fbb"])
def old(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A store as a version of the software left it."""
    path = tmp_path / "house.db"
    path.write_bytes(gzip.decompress((STORES / f"house-{request.param}.db.gz").read_bytes()))
    return path


def test_a_store_of_an_earlier_version_opens_with_the_tables_of_this_one(old: Path) -> None:
    with open_store(old) as store:
        names = {name: set(columns) for name, columns in columns_of(store).items()}
        assert names == {name: set(columns) for name, columns in expected_columns().items()}
        [later, earlier] = store.rounds()
        assert [walk.stops for walk in (earlier, later)] == [2, 1]
        for walk in (earlier, later):
            for view in store.detections(walk.key, shapes=True):
                assert view.m6_m == pytest.approx(0.25, abs=0.11)
                assert len(view.path_m) == len(view.diameter_m) == 48
                assert view.mask
                detail = store.detection(view.key)
                assert detail.capture.camera["fx"] > 0
                assert {made.kind for made in detail.stop.artifacts} == {"software", "config"}
    with open_store(old) as store, begin(store.engine) as connection:
        version = connection.execute(text("SELECT version FROM cucumbervision_version")).scalar()
    assert version == VERSION


def test_it_takes_new_stops_and_marks(old: Path, make_stop: MakeStop) -> None:
    with open_store(old) as store:
        [_, earlier] = store.rounds()
        store.save_stop(make_stop(7, round_key=earlier.key))
        new = store.detections(earlier.key)[0]
        store.pick([new.key], at_s=7.0)
        assert store.detection(new.key).view.picked_s == 7.0
        store.undo(earlier.key)
        assert store.detection(new.key).view.picked_s is None


@pytest.mark.parametrize("version", ["0.1.0", "64d81fbb"])
def test_what_people_decided_is_as_it_was(tmp_path: Path, version: str) -> None:
    path = tmp_path / "house.db"
    path.write_bytes(gzip.decompress((STORES / f"house-{version}.db.gz").read_bytes()))
    with open_store(path) as store:
        tuesday, monday = store.rounds()
        assert (monday.name, tuesday.name) == ("Monday morning", "Tuesday")
        first, second, third, added, fourth, fifth = store.detections(monday.key)
        assert (first.length_m, first.interval_low_m, first.corrected) == (0.333, 0.32, True)
        verdicts = [view.verdict for view in (first, second, third, added)]
        assert verdicts == [Verdict.ACCEPTED, Verdict.REJECTED, None, Verdict.ACCEPTED]
        assert third.picked_s == 1_700_000_500.0
        # Merged by hand; merged and parted again.
        assert (first.group, fourth.group) == (first.key, first.key)
        assert (second.group, fifth.group) == (second.key, fifth.key)
        [computed, by_hand] = store.links(monday.key, LinkKind.GROWTH)
        assert (computed.first, computed.score, computed.by_hand) == (third.key, 0.9, False)
        later = store.detections(tuesday.key)
        assert (by_hand.first, by_hand.second) == (first.key, later[0].key)
        # A stop that was moved, and another that was deleted.
        [stop] = store.stops(tuesday.key)
        assert (stop.row, stop.position_m, stop.note) == ("4", 1.6, "by the door")
        assert store.stop(stop.key).captures[0].gravity == (0.0, 1.0, 0.0)
        # All of it can be taken back, the last first.
        for _ in range(2):
            store.undo(tuesday.key)
        assert [stop.row for stop in store.stops(tuesday.key)] == ["3", "3"]
        store.undo(monday.key)
        assert store.round(monday.key).name == "Monday"  # type: ignore[union-attr]
