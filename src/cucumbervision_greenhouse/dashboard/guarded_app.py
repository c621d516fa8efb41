"""The dashboard as an ASGI application: Streamlit's pages and our routes behind the guard."""

from __future__ import annotations

import os
import threading
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager, suppress
from importlib import import_module
from pathlib import Path

import streamlit as st
from starlette.middleware import Middleware

from cucumbervision.access import TOKEN_VARIABLE
from cucumbervision.errors import CucumberVisionError
from cucumbervision_greenhouse.backend import round_caches, tasks
from cucumbervision_greenhouse.backend.access import AccessGuard, Login
from cucumbervision_greenhouse.backend.core_words import words_of
from cucumbervision_greenhouse.backend.plain_text import sentence
from cucumbervision_greenhouse.capture_page.routes import routes as capture_routes
from cucumbervision_greenhouse.dashboard.routes import routes


def guarded_app(login: Login) -> st.App:
    """Return the application; its other options come from `.streamlit/config.toml`."""
    token = os.environ.get(TOKEN_VARIABLE, "")
    return st.App(
        Path(__file__).with_name("app.py"),
        middleware=[Middleware(AccessGuard, login=login, token=token)],
        routes=[*routes(), *capture_routes()],
        lifespan=_prepared,
        on_script_error=_say,
    )


@asynccontextmanager
async def _prepared(_: st.App) -> AsyncGenerator[dict[str, object], None]:
    """Load pages and the newest round before the first viewer, and then the networks."""

    def prepare() -> None:
        with suppress(CucumberVisionError, ImportError):  # a page shows the reason
            import_module("cucumbervision_greenhouse.dashboard.app")
            tasks.prepare()
            round_caches.read_ahead()
            tasks.warm_up()

    threading.Thread(target=prepare, name="preparing", daemon=True).start()
    yield {}


def _say(error: Exception) -> bool:
    """Show a named error of a callback, such as a full disk, beside the page."""
    if isinstance(error, CucumberVisionError):
        st.toast(sentence(words_of(error)), icon=":material/error:", duration="long")
    return isinstance(error, CucumberVisionError)
