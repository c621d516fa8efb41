"""The dashboard as Streamlit serves it: its pages behind the guard of uploads."""

from __future__ import annotations

from pathlib import Path

import streamlit as st
from starlette.middleware import Middleware

from cucumbervision.dashboard.uploaders import UploadGuard

app = st.App(Path(__file__).with_name("app.py"), middleware=[Middleware(UploadGuard)])
