from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import pytest
from tests.greenhouse.store.throwaway_postgres import missing_reason, throwaway_cluster

from cucumbervision.methods.result import Length
from cucumbervision_greenhouse.store import records
from cucumbervision_greenhouse.store.repository import Store, open_store
from cucumbervision_greenhouse.store.schema import METADATA

WALK = records.Round(records.key_of("walk"), "morning", "house 1", 1000.0)
NEXT_DAY = records.Round(records.key_of("next day"), "next morning", "house 1", 87400.0)


class MakeStop(Protocol):
    def __call__(
        self, step: int = ..., /, fruit: int = ..., **changes: Any
    ) -> records.StopRecord: ...


@pytest.fixture(scope="session")
def cluster() -> Iterator[Any]:
    """A real PostgreSQL server of our own."""
    pytest.importorskip("psycopg")
    reason = missing_reason()
    if reason:
        pytest.skip(reason)
    with throwaway_cluster() as running:
        yield running


@pytest.fixture(params=["sqlite", "postgresql"])
def backend(request: pytest.FixtureRequest) -> str:
    """Where the store is kept."""
    return str(request.param)


@pytest.fixture
def address(backend: str, request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """An empty database."""
    if backend == "sqlite":
        return str(tmp_path / "house.db")
    cluster = request.getfixturevalue("cluster")
    cluster.say("DROP SCHEMA public CASCADE; CREATE SCHEMA public")
    return str(cluster.url())


@pytest.fixture(scope="session")
def made_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store without rounds, to be copied."""
    path = tmp_path_factory.mktemp("made") / "house.db"
    open_store(path).close()
    return path


@pytest.fixture(scope="session")
def made_database(cluster: Any) -> str:
    """A store without rounds, to be emptied."""
    url = str(cluster.new_database())
    open_store(url).close()
    return url


@pytest.fixture
def store(backend: str, request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Store]:
    """An open store with two rounds."""
    if backend == "sqlite":
        url = str(tmp_path / "house.db")
        shutil.copyfile(request.getfixturevalue("made_file"), url)
    else:
        url = request.getfixturevalue("made_database")
        name = url.split("?")[0].rpartition("/")[2]
        tables = ", ".join(METADATA.tables)
        request.getfixturevalue("cluster").say(f"TRUNCATE {tables} RESTART IDENTITY", name)
    with open_store(url, images=tmp_path / "pictures") as opened:
        opened.save_round(WALK)
        opened.save_round(NEXT_DAY)
        yield opened


@pytest.fixture
def make_stop() -> MakeStop:
    """Return a maker of stops: fruit k of step s is (10 s + k) cm long and 0.1 k m along."""

    def make(step: int = 0, /, fruit: int = 2, **changes: Any) -> records.StopRecord:
        found = tuple(
            records.FruitRow(
                k,
                method="M6",
                length=Length(0.1 * step + 0.01 * k),
                offset_m=0.1 * k,
                offset_sd_m=0.03,
                view_score=0.5,
                keypoints=((1.0, 2.0, 0.9),),
                mask="123",
                m1_m=0.2,
                m6_m=0.25,
                path_m=((0.0, 0.1, 0.5), (0.2, 0.1, 0.5)),
                diameter_m=(0.04, 0.05),
            )
            for k in range(1, fruit + 1)
        )
        walk = changes.pop("round", WALK)
        values: dict[str, Any] = {
            "key": records.key_of(walk.key, step),
            "round_key": walk.key,
            "row": "3",
            "side": "left",
            "position_m": 0.4 * step,
            "position_sd_m": 0.04,
            "step": step,
            "taken_s": walk.started_s + step,
            "captures": (records.CaptureRecord("a", camera={"fx_px": 600.0}, fruit=found),),
            "artifacts": (records.ArtifactRecord("model", "detector", "ab", {"runtime": "x"}),),
            "failures": ({"capture": "b", "error": "CaptureError"},),
        }
        return records.StopRecord(**{**values, **changes})

    return make
