from __future__ import annotations

from pathlib import Path

import pytest

from cucumbervision.dashboard.access import Login, hash_password, write_password_hash
from cucumbervision.dashboard.server import serve, server_arguments
from cucumbervision.errors import AccessError, CucumberVisionError


@pytest.mark.parametrize("address", ["0.0.0.0", "::", "192.168.1.5", "greenhouse.local", ""])
def test_other_machines_are_refused_without_a_login(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("streamlit")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("CUCUMBERVISION_PASSWORD_FILE", str(tmp_path / "none"))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CucumberVisionError, match="login"):
        serve(str(tmp_path / "house.db"), address=address, browser=False)
    assert not (tmp_path / "house.db").exists()


def test_a_login_that_is_asked_for_must_be_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("streamlit")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("CUCUMBERVISION_PASSWORD_FILE", str(tmp_path / "hash"))
    monkeypatch.setenv("CUCUMBERVISION_LOGIN", "")
    monkeypatch.chdir(tmp_path)
    from cucumbervision.dashboard.access import login_of

    with pytest.raises(AccessError, match="no login set up"):
        serve(str(tmp_path / "house.db"), browser=False, login=True)
    # The server's pages ask by the same variable.
    write_password_hash(tmp_path / "hash", hash_password("a row of cucumbers"))
    assert login_of("127.0.0.1") is Login.PASSWORD
    monkeypatch.setenv("CUCUMBERVISION_LOGIN", "")
    assert login_of("127.0.0.1") is Login.NONE


def test_a_replay_that_is_not_there_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("streamlit")
    with pytest.raises(CucumberVisionError, match="does not exist"):
        serve(str(tmp_path / "house.db"), replay=tmp_path / "no", browser=False)


def test_nothing_is_told_to_anybody() -> None:
    said = server_arguments("127.0.0.1", 8501, browser=False)
    assert "--browser.gatherUsageStats=false" in said
    assert "--server.showEmailPrompt=false" in said
    assert "--server.address=127.0.0.1" in said
