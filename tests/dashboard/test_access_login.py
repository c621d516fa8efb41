"""The login of a real server, in a real browser: with accounts, and with an OpenID provider."""

from __future__ import annotations

import json
import re
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlencode, urlparse

import pytest

pytest.importorskip("streamlit")
pytest.importorskip("playwright")

from joserfc import jwt
from joserfc.jwk import RSAKey

from cucumbervision.dashboard.access import set_password

WORDS = "a row of cucumbers"
UUID = re.compile(rb"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")

# One server and one browser, and no limit that a busy machine could reach.
pytestmark = [pytest.mark.timeout(1800), pytest.mark.xdist_group("browser")]

NewPage = Callable[[], Any]
StartServer = Callable[..., str]


@pytest.fixture(scope="module")
def accounts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("login") / "accounts"
    for account in ("anna", "ben"):
        set_password(path, account, WORDS)
    return path


@pytest.fixture(scope="module")
def address(accounts: Path, start_server: StartServer) -> str:
    """A server that requires a password."""
    folder = accounts.parent
    variables = {"CUCUMBERVISION_ACCOUNTS_FILE": str(accounts), "HOME": str(folder)}
    return start_server(folder, "--login", "--store", str(folder / "house.db"), **variables)


def log_in(page: Any, account: str, password: str) -> None:
    page.get_by_label("Account").fill(account)
    page.get_by_label("Password", exact=True).fill(password)
    page.get_by_test_id("stFormSubmitButton").get_by_role("button").click()


def links(page: Any) -> Any:
    """The links to the pages, which only who is logged in sees."""
    return page.get_by_test_id("stTopNavLink")


def test_nothing_is_shown_without_the_password_and_all_with_it(
    address: str, new_page: NewPage
) -> None:
    page = new_page()
    for path in ("", "/capture", "/settings"):
        page.goto(address + path)
        page.get_by_label("Password", exact=True).wait_for()
        assert links(page).count() == 0
    log_in(page, "anna", "wrong password")
    page.get_by_text("Account or password is wrong.").wait_for()
    assert links(page).count() == 0
    log_in(page, "anna", WORDS)
    links(page).first.wait_for()
    page.get_by_role("button", name="Log out").click()
    page.get_by_label("Password", exact=True).wait_for()
    links(page).first.wait_for(state="hidden")
    # Another viewer of the same server is not logged in by the first.
    log_in(page, "anna", WORDS)
    links(page).first.wait_for()
    other = new_page()
    other.goto(address)
    other.get_by_label("Password", exact=True).wait_for()
    assert links(other).count() == 0


def test_an_account_waits_after_wrong_passwords(address: str, new_page: NewPage) -> None:
    page = new_page()
    page.goto(address)
    waits = page.get_by_text("too many wrong passwords")
    for number in range(40):
        log_in(page, "ben", f"wrong {number}")
        page.wait_for_timeout(500)
        if waits.count():
            break
    waits.wait_for()
    assert links(page).count() == 0


def test_only_who_is_inside_may_upload(address: str, new_page: NewPage) -> None:
    page, sessions = new_page(), set[str]()

    def note(frame: Any) -> None:
        if isinstance(frame, bytes):
            sessions.update(m.group().decode() for m in UUID.finditer(frame))

    page.on("websocket", lambda socket: socket.on("framereceived", note))
    page.goto(address)
    page.get_by_label("Password", exact=True).wait_for()
    assert sessions  # the page's own, which Streamlit tells it before any login

    def statuses() -> set[int]:
        form = {"file": {"name": "a.png", "mimeType": "image/png", "buffer": b"x"}}
        places = (f"{address}/_stcore/upload_file/{one}/1" for one in (*sessions, "invented"))
        return {page.request.put(place, multipart=form).status for place in places}

    assert statuses() == {403}
    log_in(page, "anna", WORDS)
    links(page).first.wait_for()
    links(page).filter(has_text="Upload").click()
    with page.expect_response(lambda answer: "upload_file" in answer.url) as sent:
        page.locator("input[type=file]").first.set_input_files(
            {"name": "a.png", "mimeType": "image/png", "buffer": b"x"}
        )
    assert sent.value.status < 300


