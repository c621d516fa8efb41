"""Who may open the dashboard: anyone on this machine, nobody from elsewhere without a login.

Two ways to log in: accounts of the dashboard's own, with passwords that argon2-cffi hashes, or an
OpenID Connect provider by Streamlit's `st.login` with a list of whom it may admit.
"""

from __future__ import annotations

import math
import os
import re
import secrets
import threading
import time
import tomllib
from collections import OrderedDict
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from argon2 import PasswordHasher, extract_parameters
from argon2.exceptions import InvalidHashError, VerificationError

from cucumbervision.dashboard.server import LOGIN_VARIABLE
from cucumbervision.errors import AccessError
from cucumbervision.service.settings import is_loopback

if TYPE_CHECKING:
    from collections.abc import Mapping

SESSION_S = 12 * 3600.0  # a working day; then the viewer logs in again
_SHORTEST = 10  # characters of a password
_FREE_ATTEMPTS = 3  # wrong passwords in a row before the first delay
_LONGEST_DELAY_S = 60.0
_FORGOTTEN_S = 15 * 60.0  # after this time without one, wrong passwords no longer count
_MOST_NAMES = 10_000  # of accounts, real or invented, whose wrong passwords are remembered
_ACCOUNTS_VARIABLE = "CUCUMBERVISION_ACCOUNTS_FILE"
_SET_UP = (
    "run `cucumbervision dashboard set-password NAME`, or set up [auth] in Streamlit's secrets.toml"
)
_HASHER = PasswordHasher()  # argon2id with the parameters of RFC 9106 for 64 MiB
_ACCOUNT = re.compile(r"[\w.@-]{1,64}")
_OIDC_SHARED = ("redirect_uri", "cookie_secret")
_OIDC_PROVIDER = ("client_id", "client_secret", "server_metadata_url")


class Login(StrEnum):
    """How viewers log in."""

    NONE = "none"
    OIDC = "oidc"
    PASSWORD = "password"


def decide_login(address: str, *, oidc: bool, accounts: bool, always: bool = False) -> Login:
    """Return how viewers of a server log in.

    Parameters
    ----------
    address : str
        What the server binds to.
    oidc, accounts : bool
        Whether OpenID Connect is set up, and whether there are accounts with passwords.
    always : bool
        Require a login on this machine too: for a server behind a proxy that others reach.

    Raises
    ------
    AccessError
        If a login is required and none is set up.

    Examples
    --------
    >>> decide_login("localhost", oidc=False, accounts=True)
    <Login.NONE: 'none'>
    >>> decide_login("0.0.0.0", oidc=False, accounts=True)
    <Login.PASSWORD: 'password'>
    >>> decide_login("0.0.0.0", oidc=False, accounts=False)
    Traceback (most recent call last):
    ...
    cucumbervision.errors.AccessError: 0.0.0.0: other machines can reach this address, and no login
    is set up; run `cucumbervision dashboard set-password NAME`, ...
    """
    if is_loopback(address) and not always:
        return Login.NONE
    if oidc:
        return Login.OIDC
    if accounts:
        return Login.PASSWORD
    if is_loopback(address):
        raise AccessError("--login requires a login, and none is set up", remedy=_SET_UP)
    raise AccessError(
        "other machines can reach this address, and no login is set up",
        source=address or "all addresses",
        remedy=f"{_SET_UP}, or bind to 127.0.0.1",
    )


def configured_login(address: str) -> Login:
    """Return how viewers of a server at this address log in, by this machine's configuration.

    Raises
    ------
    AccessError
        If a login is required and none is set up, or its files cannot be used.
    """
    return decide_login(
        address,
        oidc=read_openid_connect() is not None,
        accounts=bool(read_accounts(accounts_file())),
        always=bool(os.environ.get(LOGIN_VARIABLE)),
    )


@dataclass(frozen=True)
class OpenIdConnect:
    """Login by accounts of an OpenID Connect provider.

    Parameters
    ----------
    providers : tuple of str
        Names in [auth.NAME]; empty for the one provider of [auth] itself.
    admitted : frozenset of str
        E-mail addresses in lower case, and subject identifiers (`sub`), which have no '@'.
    """

    providers: tuple[str, ...]
    admitted: frozenset[str]

    def admits(self, claims: Mapping[str, Any]) -> bool:
        """Return whether an ID token is younger than `SESSION_S` and names somebody admitted.

        An e-mail address counts only if the provider says that it verified it. The token's age
        counts because Streamlit's cookie would keep the login for 30 days.

        Examples
        --------
        >>> only_anna = OpenIdConnect((), frozenset({"anna@example.org"}))
        >>> token = {"iat": time.time(), "email": "Anna@example.org"}
        >>> only_anna.admits(token | {"email_verified": True}), only_anna.admits(token)
        (True, False)
        """
        if time.time() > float(claims.get("iat") or 0) + SESSION_S:
            return False
        email, subject = str(claims.get("email", "")).lower(), str(claims.get("sub", ""))
        if "@" in email and claims.get("email_verified") is True and email in self.admitted:
            return True
        return "@" not in subject and subject in self.admitted


