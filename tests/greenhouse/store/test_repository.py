from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import func, select
from tests.greenhouse.store.conftest import MakeStop

from cucumbervision.errors import NameRefusedError, StoreError
from cucumbervision_greenhouse.store import records
from cucumbervision_greenhouse.store.engine import begin
from cucumbervision_greenhouse.store.repository import Store, open_store
from cucumbervision_greenhouse.store.schema import METADATA

WALK = records.key_of("walk")


def lines(store: Store) -> dict[str, int]:
    """Count every table's lines."""
    with begin(store.engine) as connection:
        return {
            name: connection.execute(select(func.count()).select_from(table)).scalar_one()
            for name, table in METADATA.tables.items()
        }


@pytest.mark.parametrize("bad", ["a\0", "a\ud800b", "a\u202eb", "a\nb", "a\x1b["])
def test_a_name_that_is_none_is_refused_by_every_database_alike(
    store: Store, make_stop: MakeStop, bad: str
) -> None:
    stop, before = make_stop(3), lines(store)
    capture = replace(stop.captures[0], name=bad)
    for changed in ({"row": bad}, {"side": bad}, {"note": bad}, {"captures": (capture,)}):
        with pytest.raises(NameRefusedError):
            store.save_stop(replace(stop, **changed))
    for named in (records.Round(name=bad), records.Round(house=bad)):
        with pytest.raises(NameRefusedError):
            store.save_round(named)
    with pytest.raises(NameRefusedError):
        store.rename_round(WALK, bad)
    assert lines(store) == before


def test_long_names_of_places_are_refused_and_those_of_files_are_kept(
    store: Store, make_stop: MakeStop
) -> None:
    stop, long = make_stop(3), "x" * 201
    for changed in (replace(stop, row=long), replace(stop, side=long), replace(stop, note=long)):
        with pytest.raises(NameRefusedError, match="201 characters"):
            store.save_stop(changed)
    capture = replace(stop.captures[0], name=long)
    assert store.save_stop(replace(stop, captures=(capture,)))
    assert store.stop(stop.key).captures[0].name == long


def test_a_house_gets_the_name_that_it_had_first(store: Store) -> None:
    first = records.Round(house=" House 7 ")
    second = records.Round(house="7")
    assert store.save_round(first) is store.save_round(second) is True
    houses = {one.key: one.house for one in store.rounds()}
    assert houses[first.key] == houses[second.key] == "House 7"
    assert not store.save_round(second)


def test_a_stop_that_fails_half_way_leaves_nothing(store: Store, make_stop: MakeStop) -> None:
    before = lines(store)
    fruit = (records.FruitRow(1), records.FruitRow(2, path_m=((float("inf"), 0.0, 0.0),)))
    captures = (make_stop().captures[0], records.CaptureRecord("b", fruit=fruit))
    with pytest.raises(StoreError, match="cannot be stored"):
        store.save_stop(make_stop(1, captures=captures, row="99"))
    assert lines(store) == before
    assert store.save_stop(make_stop(1))


def test_a_stop_needs_its_round(store: Store, make_stop: MakeStop) -> None:
    with pytest.raises(StoreError, match="is not in the store; save the round first"):
        store.save_stop(make_stop(1, round_key=records.new_key()))


def test_pictures_of_a_server_need_a_folder(cluster: Any) -> None:
    with (
        open_store(cluster.new_database()) as store,
        pytest.raises(
            StoreError, match=r"open the store with images=FOLDER, or postgresql://…\?images=FOLDER"
        ),
    ):
        _ = store.images


def test_the_address_of_a_server_names_the_folder_of_the_pictures(
    cluster: Any, tmp_path: Path
) -> None:
    address = cluster.new_database()
    mark = "&" if "?" in address else "?"
    with open_store(f"{address}{mark}images={tmp_path}/of%20the%20house") as store:
        assert store.images.folder == tmp_path / "of the house"
        assert "images" not in store.name


def test_the_address_of_a_file_may_name_the_folder_of_the_pictures(tmp_path: Path) -> None:
    address = f"sqlite:///{tmp_path}/house.db?images={tmp_path}/pictures"
    with open_store(address) as store:
        assert store.images.folder == tmp_path / "pictures"
    with pytest.raises(StoreError, match="names 2 folders of pictures"):
        open_store(f"{address}&images={tmp_path}/others")


def test_many_threads_lose_nothing(store: Store, make_stop: MakeStop) -> None:
    # Every stop is sent by two threads at once.
    stops = [make_stop(step // 2) for step in range(40)]
    with ThreadPoolExecutor(8) as pool:
        said = list(pool.map(store.save_stop, stops))
    assert sum(said) == 20
    assert len(store.detections(WALK)) == 40


def test_what_a_server_acknowledged_outlives_its_crash(cluster: Any, make_stop: MakeStop) -> None:
    with open_store(cluster.new_database()) as store:
        store.save_round(records.Round(WALK))
        for step in range(5):
            store.save_stop(make_stop(step))
        cluster.stop(at_once=True)
        with pytest.raises(StoreError, match="PostgreSQL server runs"):
            store.save_stop(make_stop(5))
        cluster.start()
        # The same open store goes on.
        assert not store.save_stop(make_stop(4))
        assert store.save_stop(make_stop(5))
        assert len(store.detections(WALK)) == 12


def test_texts_of_a_stop_that_no_database_takes_are_made_readable(
    store: Store, make_stop: MakeStop
) -> None:
    stop = make_stop(3)
    # So Python reads a file's name that is no UTF-8.
    source = b"caf\xe9".decode(errors="surrogateescape")
    damaged = replace(
        stop,
        captures=(replace(stop.captures[0], source=source, provenance={"file": [source, 1]}),),
        artifacts=(records.ArtifactRecord("model", source, "ab", {source: "a\0"}),),
        failures=({"capture": source},),
    )
    assert store.save_stop(damaged)
    assert not store.save_stop(damaged)
    saved = store.stop(stop.key)
    assert (saved.captures[0].source, saved.captures[0].provenance) == (
        "caf?",
        {"file": ["caf?", 1]},
    )
    assert saved.artifacts == (records.ArtifactRecord("model", "caf?", "ab", {"caf?": "a?"}),)
    assert saved.failures == ({"capture": "caf?"},)


def test_a_number_of_a_stop_is_taken_by_every_database_alike(
    store: Store, make_stop: MakeStop
) -> None:
    stop = make_stop(3)
    store.save_stop(stop)
    place = replace(stop, position_m=1.0, step=2**31 - 1)
    store.place_stop(place)
    for step in (2**31, -(2**63), 2**64):
        with pytest.raises(StoreError, match="has no number"):
            store.place_stop(replace(place, step=step))
        with pytest.raises(StoreError, match="has no number"):
            store.save_stop(replace(stop, key=records.new_key(), step=step))
    with pytest.raises(StoreError):
        store.undo(number=2**64)
