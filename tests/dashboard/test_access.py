from __future__ import annotations

import contextlib
import os
import stat
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("streamlit")

import argon2

from cucumbervision.dashboard import access
from cucumbervision.dashboard.access import (
    SESSION_S,
    Login,
    PasswordChecker,
    Session,
    accounts_file,
    decide_login,
    read_accounts,
    read_openid_connect,
    set_password,
)
from cucumbervision.errors import AccessError
from cucumbervision.service.settings import is_loopback

WORDS = "grüne gurken im haus"
HASHER = access._HASHER  # as it ships
AUTH = '[auth]\nredirect_uri = "https://a/oauth2callback"\ncookie_secret = "x"\n'
CLIENT = 'client_id = "a"\nclient_secret = "b"\nserver_metadata_url = "https://c"\n'
ADMITTED = '[cucumbervision]\nadmitted = ["Anna@example.org", "248289761001"]\n'


@pytest.fixture(scope="module", autouse=True)
def _quick_hashes() -> Iterator[None]:
    """Hash as little as Argon2 allows: how dear a guess is, is a test of its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(access, "_HASHER", argon2.PasswordHasher(1, 8, 1))
        access._hash_of_nothing.cache_clear()
        yield
    access._hash_of_nothing.cache_clear()


@pytest.fixture(scope="module")
def accounts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    path = tmp_path_factory.mktemp("accounts") / "accounts"
    set_password(path, "anna", WORDS)
    return read_accounts(path)


@pytest.mark.parametrize("address", ["127.0.0.1", "127.8.8.8", "localhost", "LOCALHOST", "[::1]"])
def test_loopback_requires_no_login_unless_asked_for(address: str) -> None:
    assert is_loopback(address)
    assert decide_login(address, oidc=False, accounts=False) is Login.NONE
    assert decide_login(address, oidc=False, accounts=True, always=True) is Login.PASSWORD
    with pytest.raises(AccessError, match="--login requires a login, and none is set up"):
        decide_login(address, oidc=False, accounts=False, always=True)


@pytest.mark.parametrize(
    "address", ["0.0.0.0", "::", "", "192.168.1.7", "house.example", "127.0.0.1.example"]
)
def test_other_addresses_require_a_login(address: str) -> None:
    with pytest.raises(AccessError, match="no login is set up; run `cucumbervision dashboard set-"):
        decide_login(address, oidc=False, accounts=False)
    assert decide_login(address, oidc=False, accounts=True) is Login.PASSWORD
    assert decide_login(address, oidc=True, accounts=True) is Login.OIDC


def test_only_argon2_hashes_are_stored_for_their_owner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(access, "_HASHER", HASHER)
    path = tmp_path / "new" / "accounts"
    assert read_accounts(path) == {}
    set_password(path, "anna", WORDS)
    set_password(path, "ben@house", WORDS)
    first = read_accounts(path)
    set_password(path, "anna", WORDS)
    again = read_accounts(path)
    assert list(again) == ["anna", "ben@house"]
    assert again["anna"] != first["anna"]  # another salt
    assert again["ben@house"] == first["ben@house"]
    assert argon2.PasswordHasher().verify(again["anna"], WORDS)
    parameters = argon2.extract_parameters(again["anna"])
    assert parameters.type is argon2.Type.ID
    assert parameters.memory_cost >= 19 * 1024  # KiB: OWASP's least for argon2id
    assert WORDS not in path.read_text(encoding="utf-8")
    assert [p.name for p in path.parent.iterdir()] == ["accounts"]
    if os.name == "posix":
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        path.chmod(0o640)
        with pytest.raises(AccessError, match=r"others on this machine .* chmod 600"):
            read_accounts(path)


@pytest.mark.parametrize(
    ("account", "password", "message"),
    [
        ("anna", "123456789", "has 9 characters; use at least 10"),
        ("anna:ben", WORDS, "cannot be an account's name"),
        ("", WORDS, "cannot be an account's name"),
        ("a\nb", WORDS, "cannot be an account's name"),
    ],
)
def test_unusable_names_and_passwords_are_refused(
    account: str, password: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(AccessError, match=message):
        set_password(tmp_path / "accounts", account, password)
    assert not (tmp_path / "accounts").exists()


@pytest.mark.parametrize("text", ["anna", "anna:secret", "anna:$argon2id$v=19$x", "a b c"])
def test_a_file_of_anything_else_is_named(text: str, tmp_path: Path) -> None:
    path = tmp_path / "accounts"
    path.touch(mode=0o600)
    assert read_accounts(path) == {}
    path.write_text(text)
    with pytest.raises(AccessError, match="accounts: is not a list of accounts"):
        read_accounts(path)
    with pytest.raises(AccessError, match="accounts: is not a list of accounts"):
        set_password(path, "anna", WORDS)


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(AccessError, match="cannot be"):
        set_password(tmp_path / "file" / "accounts", "anna", WORDS)


def test_a_variable_names_another_file() -> None:
    assert accounts_file({"CUCUMBERVISION_ACCOUNTS_FILE": "/run/secret"}) == Path("/run/secret")
    assert accounts_file({}).name == "dashboard-accounts"


def test_a_password_opens_its_own_account_only(accounts: dict[str, str]) -> None:
    checker = PasswordChecker()
    session = checker.log_in(accounts, " anna ", WORDS)
    assert session is not None
    assert session.account == "anna"
    for account, password in (("anna", WORDS + " "), ("anna", ""), ("ben", WORDS), ("", "")):
        assert checker.log_in(accounts, account, password) is None


def test_a_session_ends_with_time_password_and_account(
    accounts: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 1_700_000_000.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    session = PasswordChecker().log_in(accounts, "anna", WORDS)
    assert session == Session("anna", accounts["anna"], now + SESSION_S)
    assert session.holds(accounts)
    set_password(tmp_path / "accounts", "anna", WORDS + "!")
    assert not session.holds(read_accounts(tmp_path / "accounts"))
    assert not session.holds({})
    now += SESSION_S
    assert not session.holds(accounts)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """A clock that stands still until a test moves it."""
    now = [1000.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    return now


def test_wrong_passwords_make_an_account_wait_ever_longer(
    accounts: dict[str, str], clock: list[float]
) -> None:
    checker = PasswordChecker()
    for seconds in (0, 0, 0, 1, 2, 4, 8, 16, 32, 60, 60):
        if seconds:
            clock[0] += seconds - 0.5
            with pytest.raises(AccessError, match="wait 1 second and try again"):
                checker.log_in(accounts, "anna", WORDS)  # not looked at, and lengthens nothing
            clock[0] += 0.5
        assert checker.log_in(accounts, "anna", "wrong") is None
    with pytest.raises(AccessError, match="wait 60 seconds"):
        checker.log_in(accounts, "anna", WORDS)
    assert checker.log_in(accounts, "ben", WORDS) is None  # another account is not affected
    clock[0] += 60
    assert checker.log_in(accounts, "anna", WORDS) is not None  # clears the count
    for _ in range(3):
        assert checker.log_in(accounts, "anna", "wrong") is None


def test_wrong_passwords_are_forgotten_after_a_while(
    accounts: dict[str, str], clock: list[float]
) -> None:
    checker = PasswordChecker()
    for _ in range(3):
        assert checker.log_in(accounts, "anna", "wrong") is None
        clock[0] += 15 * 60 + 1
    for _ in range(3):
        assert checker.log_in(accounts, "anna", "wrong") is None


def test_invented_names_fill_no_memory(
    accounts: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(access, "_verifies", lambda *_: False)
    monkeypatch.setattr(access, "_MOST_NAMES", 50)
    checker = PasswordChecker()
    for number in range(80):
        checker.log_in(accounts, f"nobody {number}", "wrong")
    assert len(checker._wrong) == 50


def test_many_attempts_at_once_gain_nothing(accounts: dict[str, str]) -> None:
    checker, verified = PasswordChecker(), []

    def guess() -> None:
        with contextlib.suppress(AccessError):
            verified.append(checker.log_in(accounts, "anna", "wrong"))

    # All are counted before the first is verified, which takes long.
    with checker._verifying:
        threads = [threading.Thread(target=guess) for _ in range(30)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(0.2)
    for thread in threads:
        thread.join()
    assert 3 <= len(verified) <= 6


def test_openid_connect_must_be_complete_and_admit_somebody(tmp_path: Path) -> None:
    path = tmp_path / "secrets.toml"

    def read(text: str) -> access.OpenIdConnect | None:
        path.write_text(text)
        return read_openid_connect((tmp_path / "none.toml", path))

    assert read_openid_connect((path,)) is None
    assert read('other = "x"\n') is None
    one = read(AUTH + CLIENT + ADMITTED)
    assert one is not None
    assert one.providers == ()
    assert one.admitted == {"anna@example.org", "248289761001"}
    named = read(AUTH + "[auth.house]\n" + CLIENT + ADMITTED)
    assert named is not None
    assert named.providers == ("house",)
    for text, message in (
        (AUTH + ADMITTED, "has no client_id and client_secret and server_metadata_url"),
        ("[auth]\n" + CLIENT + ADMITTED, "has no redirect_uri and cookie_secret"),
        (AUTH + CLIENT, "nobody is admitted"),
        (AUTH + CLIENT + "[cucumbervision]\nadmitted = []", "nobody is admitted"),
        ("[auth", "cannot be read"),
    ):
        with pytest.raises(AccessError, match=message):
            read(text)


@pytest.mark.parametrize(
    ("claims", "admitted"),
    [
        ({"sub": "1", "email": "ANNA@example.org", "email_verified": True}, True),
        ({"sub": "248289761001"}, True),
        ({"sub": "1", "email": "anna@example.org", "email_verified": False}, False),
        ({"sub": "1", "email": "anna@example.org"}, False),
        ({"sub": "anna@example.org"}, False),
        ({"sub": "1", "email": "248289761001", "email_verified": True}, False),
        ({"sub": "1", "email": "eve@example.org", "email_verified": True}, False),
        ({}, False),
    ],
)
def test_admitted_are_verified_addresses_and_subjects(
    claims: dict[str, Any], admitted: bool, tmp_path: Path
) -> None:
    path = tmp_path / "secrets.toml"
    path.write_text(AUTH + CLIENT + ADMITTED)
    oidc = read_openid_connect((path,))
    assert oidc is not None
    assert oidc.admits({**claims, "iat": time.time()}) is admitted
    assert not oidc.admits({**claims, "iat": time.time() - SESSION_S - 1})
    assert not oidc.admits(claims)
