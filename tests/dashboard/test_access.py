from __future__ import annotations

import base64
import contextlib
import hashlib
import os
import stat
import threading
from pathlib import Path

import pytest

from cucumbervision.dashboard.access import (
    Attempts,
    Login,
    decide_login,
    has_oidc,
    hash_password,
    is_loopback,
    password_file,
    read_password_hash,
    verify_password,
    write_password_hash,
)
from cucumbervision.errors import AccessError

WORDS = "grüne gurken im haus"
AUTH = '[auth]\nredirect_uri = "https://a/oauth2callback"\ncookie_secret = "x"\n'
CLIENT = 'client_id = "a"\nclient_secret = "b"\nserver_metadata_url = "https://c"\n'


@pytest.fixture(scope="module")
def kept() -> str:
    return hash_password(WORDS, log2_n=8)


@pytest.mark.parametrize("address", ["127.0.0.1", "127.8.8.8", "localhost", "LOCALHOST", "[::1]"])
def test_on_this_machine_nobody_logs_in(address: str) -> None:
    assert is_loopback(address)
    assert decide_login(address, oidc=False, password=False) is Login.NONE
    assert decide_login(address, oidc=False, password=True, always=True) is Login.PASSWORD
    with pytest.raises(AccessError, match="there is no login"):
        decide_login(address, oidc=False, password=False, always=True)


@pytest.mark.parametrize(
    "address", ["0.0.0.0", "::", "", "192.168.1.7", "house.example", "127.0.0.1.example"]
)
def test_beyond_it_there_is_a_login_or_no_start(address: str) -> None:
    with pytest.raises(AccessError, match="there is no login; run `cucumbervision dashboard set-"):
        decide_login(address, oidc=False, password=False)
    assert decide_login(address, oidc=False, password=True) is Login.PASSWORD
    assert decide_login(address, oidc=True, password=True) is Login.OIDC


def test_the_key_is_scrypts_own(kept: str) -> None:
    _, n, r, p, salt, key = kept.split("$")
    expected = hashlib.scrypt(
        WORDS.encode(), salt=base64.b64decode(salt), n=2 ** int(n), r=int(r), p=int(p), dklen=32
    )
    assert base64.b64decode(key) == expected


def test_a_password_is_right_or_wrong(kept: str) -> None:
    assert verify_password(WORDS, kept)
    assert not verify_password(WORDS + " ", kept)
    assert not verify_password("", kept)
    assert hash_password(WORDS, log2_n=8) != kept  # another salt


def test_short_passwords_are_refused() -> None:
    with pytest.raises(AccessError, match="has 9 characters; take at least 10"):
        hash_password("123456789")


@pytest.mark.parametrize("text", ["", "x", "scrypt$8$8$1$AA==", "scrypt$99$8$1$AA==$AA==", "a$b"])
def test_what_is_no_hash_is_refused(text: str) -> None:
    with pytest.raises(AccessError, match="no password hash"):
        verify_password(WORDS, text)


def test_the_default_cost_is_owasps(tmp_path: Path) -> None:
    text = hash_password(WORDS)
    assert text.startswith("scrypt$17$8$1$")
    assert verify_password(WORDS, text)


def test_the_hash_is_kept_for_its_owner_alone(tmp_path: Path, kept: str) -> None:
    path = tmp_path / "new" / "password"
    assert read_password_hash(path) is None
    write_password_hash(path, kept)
    write_password_hash(path, kept)
    assert read_password_hash(path) == kept
    assert [p.name for p in path.parent.iterdir()] == ["password"]
    if os.name == "posix":
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        path.chmod(0o640)
        with pytest.raises(AccessError, match=r"others on this machine .* chmod 600"):
            read_password_hash(path)


def test_a_file_without_a_hash_is_named(tmp_path: Path, kept: str) -> None:
    path = tmp_path / "password"
    path.touch(mode=0o600)
    with pytest.raises(AccessError, match=r"password: what is kept is no password hash"):
        read_password_hash(path)
    with pytest.raises(AccessError, match="no password hash"):
        write_password_hash(path, WORDS)
    with pytest.raises(AccessError, match="cannot be written"):
        write_password_hash(path / "below", kept)


def test_a_variable_names_another_file() -> None:
    assert password_file({"CUCUMBERVISION_PASSWORD_FILE": "/run/secret"}) == Path("/run/secret")
    assert password_file({}).name == "dashboard-password"


def test_streamlits_login_must_be_whole(tmp_path: Path) -> None:
    path = tmp_path / "secrets.toml"
    assert not has_oidc([path])
    path.write_text('other = "x"\n')
    assert not has_oidc([path])
    path.write_text(AUTH + CLIENT)
    assert has_oidc([tmp_path / "none.toml", path])
    path.write_text(AUTH + "[auth.house]\n" + CLIENT)
    assert has_oidc([path])
    path.write_text(AUTH)
    with pytest.raises(AccessError, match="has no client_id and client_secret and server_metadata"):
        has_oidc([path])
    path.write_text("[auth]\n" + CLIENT)
    with pytest.raises(AccessError, match="has no redirect_uri and cookie_secret"):
        has_oidc([path])
    path.write_text("[auth")
    with pytest.raises(AccessError, match="cannot be read"):
        has_oidc([path])


def test_waits_double_and_end(kept: str) -> None:
    now = [0.0]
    attempts = Attempts(free=2, longest_s=4.0, clock=lambda: now[0])
    waits = [attempts.failed("a") for _ in range(6)]
    assert waits == [0.0, 0.0, 1.0, 2.0, 4.0, 4.0]
    assert attempts.wait_s("b") == 0
    with pytest.raises(AccessError, match="too many wrong passwords; wait 4 s"):
        attempts.check("a", WORDS, kept)
    now[0] = 4.0
    assert attempts.check("a", WORDS, kept)
    assert attempts.failed("a") == 0.0  # forgotten


def test_many_at_once_gain_nothing(kept: str) -> None:
    attempts = Attempts(free=2, first_s=60.0)
    looked_at = []

    def guess() -> None:
        with contextlib.suppress(AccessError):
            looked_at.append(attempts.check("a", "wrong", kept))

    threads = [threading.Thread(target=guess) for _ in range(30)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert looked_at == [False] * 3
    assert attempts.wait_s("a") > 0


def test_it_forgets_whom_it_heard_of_longest_ago() -> None:
    attempts = Attempts(free=0, most=2)
    for client in ("a", "b", "a", "c"):
        attempts.failed(client)
    assert attempts.wait_s("b") == 0
    assert attempts.wait_s("a") > 1
