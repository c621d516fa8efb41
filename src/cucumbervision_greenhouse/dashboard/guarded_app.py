"""The dashboard as Streamlit serves it: its pages behind the guard."""

from __future__ import annotations

import logging
import os
import threading
import time
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
from cucumbervision_greenhouse.capture_page.routes import routes as capture_routes
from cucumbervision_greenhouse.dashboard.callbacks import finish_callbacks
from cucumbervision_greenhouse.dashboard.routes import routes
from cucumbervision_greenhouse.dashboard.server import LOGIN_VARIABLE

# Without `server.serve`, which decides on the login, nobody is admitted.
_GUARD = Middleware(
    AccessGuard,
    login=Login(os.environ.get(LOGIN_VARIABLE, Login.TOKEN)),
    token=os.environ.get(TOKEN_VARIABLE, ""),
)

# Streamlit imports the first within the first page that is drawn, the others within later ones.
_PAGES = "cucumbervision_greenhouse.dashboard.app"
_LATER_USED = ("cucumbervision_greenhouse.dashboard.charts", "pandas")
_FIRST_PAGE_S = 2.0
"""The first viewer comes at once, and networks that load meanwhile would take the processor."""

_READING_AHEAD = "preparing"
# Streamlit warns that a thread without a page cannot show that it is busy.
logging.getLogger("streamlit.runtime.scriptrunner_utils.script_run_context").addFilter(
    lambda record: record.threadName != _READING_AHEAD
)


@asynccontextmanager
async def _prepared(_: st.App) -> AsyncGenerator[dict[str, object], None]:
    """Load pages and the newest round before the first viewer, and then the networks."""

    def prepare() -> None:
        with suppress(CucumberVisionError, ImportError):  # a page shows the reason
            import_module(_PAGES)
            tasks.prepare()
            round_caches.read_ahead()
            time.sleep(_FIRST_PAGE_S)
            tasks.warm_up()
            for name in _LATER_USED:
                import_module(name)

    threading.Thread(target=prepare, name=_READING_AHEAD, daemon=True).start()
    yield {}


finish_callbacks()
app = st.App(
    Path(__file__).with_name("app.py"),
    middleware=[_GUARD],
    routes=[*routes(), *capture_routes()],
    lifespan=_prepared,
)
