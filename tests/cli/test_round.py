from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from cucumbervision.capture.source import bundled_captures
from cucumbervision.cli.app import app
from cucumbervision.errors import CucumberVisionError


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
    rows = [str(bundled_captures() / f"simulated-row-{name}") for name in "ab"]
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


def test_faults_are_named(house: list[str]) -> None:
    with pytest.raises(CucumberVisionError, match="no round is called 'evening'"):
        run("show", "--round", "evening", *house)
    with pytest.raises(CucumberVisionError, match="no fruit called '7'"):
        run("pick", "7", *house)
