"""The dashboard as Streamlit serves it: its pages behind the guard."""

from __future__ import annotations

import os
from pathlib import Path

import streamlit as st
from starlette.middleware import Middleware

from cucumbervision.dashboard.access import AccessGuard, Login
from cucumbervision.dashboard.server import LOGIN_VARIABLE
from cucumbervision.service.server import TOKEN_VARIABLE

_GUARD = Middleware(
    AccessGuard,
    login=Login(os.environ[LOGIN_VARIABLE]),
    token=os.environ.get(TOKEN_VARIABLE, ""),
)

app = st.App(Path(__file__).with_name("app.py"), middleware=[_GUARD])
