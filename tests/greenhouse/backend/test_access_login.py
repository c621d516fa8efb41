"""The login of a real server, in a real browser: by the token, and by an OpenID provider."""

from __future__ import annotations

import json
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

TOKEN = "a-token-of-this-test-only"

# One server and one browser, and no limit that a busy machine could reach.
pytestmark = [pytest.mark.timeout(1800), pytest.mark.xdist_group("browser")]

NewPage = Callable[[], Any]
StartServer = Callable[..., str]


def links(page: Any) -> Any:
    """The links to the pages, which only who is logged in sees."""
    return page.locator(".st-key-nav a")


def test_only_the_link_with_the_token_opens_the_pages(
    start_server: StartServer, new_page: NewPage, tmp_path: Path
) -> None:
    variables = {"CUCUMBERVISION_TOKEN": TOKEN, "HOME": str(tmp_path)}
    address = start_server(tmp_path, "--login", "--store", str(tmp_path / "house.db"), **variables)
    page = new_page()
    for path in ("", "/capture", "/_stcore/health", "/?token=wrong"):
        assert page.goto(address + path).status == 403
    form = {"file": {"name": "a.png", "mimeType": "image/png", "buffer": b"x"}}
    upload = f"{address}/_stcore/upload_file/invented/1"
    assert page.request.put(upload, multipart=form).status == 403
    page.goto(f"{address}/settings?token={TOKEN}")
    links(page).first.wait_for()
    assert "token" not in page.url
    # The cookie admits this browser from now on, and no other.
    page.goto(address)
    links(page).first.wait_for()
    assert new_page().goto(address).status == 403


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
        # A mark that nobody sees keeps a browser from making a link of the address.
        name = str(claims["email"]).replace("@", "@\u2060")
        page.get_by_text(f"The login as {name} is not admitted").wait_for()
        assert links(page).count() == 0
    Provider.claims = {"sub": "1", "email": "Anna@example.org", "email_verified": True}
    page = new_page()
    page.goto(address)
    page.get_by_role("button", name="Log in").click()
    links(page).first.wait_for()
    page.get_by_role("button", name="Log out").click()
    page.get_by_role("button", name="Log in").wait_for()
