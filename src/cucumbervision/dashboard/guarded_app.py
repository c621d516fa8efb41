"""The dashboard as Streamlit serves it: its pages behind the guard."""

from __future__ import annotations

import os
from pathlib import Path

import streamlit as st
from starlette.middleware import Middleware

from cucumbervision.dashboard.access import AccessGuard, Login
from cucumbervision.dashboard.server import LOGIN_VARIABLE
from cucumbervision.service.server import TOKEN_VARIABLE

# Without `server.serve`, which decides on the login, nobody is admitted.
_GUARD = Middleware(
    AccessGuard,
    login=Login(os.environ.get(LOGIN_VARIABLE, Login.TOKEN)),
    token=os.environ.get(TOKEN_VARIABLE, ""),
)

app = st.App(Path(__file__).with_name("app.py"), middleware=[_GUARD])
