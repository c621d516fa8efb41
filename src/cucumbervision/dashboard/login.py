"""Let nobody in from elsewhere who has not logged in."""

from __future__ import annotations

import os
from pathlib import Path

import streamlit as st

from cucumbervision.dashboard.access import (
    Attempts,
    Login,
    decide_login,
    has_oidc,
    password_file,
    read_password_hash,
)
from cucumbervision.dashboard.variables import LOGIN_VARIABLE
from cucumbervision.errors import AccessError

__all__ = ["login_of", "require_login", "secrets_files"]


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
