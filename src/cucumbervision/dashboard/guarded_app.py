"""The dashboard as Streamlit serves it: its pages behind the guard."""

from __future__ import annotations

import os
import threading
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import streamlit as st
from starlette.middleware import Middleware

from cucumbervision.dashboard import resources
from cucumbervision.dashboard.access import AccessGuard, Login
from cucumbervision.dashboard.callbacks import finish_callbacks
from cucumbervision.dashboard.routes import routes
from cucumbervision.dashboard.server import LOGIN_VARIABLE
from cucumbervision.errors import CucumberVisionError
from cucumbervision.service.server import TOKEN_VARIABLE

# Without `server.serve`, which decides on the login, nobody is admitted.
_GUARD = Middleware(
    AccessGuard,
    login=Login(os.environ.get(LOGIN_VARIABLE, Login.TOKEN)),
    token=os.environ.get(TOKEN_VARIABLE, ""),
)


@asynccontextmanager
async def _prepared(_: st.App) -> AsyncGenerator[dict[str, object], None]:
    """Load the networks and go on with what waits, before anybody opens a page."""

    def prepare() -> None:
        with suppress(CucumberVisionError):  # every page says why
            resources.prepare()

    threading.Thread(target=prepare, name="preparing", daemon=True).start()
    yield {}


finish_callbacks()
app = st.App(
    Path(__file__).with_name("app.py"), middleware=[_GUARD], routes=routes(), lifespan=_prepared
)
