from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.cli.app import app
from cucumbervision.errors import CucumberVisionError
from cucumbervision.rounds.forecasting import growth_links
from cucumbervision.store.records import (
    CaptureRecord,
    DetectionRecord,
    RoundRecord,
    StopRecord,
    new_key,
)
from cucumbervision.store.repository import open_store
from cucumbervision.store.waiting import WaitingCaptures, waiting_folder


def run(*arguments: str) -> str:
    done = CliRunner().invoke(app, ["round", *arguments])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.fixture
def house(tmp_path: Path) -> list[str]:
    """A store with a round."""
    store = ["--store", str(tmp_path / "house.db")]
    run("new", "morning", "--house", "1", *store)
    return store


def test_a_round_from_captures_to_pick_list(house: list[str]) -> None:
    rows = [str(example_captures() / f"simulated-row-{name}") for name in "ab"]
    where = ("--row", "4", "--side", "left", "--position", "2", "--spacing", "3")
    said = run("add", *rows, *where, "--instances", "dataset", *house)
    assert "2 stops added" in said
    again = run("add", *rows, *where, "--instances", "dataset", *house)
    assert "0 stops added with 0 fruit; 2 were there already." in again
    assert "morning" in run("list", *house)
    assert "expected" in run("merge", *house)
    table = run("show", *house, "--limit", "0")
    assert "morning" in table
    assert "2.0" in table
    assert "logged as action 1" in run("merge-by-hand", "1", "2", *house)
    assert "logged as action 2" in run("unmerge", "1", *house)
    assert "logged as action 3" in run("pick", "1", *house, "--by", "kim")
    assert "picked" in run("show", *house)
    assert "to pick" in run("pick-list", *house)
    assert "logged as action 4" in run("undo", *house)
    assert "logged as action 5" in run("undo", "2", *house)
    assert "picked" not in run("show", *house)


def test_a_pair_without_intrinsics_gets_them_by_the_option(
    house: list[str], tmp_path: Path
) -> None:
    native = example_captures() / "simulated-row-a"
    pair = tmp_path / "pair"
    pair.mkdir()
    shutil.copy(native / "color_000000.jpg", pair / "rgb_1.jpg")
    shutil.copy(native / "depth_000000.png", pair / "depth_1.png")
    with pytest.raises(AssertionError, match="carries no camera intrinsics"):
        run("add", str(pair), *house)
    camera = tmp_path / "camera.json"
    camera.write_text(json.dumps(json.loads((native / "capture.json").read_text())["camera"]))
    assert "1 stops added" in run("add", str(pair), "--intrinsics", str(camera), *house)


def test_what_has_changed_is_measured_again_and_a_round_on_demand(house: list[str]) -> None:
    row = (str(example_captures() / "simulated-row-a"), "--instances", "dataset")
    run("add", *row, *house)
    again = run("add", *row, "--length", "chord", *house)
    assert "0 stops added with 0 fruit; 0 were there already." in again
    assert "1 were measured again" in again
    assert "1 stops measured again." in run("remeasure", "--instances", "dataset", *house)


def test_a_stop_that_is_put_back_is_merged_at_once(house: list[str]) -> None:
    row = str(example_captures() / "simulated-row-a")
    run("add", row, "--row", "4", "--position", "2", "--instances", "dataset", *house)
    with open_store(house[1]) as store:
        key = store.rounds()[0].key
        store.delete_stop(store.stops(key)[0].key)
        assert "logged as action 2" in run("undo", *house)
        assert [one.fitted_m is not None for one in store.stops(key)] == [True]


def test_stops_and_rounds_are_deleted_and_brought_back(house: list[str]) -> None:
    rows = [str(example_captures() / f"simulated-row-{name}") for name in "ab"]
    where = ("--row", "4", "--side", "left", "--position", "2", "--spacing", "3")
    run("add", *rows, *where, "--instances", "dataset", *house)
    listed = run("stops", *house)
    assert "2.00" in listed
    assert "5.00" in listed
    assert "logged as action 1" in run("delete-stop", "2", *house, "--by", "kim")
    with open_store(house[1]) as store:
        [one] = store.rounds()
        [stop] = store.stops(one.key)
        assert (stop.step, stop.fitted_m is not None) == (1, True)  # merged anew
        assert store.log(one.key)[0].by == "kim"
    with pytest.raises(CucumberVisionError, match="no stop is called '2'"):
        run("delete-stop", "2", *house)
    run("undo", *house)
    assert "5.00" in run("stops", *house)
    assert "brings it back" in run("delete", "morning", *house)
    assert "morning" not in run("list", *house)
    assert "morning" in run("list", "--deleted", *house)
    with pytest.raises(CucumberVisionError, match="no round is called 'morning'"):
        run("delete", "morning", *house)
    run("restore", "morning", *house)
    assert "morning" in run("list", *house)
    with pytest.raises(CucumberVisionError, match="no deleted round is called 'morning'"):
        run("restore", "morning", *house)


def test_a_round_into_which_captures_wait_is_not_deleted(house: list[str]) -> None:
    waiting = WaitingCaptures(waiting_folder(house[1]))
    with open_store(house[1]) as store:
        key = store.rounds()[0].key
    capture = next(iter(open_source(example_captures()))).load()
    waiting.put(capture, new_key(), key, 1_700_000_000.0)
    with pytest.raises(CucumberVisionError, match="1 capture waits to be measured into it"):
        run("delete", "morning", *house)
    assert "morning" in run("list", *house)


def test_growth_is_linked_by_hand_and_taken_back(house: list[str]) -> None:
    with open_store(house[1]) as store:
        [first] = store.rounds()
        later = RoundRecord(new_key(), "evening", started_s=first.record.started_s + 86400)
        store.save_round(later)
        for number, key in enumerate((first.key, later.key)):
            fruit = DetectionRecord(1, length_m=0.2 + 0.03 * number)
            stop = StopRecord(
                new_key(), key, row="4", captures=(CaptureRecord("a", fruit=(fruit,)),)
            )
            store.save_stop(stop)
    names = ("link-by-hand", "morning", "1", "1", "--round", "evening")
    assert "logged as action 1" in run(*names, *house)
    with open_store(house[1]) as store:
        [link] = growth_links(store, later.key)
        assert (link.length0_m, link.length1_m) == pytest.approx((0.20, 0.23))
    run(*names, "--apart", *house)
    with open_store(house[1]) as store:
        assert growth_links(store, later.key) == []


def test_a_store_is_checked(house: list[str]) -> None:
    with open_store(house[1]) as store:
        thumbnail = store.images.put_thumbnail(np.full((48, 64, 3), 90, np.uint8))
        stop = StopRecord(
            new_key(), store.rounds()[0].key, captures=(CaptureRecord("a", thumbnail=thumbnail),)
        )
        store.save_stop(stop)
        path = store.images.path(thumbnail)
    assert "1 pictures, 0 files that no stop names\nsound" in run("check", *house)
    path.write_bytes(b"broken")
    done = CliRunner().invoke(app, ["round", "check", *house])
    assert done.exit_code == 1
    assert f"damaged: {path}" in done.stdout


def test_faults_are_named(house: list[str]) -> None:
    with pytest.raises(CucumberVisionError, match="no round is called 'evening'"):
        run("show", "--round", "evening", *house)
    with pytest.raises(CucumberVisionError, match="no fruit called '7'"):
        run("pick", "7", *house)
