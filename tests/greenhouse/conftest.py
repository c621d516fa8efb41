from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeAlias

import numpy as np
import pytest
from tests.conftest import PATIENCE_S

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.source import example_captures
from cucumbervision.run.measurer import Measurer
from cucumbervision.run.options import MeasureOptions
from cucumbervision_greenhouse.measuring import SharedMeasurer
from cucumbervision_greenhouse.rounds.adding import Added, Place, add_captures, save_measured
from cucumbervision_greenhouse.store.records import Round, StopRecord, key_of, new_key
from cucumbervision_greenhouse.store.repository import Store, open_store
from cucumbervision_greenhouse.store.waiting import WaitingCaptures

WALK = Round(key_of("walk"), "morning", "house 1", 1_700_000_000.0, "long-cucumber")
LONG = Round(key_of("long walk"), "500 stops", "house 1", 1_700_100_000.0, "long-cucumber")
FRUIT_PER_STOP = 5


def add_one(
    store: Store, round_key: str, capture: Capture, options: MeasureOptions, key: str = ""
) -> Added:
    """Measure a capture as the dashboard does what waits, and save it under a key of its own."""
    measurer, stop = Measurer(options), Place().stop(capture, key or new_key(), round_key)
    return save_measured(store, stop, measurer.attempt(capture), measurer)


def measure_waiting(
    queue: WaitingCaptures,
    measurer: SharedMeasurer,
    store: Store,
    options: Callable[[], MeasureOptions],
    settle: Callable[[str], object] = print,
    job: Any = None,
) -> int:
    """Measure a queue as the dashboard does, with these in place of its own."""
    pytest.importorskip("streamlit")
    from cucumbervision_greenhouse import resources, tasks

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(resources, "measurer", lambda: measurer)
        patch.setattr(tasks, "waiting", lambda: queue)
        patch.setattr(tasks, "store", lambda: store)
        patch.setattr(tasks, "settings", lambda: SimpleNamespace(options=options()))
        patch.setattr(tasks, "_settle", settle)
        return tasks.measure_waiting(job or resources.Job("Measuring"))


def whole_stop(store: Store, key: str) -> StopRecord:
    """Return a stop with its fruit, to save it again."""
    stop = store.stop(key)
    fruit = store.detections(stop.round_key, key, shapes=True)
    captures = (
        replace(taken, fruit=tuple(row for row in fruit if row.capture == taken.name))
        for taken in stop.captures
    )
    return replace(stop, captures=tuple(captures), fruit=0)


def copy_round(store: Store, copy: Round, later_s: float = 0.0, **changes: Any) -> None:
    """Save the stops of `WALK` under another round, as many seconds later."""
    store.save_round(copy)
    for stop in [whole_stop(store, stop.key) for stop in store.stops(WALK.key)]:
        key, taken_s = key_of(copy.key, stop.key), stop.taken_s + later_s
        store.save_stop(replace(stop, key=key, round_key=copy.key, taken_s=taken_s, **changes))


def wait_until(page: Any, condition: Callable[[], object]) -> None:
    """Wait until a condition holds, while the browser of a page goes on."""
    until = time.monotonic() + 3 * PATIENCE_S
    while not condition():
        assert time.monotonic() < until, "waited in vain"
        page.wait_for_timeout(100)


def copy_house(made: Path, folder: Path) -> Path:
    """Copy a store with its images into a folder."""
    path = folder / "house.db"
    shutil.copyfile(made, path)
    shutil.copytree(made.with_suffix(".images"), path.with_suffix(".images"))
    return path


def shot(page: Any, name: str, **options: Any) -> None:
    """Keep a picture of a page where CUCUMBERVISION_ARTEFACTS names a folder."""
    if folder := os.environ.get("CUCUMBERVISION_ARTEFACTS"):
        page.wait_for_timeout(500)
        page.screenshot(path=Path(folder) / f"{name}.png", **options)


@pytest.fixture
def in_zone(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], None]]:
    """Set the time zone of this process until the test ends."""
    if not hasattr(time, "tzset"):
        pytest.skip("the time zone cannot be set here")

    def set_zone(name: str) -> None:
        patch.setenv("TZ", name)
        time.tzset()

    with monkeypatch.context() as patch:
        yield set_zone
    time.tzset()


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with one round: the bundled captures, measured on their own masks."""
    path = tmp_path_factory.mktemp("made") / "house.db"
    with open_store(path) as store:
        store.save_round(WALK)
        add_captures(store, WALK.key, [example_captures()], MeasureOptions(instances="auto"))
    return path


@pytest.fixture(autouse=True)
def own_main() -> Iterator[None]:
    """Streamlit puts a page in the place of `__main__`; a later test's processes would run it."""
    main = sys.modules["__main__"]
    yield
    sys.modules["__main__"] = main