def read_openid_connect(files: tuple[Path, ...] | None = None) -> OpenIdConnect | None:
    """Return the login by OpenID Connect that Streamlit's secrets files set up; None for none.

    Parameters
    ----------
    files : tuple of Path, optional
        By default `~/.streamlit/secrets.toml` and `.streamlit/secrets.toml`; later ones override
        earlier ones, as in Streamlit.

    Raises
    ------
    AccessError
        If a file is not TOML, [auth] lacks a key that `st.login` needs, or [cucumbervision] has no
        list `admitted`: anyone with an account at a public provider could log in.
    """
    if files is None:
        files = tuple(at / ".streamlit" / "secrets.toml" for at in (Path.home(), Path.cwd()))
    document: dict[str, Any] = {}
    for path in files:
        try:
            document |= tomllib.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            continue
        except (OSError, ValueError, RecursionError) as error:
            raise AccessError(
                f"cannot be read ({error})", source=path, remedy="correct it"
            ) from None
    auth, own = document.get("auth"), document.get("cucumbervision")
    if auth is None:
        return None
    auth = auth if isinstance(auth, dict) else {}
    named = {name: part for name, part in auth.items() if isinstance(part, dict)}
    missing = [key for key in _OIDC_SHARED if not auth.get(key)]
    missing += [k for k in _OIDC_PROVIDER if not all(p.get(k) for p in named.values() or [auth])]
    if missing:
        raise AccessError(
            f"[auth] has no {' and '.join(missing)}",
            source="secrets.toml",
            remedy="see Streamlit's page on st.login",
        )
    admitted = own.get("admitted") if isinstance(own, dict) else None
    if not isinstance(admitted, list) or not admitted:
        raise AccessError(
            "[auth] is set up, but nobody is admitted",
            source="secrets.toml",
            remedy='add [cucumbervision] with admitted = ["name@example.org"]',
        )
    # Addresses are compared without regard to case, subject identifiers exactly.
    names = {str(one).lower() if "@" in str(one) else str(one) for one in admitted}
    return OpenIdConnect(tuple(named), frozenset(names))


def accounts_file(environment: Mapping[str, str] | None = None) -> Path:
    """Return the path of the file that holds the accounts' password hashes.

    `CUCUMBERVISION_ACCOUNTS_FILE` names another than the user's own, as for a mounted secret.
    """
    named = (os.environ if environment is None else environment).get(_ACCOUNTS_VARIABLE)
    if named:
        return Path(named)
    from platformdirs import user_config_path

    return user_config_path("cucumbervision", appauthor=False) / "dashboard-accounts"


def read_accounts(path: Path) -> dict[str, str]:
    """Return the password hash of each account; empty where there is no file.

    Raises
    ------
    AccessError
        If other users of this machine can read or write the file, or a line is not 'name:hash'.
    """
    try:
        mode = path.stat().st_mode
        lines = path.read_text(encoding="utf-8", errors="replace").split()
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise AccessError(
            f"cannot be read ({error.strerror})", source=path, remedy="check its permissions"
        ) from None
    if os.name == "posix" and mode & 0o077:
        raise AccessError(
            "others on this machine can read or write it", source=path, remedy=f"chmod 600 {path}"
        )
    accounts = dict(line.split(":", 1) for line in lines if ":" in line)
    try:
        for password_hash in accounts.values():
            extract_parameters(password_hash)
    except InvalidHashError:
        accounts = {}
    if len(accounts) < len(lines):
        raise AccessError(
            "is not a list of accounts with argon2 hashes",
            source=path,
            remedy="delete it and run `cucumbervision dashboard set-password NAME`",
        )
    return accounts


