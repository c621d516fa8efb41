"""Who may open the dashboard: anyone on this machine, nobody from elsewhere without a login."""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import ipaddress
import os
import secrets
import threading
import time
import tomllib
from contextlib import suppress
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

import streamlit as st

from cucumbervision.dashboard.server import LOGIN_VARIABLE
from cucumbervision.errors import AccessError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

__all__ = [
    "LOGIN_REMEDY",
    "Attempts",
    "Login",
    "decide_login",
    "has_oidc",
    "hash_password",
    "is_loopback",
    "login_of",
    "password_file",
    "read_password_hash",
    "require_login",
    "secrets_files",
    "verify_password",
    "write_password_hash",
]

_SET_UP = "run `cucumbervision dashboard set-password`, set up [auth] in Streamlit's secrets.toml"

LOGIN_REMEDY = f"{_SET_UP}, or bind to 127.0.0.1"

SHORTEST = 10  # characters of a password

_FILE = "dashboard-password"

# OWASP's password storage cheat sheet: scrypt with n = 2**17, r = 8, p = 1, some 128 MB.
_LOG2_N, _R, _P = 17, 8, 1

_MOST_MEMORY = 512 * 1024 * 1024

_SALT_BYTES, _KEY_BYTES = 16, 32

_OIDC_KEYS = ("client_id", "client_secret", "server_metadata_url")

_OIDC_SHARED = ("redirect_uri", "cookie_secret")


class Login(StrEnum):
    """How people log in."""

    NONE = "none"
    OIDC = "oidc"
    PASSWORD = "password"


def is_loopback(address: str) -> bool:
    """Say whether an address to bind to is reached from this machine alone.

    An empty address means all of a machine's, and a name other than localhost may be anything.

    Examples
    --------
    >>> [is_loopback(a) for a in ("127.0.0.1", "localhost", "::1", "0.0.0.0", "", "192.168.1.5")]
    [True, True, True, False, False, False]
    """
    name = address.strip().strip("[]").lower()
    if name == "localhost":
        return True
    with suppress(ValueError):
        return ipaddress.ip_address(name).is_loopback
    return False


def has_oidc(secrets_files: Sequence[Path]) -> bool:
    """Say whether one of Streamlit's secrets files sets up a login by OpenID Connect.

    Parameters
    ----------
    secrets_files : sequence of Path
        `~/.streamlit/secrets.toml` and `.streamlit/secrets.toml`; missing ones are skipped.

    Raises
    ------
    AccessError
        If a file has an [auth] part that is not whole, or is no TOML.

    Notes
    -----
    Streamlit's `st.login`: `redirect_uri` and `cookie_secret` in [auth], and `client_id`,
    `client_secret` and `server_metadata_url` there or in each [auth.PROVIDER].
    """
    for path in secrets_files:
        try:
            document = tomllib.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            continue
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise AccessError(
                f"cannot be read ({error})", source=path, remedy="correct it"
            ) from None
        auth = document.get("auth")
        if auth is None:
            continue
        if missing := _missing_keys(auth):
            raise AccessError(
                f"[auth] has no {missing}", source=path, remedy="see Streamlit's page on st.login"
            )
        return True
    return False


def _missing_keys(auth: object) -> str:
    if not isinstance(auth, dict):
        return " and ".join((*_OIDC_SHARED, *_OIDC_KEYS))
    parts = [part for part in auth.values() if isinstance(part, dict)] or [auth]
    missing = [key for key in _OIDC_SHARED if not auth.get(key)]
    missing += [key for key in _OIDC_KEYS if not all(part.get(key) for part in parts)]
    return " and ".join(missing)


def decide_login(address: str, *, oidc: bool, password: bool, always: bool = False) -> Login:
    """Decide how people log in, or refuse to start.

    Parameters
    ----------
    address : str
        What the server binds to.
    oidc : bool
        Whether Streamlit's login is set up: `has_oidc`.
    password : bool
        Whether a password's hash is there: `read_password_hash` gave one.
    always : bool
        Ask on this machine too: for a server behind a proxy that others reach.

    Raises
    ------
    AccessError
        If it binds beyond this machine, or is always to ask, and there is neither.

    Examples
    --------
    >>> decide_login("localhost", oidc=False, password=True)
    <Login.NONE: 'none'>
    >>> decide_login("0.0.0.0", oidc=False, password=True)
    <Login.PASSWORD: 'password'>
    >>> decide_login("0.0.0.0", oidc=False, password=False)
    Traceback (most recent call last):
    ...
    cucumbervision.errors.AccessError: 0.0.0.0: others could open the dashboard, and there is no
    login; run `cucumbervision dashboard set-password`, ...
    """
    if is_loopback(address) and not always:
        return Login.NONE
    if oidc:
        return Login.OIDC
    if password:
        return Login.PASSWORD
    if always:
        raise AccessError(
            "a login is asked for, and there is no login set up", source=address, remedy=_SET_UP
        )
    raise AccessError(
        "others could open the dashboard, and there is no login",
        source=address or "all addresses",
        remedy=LOGIN_REMEDY,
    )