@pytest.fixture
def fresh_caches() -> Iterator[None]:
    """Each test opens its own store, and lets it go."""
    st = pytest.importorskip("streamlit")
    st.cache_resource.clear()
    st.cache_data.clear()
    yield
    st.cache_resource.clear()
    st.cache_data.clear()


@pytest.fixture
def house(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The same, to be changed; the dashboard's pages open it."""
    path = copy_house(made, tmp_path)
    monkeypatch.setenv("CUCUMBERVISION_STORE", str(path))
    monkeypatch.setenv("CUCUMBERVISION_REPLAY", str(example_captures()))
    return path


@pytest.fixture
def store(house: Path) -> Iterator[Store]:
    with open_store(house) as opened:
        yield opened


@pytest.fixture
def asked(house: Path, fresh_caches: None) -> Iterator[Any]:
    """A client of the routes of both applications, without their guard."""
    from starlette.applications import Starlette
    from starlette.testclient import TestClient

    from cucumbervision_greenhouse.camera.page import routes as capture_routes
    from cucumbervision_greenhouse.routes import routes

    with TestClient(Starlette(routes=[*routes(), *capture_routes()])) as client:
        yield client


def long_round(store: Store, template: StopRecord, stops: int) -> None:
    """Save a round of many stops, each with five fruit of drawn lengths, in four rows."""
    rng = np.random.default_rng(5)
    store.save_round(LONG)
    capture = template.captures[0]
    for number in range(stops):
        row, at = divmod(number, max(1, stops // 4))
        fruit = []
        for k in range(FRUIT_PER_STOP):
            one = capture.fruit[k % len(capture.fruit)]
            length_m = float(rng.normal(0.26, 0.05))
            fruit.append(
                one.with_(
                    fruit=k + 1,
                    length=one.length
                    and replace(
                        one.length, value_m=length_m, low_m=0.98 * length_m, high_m=1.02 * length_m
                    ),
                    thread_m=length_m,
                    centre_y_m=float(rng.uniform(-0.4, 0.4)),
                    offset_m=float(rng.uniform(-0.2, 0.2)),
                )
            )
        store.save_stop(
            replace(
                template,
                key=key_of("long", number),
                round_key=LONG.key,
                row=str(row + 1),
                position_m=round(0.4 * at, 2),
                step=number + 1,
                taken_s=1_700_100_000.0 + 10 * number,
                captures=(replace(capture, fruit=tuple(fruit)),),
            )
        )


@pytest.fixture(scope="session")
def make_long() -> Callable[[Store, StopRecord, int], None]:
    """Give `long_round`."""
    return long_round


class Address(str):
    """A running server's address."""

    process: subprocess.Popen[bytes]


StartServer: TypeAlias = Callable[..., Address]


@pytest.fixture(scope="module")
def start_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StartServer]:
    """Start the real command in a folder and return its address; ended after the module."""
    started: list[subprocess.Popen[bytes]] = []

    def start(folder: Path, *arguments: str, **environment: str) -> Address:
        code = "from cucumbervision.cli.app import main; main()"
        for _ in range(5):  # another process may take the port before the server does
            with socket.socket() as probe:
                probe.bind(("127.0.0.1", 0))
                port = int(probe.getsockname()[1])
            command = [sys.executable, "-c", code, "dashboard", "--no-browser", "--port", str(port)]
            how: dict[str, Any] = {"cwd": folder, "env": {**os.environ, **environment}}
            with (folder / "server.log").open("ab") as log:
                server = subprocess.Popen([*command, *arguments], stdout=log, stderr=log, **how)
            started.append(server)
            if _answers(f"http://127.0.0.1:{port}", server):
                address = Address(f"http://127.0.0.1:{port}")
                address.process = server
                return address
        raise AssertionError((folder / "server.log").read_text())

    yield start
    for server in started:
        server.terminate()
    for server in started:
        server.wait(PATIENCE_S)


def _answers(address: str, server: subprocess.Popen[bytes]) -> bool:
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until and server.poll() is None:
        try:
            with urllib.request.urlopen(f"{address}/_stcore/health", timeout=10):
                return True
        except urllib.error.HTTPError:  # it answers strangers with 403
            return True
        except (urllib.error.URLError, OSError):
            time.sleep(0.2)
    return False