def test_an_open_page_closes_when_its_account_is_removed(
    address: str, accounts: Path, new_page: NewPage
) -> None:
    set_password(accounts, "carla", WORDS)
    page = new_page()
    page.goto(address)
    page.get_by_label("Password", exact=True).wait_for()
    log_in(page, "carla", WORDS)
    links(page).first.wait_for()
    kept = [line for line in accounts.read_text().splitlines() if not line.startswith("carla:")]
    accounts.write_text("\n".join(kept) + "\n")
    # Nobody touches the page: it asks by itself.
    page.get_by_label("Password", exact=True).wait_for()
    links(page).first.wait_for(state="hidden")


class Provider(BaseHTTPRequestHandler):
    """An OpenID Connect provider that asks nothing: its accounts stand in `claims`."""

    claims: dict[str, Any]
    key = RSAKey.generate_key(2048, {"kid": "1", "use": "sig", "alg": "RS256"})
    nonce = ""

    def do_GET(self) -> None:
        asked = {name: values[0] for name, values in parse_qs(urlparse(self.path).query).items()}
        here = f"http://{self.headers['Host']}"
        if self.path.startswith("/authorize"):
            type(self).nonce = asked.get("nonce", "")
            back = urlencode({"code": "1", "state": asked["state"]})
            self.send_response(302)
            self.send_header("Location", f"{asked['redirect_uri']}?{back}")
            self.end_headers()
        elif self.path.startswith("/keys"):
            self.answer({"keys": [self.key.as_dict(private=False)]})
        else:
            names = ("authorization_endpoint", "token_endpoint", "jwks_uri")
            places = (f"{here}/{name}" for name in ("authorize", "token", "keys"))
            self.answer({"issuer": here, **dict(zip(names, places, strict=True))})

    def do_POST(self) -> None:
        now = int(time.time())
        token = {
            **{"iss": f"http://{self.headers['Host']}", "aud": "dashboard", "nonce": self.nonce},
            **{"iat": now, "exp": now + 3600, **self.claims},
        }
        signed = jwt.encode({"alg": "RS256", "kid": "1"}, token, self.key)
        self.answer({"access_token": "1", "token_type": "Bearer", "id_token": signed})

    def answer(self, document: dict[str, Any]) -> None:
        data = json.dumps(document).encode()
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""


@pytest.fixture
def provider() -> Iterator[str]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), Provider)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


def test_a_provider_lets_in_only_who_is_on_the_list(
    provider: str, start_server: StartServer, new_page: NewPage, tmp_path: Path
) -> None:
    settings = {
        "redirect_uri": "http://127.0.0.1:{port}/oauth2callback",
        "cookie_secret": "a secret of this test only, long enough",
        "client_id": "dashboard",
        "client_secret": "b",
        "server_metadata_url": f"{provider}/.well-known/openid-configuration",
    }
    (tmp_path / ".streamlit").mkdir()
    lines = ["[auth]", *(f"{key} = {json.dumps(value)}" for key, value in settings.items())]
    lines += ["[cucumbervision]", 'admitted = ["anna@example.org"]']
    (tmp_path / ".streamlit" / "secrets.toml").write_text("\n".join(lines) + "\n")
    store = ("--login", "--store", str(tmp_path / "house.db"))
    address = start_server(tmp_path, *store, HOME=str(tmp_path))
    eve = {"sub": "666", "email": "eve@example.org", "email_verified": True}
    false_anna = {"sub": "667", "email": "anna@example.org", "email_verified": False}
    for claims in (eve, false_anna):
        Provider.claims = claims
        page = new_page()
        page.goto(address)
        page.get_by_role("button", name="Log in").click()
        page.get_by_text(f"The login as {claims['email']} is not admitted").wait_for()
        assert links(page).count() == 0
    Provider.claims = {"sub": "1", "email": "Anna@example.org", "email_verified": True}
    page = new_page()
    page.goto(address)
    page.get_by_role("button", name="Log in").click()
    links(page).first.wait_for()
    page.get_by_role("button", name="Log out").click()
    page.get_by_role("button", name="Log in").wait_for()