def set_password(path: Path, account: str, password: str) -> None:
    """Write an account's new password hash into the file, readable by its owner only.

    Parameters
    ----------
    path : Path
        As `accounts_file` gives it; made where it is missing, replaced in one step.
    account : str
        1 to 64 letters, digits, '.', '-', '_' and '@'.
    password : str
        At least `_SHORTEST` characters.

    Raises
    ------
    AccessError
        If name or password does not serve, or the file cannot be read or written.
    """
    if not _ACCOUNT.fullmatch(account):
        raise AccessError(
            f"{account[:64]!r} cannot be an account's name", remedy="use letters and digits"
        )
    if len(password) < _SHORTEST:
        raise AccessError(
            f"the password has {len(password)} characters",
            remedy=f"use at least {_SHORTEST}, for example four words",
        )
    accounts = read_accounts(path) | {account: _HASHER.hash(password)}
    temporary = path.with_name(f"{path.name}.{secrets.token_hex(4)}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as stream:  # noqa: PTH123
            stream.writelines(f"{name}:{kept}\n" for name, kept in accounts.items())
        temporary.replace(path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise AccessError(
            f"cannot be written ({error.strerror})", source=path, remedy="choose another folder"
        ) from None


@dataclass(frozen=True)
class Session:
    """A viewer who logged in with a password.

    It ends after `SESSION_S`, by a clock that nobody can set back, and when the account's password
    changes or the account is removed.
    """

    account: str
    password_hash: str
    until_s: float

    def holds(self, accounts: Mapping[str, str]) -> bool:
        """Return whether the session still holds, given the accounts that there are now."""
        return time.monotonic() < self.until_s and accounts.get(self.account) == self.password_hash


class PasswordChecker:
    """Checks passwords for the whole server; any number of threads may use it.

    After `_FREE_ATTEMPTS` wrong passwords in a row an account takes no other for 1 s, then for 2 s,
    4 s and so on up to `_LONGEST_DELAY_S`, whoever tries. An attempt within that time is not looked
    at and lengthens nothing, so that nobody can keep an account's owner out for long. The right
    password clears the count.

    Examples
    --------
    >>> checker = PasswordChecker()
    >>> accounts = {"anna": PasswordHasher().hash("correct horse battery")}
    >>> checker.log_in(accounts, "anna", "wrong") is None
    True
    >>> checker.log_in(accounts, "anna", "correct horse battery").account
    'anna'
    """

    def __init__(self) -> None:
        self._wrong: OrderedDict[str, tuple[int, float]] = OrderedDict()
        self._counting = threading.Lock()
        self._verifying = threading.Lock()  # one at a time: each takes 64 MiB

    def log_in(self, accounts: Mapping[str, str], account: str, password: str) -> Session | None:
        """Return a session if the password is the account's, else None.

        Raises
        ------
        AccessError
            If the account waits after wrong passwords: this one is then not looked at.
        """
        account = account.strip()[:64]
        self._count(account)
        password_hash = accounts.get(account)
        with self._verifying:
            # An unknown account takes as long as a known one.
            right = _verifies(password_hash or _hash_of_nothing(), password)
        if not right or password_hash is None:
            return None
        with self._counting:
            self._wrong.pop(account, None)
        return Session(account, password_hash, time.monotonic() + SESSION_S)

    def _count(self, account: str) -> None:
        """Count an attempt before it is verified: many at once gain nothing."""
        now = time.monotonic()
        with self._counting:
            wrong, last_s = self._wrong.pop(account, (0, now))
            if now - last_s > _FORGOTTEN_S:
                wrong = 0
            left_s = last_s + delay_s(wrong) - now
            self._wrong[account] = (wrong, last_s) if left_s > 0 else (wrong + 1, now)
            while len(self._wrong) > _MOST_NAMES:
                self._wrong.popitem(last=False)
        if left_s > 0:
            seconds = math.ceil(left_s)
            raise AccessError(
                "too many wrong passwords for this account",
                remedy=f"wait {seconds} second{'s' * (seconds > 1)} and try again",
            )


def delay_s(wrong: int) -> float:
    """Return how long an account waits after this many wrong passwords in a row, seconds.

    Examples
    --------
    >>> [delay_s(wrong) for wrong in (0, 3, 4, 5, 6, 9, 10, 1000)]
    [0.0, 1.0, 2.0, 4.0, 8.0, 60.0, 60.0, 60.0]
    """
    if wrong < _FREE_ATTEMPTS:
        return 0.0
    return min(2.0 ** min(wrong - _FREE_ATTEMPTS, 30), _LONGEST_DELAY_S)


def _verifies(password_hash: str, password: str) -> bool:
    with suppress(VerificationError):
        return _HASHER.verify(password_hash, password)
    return False


@cache
def _hash_of_nothing() -> str:
    return _HASHER.hash(secrets.token_hex())