def hash_password(password: str, *, log2_n: int = _LOG2_N) -> str:
    """Hash a password for keeping: scrypt (RFC 7914), with its parameters and salt.

    Parameters
    ----------
    password : str
        At least `SHORTEST` characters.
    log2_n : int
        Cost: each step doubles time and memory (17 takes 128 MB).

    Returns
    -------
    str
        `scrypt$log2_n$r$p$salt$key`, the last two in base 64.

    Raises
    ------
    AccessError
        If the password is too short.

    Examples
    --------
    >>> kept = hash_password("correct horse battery", log2_n=10)
    >>> kept.split("$")[:4], verify_password("correct horse battery", kept)
    (['scrypt', '10', '8', '1'], True)
    """
    if len(password) < SHORTEST:
        raise AccessError(
            f"the password has {len(password)} characters",
            remedy=f"take at least {SHORTEST}, such as four words",
        )
    salt = secrets.token_bytes(_SALT_BYTES)
    key = _scrypt(password, salt, log2_n, _R, _P)
    parts = (str(log2_n), str(_R), str(_P), *(base64.b64encode(b).decode() for b in (salt, key)))
    return "$".join(("scrypt", *parts))


def verify_password(password: str, kept: str) -> bool:
    """Say whether a password is the one whose hash was kept, in a time that tells nothing.

    Raises
    ------
    AccessError
        If what was kept is no hash of `hash_password`.
    """
    log2_n, r, p, salt, key = _parsed(kept)
    return hmac.compare_digest(_scrypt(password, salt, log2_n, r, p), key)


def _parsed(kept: str) -> tuple[int, int, int, bytes, bytes]:
    try:
        name, *numbers, salt, key = kept.strip().split("$")
        log2_n, r, p = (int(number) for number in numbers)
        parsed = (log2_n, r, p, base64.b64decode(salt, validate=True), base64.b64decode(key))
    except (ValueError, binascii.Error):
        name, parsed = "", (0, 0, 0, b"", b"")
    within = 1 <= parsed[0] <= 20 and 1 <= parsed[1] <= 32 and 1 <= parsed[2] <= 16
    if name != "scrypt" or not within or len(parsed[4]) != _KEY_BYTES:
        raise AccessError(
            "what is kept is no password hash", remedy="run `cucumbervision dashboard set-password`"
        )
    return parsed


def _scrypt(password: str, salt: bytes, log2_n: int, r: int, p: int) -> bytes:
    return hashlib.scrypt(
        password.encode("utf-8", "surrogatepass"),
        salt=salt,
        n=1 << log2_n,
        r=r,
        p=p,
        maxmem=_MOST_MEMORY,
        dklen=_KEY_BYTES,
    )


def password_file(environment: Mapping[str, str] | None = None) -> Path:
    """Give the file in which the password's hash is kept.

    `CUCUMBERVISION_PASSWORD_FILE` names another, as for a mounted secret.
    """
    named = (os.environ if environment is None else environment).get("CUCUMBERVISION_PASSWORD_FILE")
    if named:
        return Path(named)
    from platformdirs import user_config_path

    return user_config_path("cucumbervision", appauthor=False) / _FILE


