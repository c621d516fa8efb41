from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("streamlit")

from cucumbervision.dashboard.access import Login, configured_login, set_password
from cucumbervision.dashboard.server import serve, server_arguments
from cucumbervision.errors import AccessError, CucumberVisionError


@pytest.fixture(autouse=True)
def accounts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A home without any login; the path of the accounts that may be made."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("CUCUMBERVISION_ACCOUNTS_FILE", str(tmp_path / "accounts"))
    monkeypatch.setenv("CUCUMBERVISION_LOGIN", "")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "accounts"


@pytest.mark.parametrize("address", ["0.0.0.0", "::", "192.168.1.5", "greenhouse.local", ""])
def test_it_does_not_start_for_others_without_a_login(address: str, tmp_path: Path) -> None:
    with pytest.raises(AccessError, match="no login is set up"):
        serve(str(tmp_path / "house.db"), address=address, browser=False)
    assert not (tmp_path / "house.db").exists()


def test_a_login_that_is_required_must_be_set_up(
    accounts: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(AccessError, match="none is set up"):
        serve("house.db", browser=False, login=True)
    # The server's pages decide by the same variable.
    set_password(accounts, "anna", "a row of cucumbers")
    assert configured_login("127.0.0.1") is Login.PASSWORD
    monkeypatch.setenv("CUCUMBERVISION_LOGIN", "")
    assert configured_login("127.0.0.1") is Login.NONE


def test_a_replay_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CucumberVisionError, match="does not exist"):
        serve(str(tmp_path / "house.db"), replay=tmp_path / "no", browser=False)


def test_telemetry_is_off() -> None:
    arguments = server_arguments("127.0.0.1", 8501, browser=False)
    assert "--browser.gatherUsageStats=false" in arguments
    assert "--server.showEmailPrompt=false" in arguments
    assert "--server.address=127.0.0.1" in arguments
