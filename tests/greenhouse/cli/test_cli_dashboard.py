from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("streamlit")

from cucumbervision.access import TOKEN_VARIABLE
from cucumbervision.errors import AccessError, CucumberVisionError
from cucumbervision_greenhouse.cli import dashboard
from cucumbervision_greenhouse.settings import LOGIN_VARIABLE


@pytest.fixture(autouse=True)
def started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[tuple[object, ...]]:
    """A home without any login; what the server was started with."""
    commands: list[tuple[object, ...]] = []
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in (LOGIN_VARIABLE, TOKEN_VARIABLE):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.chdir(tmp_path)

    def listen(*given: object, ready: Callable[[], None], **_: object) -> None:
        commands.append(given)
        ready()

    monkeypatch.setattr("cucumbervision.service.requests.listen", listen)
    return commands


@pytest.mark.parametrize("address", ["0.0.0.0", "192.168.1.5", "greenhouse.local", "::"])
def test_other_machines_need_the_random_token_of_the_link(
    address: str, started: list[tuple[object, ...]], capsys: pytest.CaptureFixture[str]
) -> None:
    dashboard("house.db", address=address, browser=False)
    shown = capsys.readouterr().err
    place, _, token = shown.split()[0].partition("/?token=")
    assert len(token) >= 24
    assert place.startswith("http://")
    assert place.endswith(":8501")
    assert len(started) == 1
    os.environ.pop(TOKEN_VARIABLE)
    dashboard("house.db", address=address, browser=False)
    assert capsys.readouterr().err != shown


def test_this_machine_needs_none_and_a_short_one_is_refused(
    started: list[tuple[object, ...]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    dashboard("house.db", browser=False)
    assert capsys.readouterr().err == "http://127.0.0.1:8501 (Ctrl-C ends)\n"
    monkeypatch.setenv(TOKEN_VARIABLE, "short")
    with pytest.raises(AccessError, match="the token has 5 characters"):
        dashboard("house.db", browser=False, login=True)
    assert len(started) == 1


def test_a_replay_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CucumberVisionError, match="does not exist"):
        dashboard("house.db", tmp_path / "no", browser=False)