def write_password_hash(path: Path, kept: str) -> None:
    """Keep a hash, readable by its owner alone, in place of an earlier one.

    Raises
    ------
    AccessError
        If it is no hash, or the file cannot be written.
    """
    _parsed(kept)
    temporary = path.with_name(f"{path.name}.{secrets.token_hex(4)}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as stream:  # noqa: PTH123
            stream.write(f"{kept}\n")
        temporary.replace(path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise AccessError(
            f"cannot be written ({error.strerror})", source=path, remedy="choose another folder"
        ) from None


def read_password_hash(path: Path) -> str | None:
    """Read the hash that was kept; None if there is none.

    Raises
    ------
    AccessError
        If the file can be read by others, or holds no hash.
    """
    try:
        mode = path.stat().st_mode
        kept = path.read_text(encoding="utf-8", errors="replace").strip()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise AccessError(
            f"cannot be read ({error.strerror})", source=path, remedy="check its rights"
        ) from None
    if os.name == "posix" and mode & 0o077:
        raise AccessError(
            "others on this machine can read or write it", source=path, remedy=f"chmod 600 {path}"
        )
    try:
        _parsed(kept)
    except AccessError as error:
        raise AccessError(error.message, source=path, remedy=error.remedy) from None
    return kept


@dataclass
class Attempts:
    """Slows down guessing: each wrong password doubles the wait, for each session or address.

    One for the whole server; any number of threads may use it.

    Parameters
    ----------
    free : int
        Wrong passwords that cost no wait.
    first_s, longest_s : float
        The first wait, and the longest.
    most : int
        Clients that are remembered; beyond, those heard of longest ago are forgotten.
    clock : callable
        Gives seconds that never go back.

    Examples
    --------
    >>> seconds = iter((0.0, 0.0, 0.5))
    >>> attempts = Attempts(free=0, clock=lambda: next(seconds))
    >>> attempts.wait_s("tablet"), attempts.failed("tablet"), attempts.wait_s("tablet")
    (0.0, 1.0, 0.5)
    """

    free: int = 3
    first_s: float = 1.0
    longest_s: float = 900.0
    most: int = 10_000
    clock: Callable[[], float] = time.monotonic
    _failures: dict[str, tuple[int, float]] = field(default_factory=dict, init=False, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False, repr=False)

    # One at a time: each takes 128 MB.
    _verifying: threading.Lock = field(default_factory=threading.Lock, init=False, repr=False)

    def wait_s(self, client: str) -> float:
        """Give the seconds that a client must wait before it may try; 0 if it may now."""
        with self._lock:
            return self._wait_s(client)

    def failed(self, client: str) -> float:
        """Note a wrong password; give the seconds that the client must wait now."""
        with self._lock:
            return self._note(client)

    def succeeded(self, client: str) -> None:
        """Forget a client's wrong passwords."""
        with self._lock:
            self._failures.pop(client, None)

    def check(self, client: str, password: str, kept: str) -> bool:
        """Verify a password, unless the client must wait.

        Raises
        ------
        AccessError
            If it must wait: the password is then not looked at.
        """
        with self._lock:
            wait_s = self._wait_s(client)
            if wait_s == 0:
                # Counted before it is verified, so that many at once gain nothing.
                self._note(client)
        if wait_s > 0:
            raise AccessError(
                "too many wrong passwords", remedy=f"wait {wait_s:.0f} s and try again"
            )
        with self._verifying:
            right = verify_password(password, kept)
        if right:
            self.succeeded(client)
        return right

    def _wait_s(self, client: str) -> float:
        count, at_s = self._failures.get(client, (0, 0.0))
        return max(0.0, at_s + self._delay_s(count) - self.clock())

    def _note(self, client: str) -> float:
        count = self._failures.pop(client, (0, 0.0))[0] + 1
        self._failures[client] = (count, self.clock())
        while len(self._failures) > self.most:
            self._failures.pop(next(iter(self._failures)))
        return self._delay_s(count)

    def _delay_s(self, count: int) -> float:
        if count <= self.free:
            return 0.0
        doublings = min(count - self.free - 1, 60)
        return float(min(self.longest_s, self.first_s * 2.0**doublings))


def secrets_files() -> tuple[Path, ...]:
    """Give the files that Streamlit's login is set up in."""
    return (
        Path.home() / ".streamlit" / "secrets.toml",
        Path.cwd() / ".streamlit" / "secrets.toml",
    )


def login_of(address: str) -> Login:
    """Decide how people log in to a server at this address; by its variable always.

    Raises
    ------
    AccessError
        If others could reach it and there is no login.
    """
    kept = read_password_hash(password_file())
    return decide_login(
        address,
        oidc=has_oidc(secrets_files()),
        password=kept is not None,
        always=bool(os.environ.get(LOGIN_VARIABLE)),
    )


@st.cache_resource(show_spinner=False)
def _attempts() -> Attempts:
    return Attempts()


def require_login(address: str) -> None:
    """Draw the login and end the script, unless the viewer is in or needs none.

    Parameters
    ----------
    address : str
        What the server listens on.

    Raises
    ------
    AccessError
        If others could reach it and there is no login.
    """
    login = login_of(address)
    if login is Login.NONE or st.session_state.get("inside"):
        return
    if login is Login.OIDC:
        if st.user.is_logged_in:
            return
        st.button("Log in", type="primary", on_click=st.login)
        st.stop()
    with st.form("login"):
        password = st.text_input("Password", type="password")
        if st.form_submit_button("Log in", type="primary") and _right(password):
            st.session_state["inside"] = True
            st.rerun()
    st.stop()


def _right(password: str) -> bool:
    client = st.context.ip_address or "unknown"
    kept = read_password_hash(password_file()) or ""
    try:
        right = _attempts().check(client, password, kept)
    except AccessError as error:
        st.error(str(error))
        return False
    if not right:
        st.error("That is not the password.")
    return right
