"""The script that Streamlit runs for every viewer: login, navigation and what frames a page."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlencode

import streamlit as st
from streamlit.runtime.scriptrunner import get_script_run_ctx

from cucumbervision.errors import AccessError, CucumberVisionError
from cucumbervision_greenhouse.backend import resources
from cucumbervision_greenhouse.backend.access import Login, note_viewer, read_openid_connect
from cucumbervision_greenhouse.backend.words import plain
from cucumbervision_greenhouse.dashboard import page_elements
from cucumbervision_greenhouse.dashboard.server import LOGIN_VARIABLE
from cucumbervision_greenhouse.dashboard.views import (
    about,
    accuracy,
    forecast,
    results,
    row_map,
    settings,
    today,
    upload,
)

if TYPE_CHECKING:
    from streamlit.navigation.page import StreamlitPage

# Streamlit forgets the input of a page that is left; these are kept for its return.
_KEPT_INPUTS = ("round", "color_by", "list_page", "pick_row")
_SESSION_CHECK_S = 10.0
_WITH_FRUIT = ("Today", "Results")  # a keyboard comes to their lists at once

_STYLE = Path(__file__).with_name("static") / "pages.css"


def main() -> None:
    """Draw the page that the viewer chose, or the login."""
    st.set_page_config(page_title="CucumberVision", page_icon="🥒", layout="wide")
    st.html(_STYLE)
    try:
        login = _login()
        admitted = _is_admitted(login)
        # Without a login too, so that each page's address leads to the form.
        pages = _pages()
        st.session_state["pages"] = {page.url_path or "today": page for page in pages}
        chosen = st.navigation(pages, position="hidden")
        if admitted:
            resources.prepare()
            page_elements.keep_address()
            read_address()
            _draw_navigation(pages, chosen)
            _draw_log_out(login)
            keep_inputs()
            context = get_script_run_ctx()
            ticket = context.session_id if context and login is Login.OIDC else ""
            page_elements.live(ticket)
            chosen.run()
            page_elements.note_address()
            if chosen != pages[-1]:
                footer(pages[-1])
        else:
            _draw_login()
    except CucumberVisionError as error:
        st.error(plain(error), icon=":material/error:")


def _pages() -> list[StreamlitPage]:
    draw = [
        ("Today", today.page, ":material/today:"),
        ("Capture", _leave_for_capture, ":material/photo_camera:"),
        ("Upload", upload.page, ":material/upload:"),
        ("Results", results.page, ":material/straighten:"),
        ("Row map", row_map.page, ":material/map:"),
        ("Forecast", forecast.page, ":material/calendar_month:"),
        ("Accuracy", accuracy.page, ":material/target:"),
        ("Settings", settings.page, ":material/settings:"),
        ("About", about.page, ":material/info:"),
    ]
    return [
        st.Page(
            page,
            title=title,
            icon=icon,
            url_path=title.split()[-1].lower(),
            default=page is today.page,
        )
        for title, page, icon in draw
    ]


def _leave_for_capture() -> None:
    """Open the capture page, which is none of Streamlit's."""
    page_elements.go(f"/capture?{urlencode(page_elements.here())}")


def _draw_navigation(pages: list[StreamlitPage], chosen: StreamlitPage) -> None:
    if chosen.title in _WITH_FRUIT:
        st.html('<a class="skip" href="#list">To the fruit</a>')
    with st.container(horizontal=True, key="nav", gap="small"):
        for one in pages[:-1]:
            st.page_link(one, label=one.title, query_params=page_elements.here())


def read_address() -> None:
    """Open the round that the address names; the address names the one that is open."""
    named = st.query_params.get("round")
    if named == st.session_state.get("named"):
        st.session_state.pop("named_before", None)
    elif named and named != st.session_state.get("named_before"):
        st.session_state["round"] = st.session_state["named"] = named


def keep_inputs() -> None:
    """Keep the input of pages that are not shown."""
    for name in list(st.session_state):
        if name in _KEPT_INPUTS or str(name).startswith("up_"):
            st.session_state[name] = st.session_state[name]


def footer(about_page: StreamlitPage) -> None:
    """Draw the quiet way to the licence and the source (AGPL-3.0, section 13)."""
    with st.container(key="about", horizontal_alignment="right"):
        st.page_link(about_page, label="About", query_params=page_elements.here(), width="content")


def _login() -> Login:
    """Return how viewers log in; `server.serve` has decided, and the guard enforces a token."""
    try:
        return Login(os.environ[LOGIN_VARIABLE])
    except KeyError:
        raise AccessError(
            "the pages run without their guard", remedy="start them with `cucumbervision dashboard`"
        ) from None


def _is_admitted(login: Login) -> bool:
    """Return whether the viewer may see the pages; uploads are admitted by the same answer."""
    if login is not Login.OIDC:
        return True
    logged_in, claims = bool(st.user.is_logged_in), st.user.to_dict()

    def is_admitted() -> bool:  # at any later time and in any thread
        oidc = read_openid_connect()
        return logged_in and oidc is not None and oidc.admits(claims)

    admitted = is_admitted()
    context = get_script_run_ctx()
    if context is not None:
        name = str(claims.get("email") or claims.get("sub") or "")
        note_viewer(context.session_id, is_admitted if admitted else None, name)
    return admitted


def _draw_login() -> None:
    oidc = read_openid_connect()
    if st.user.is_logged_in:
        name = plain(st.user.get("email") or st.user.get("sub"))
        st.error(
            f"The login as {name} is not admitted, or older than 12 hours.",
            icon=":material/lock:",
        )
        st.button("Log out", icon=":material/logout:", on_click=st.logout)
        return
    for name in (oidc and oidc.providers) or ("",):
        st.button(
            f"Log in with {name}" if name else "Log in",
            type="primary",
            on_click=st.login,
            args=(name,) if name else (),
        )


def _draw_log_out(login: Login) -> None:
    if login is not Login.OIDC:
        return
    st.button("Log out", icon=":material/logout:", on_click=st.logout)

    @st.fragment(run_every=_SESSION_CHECK_S)
    def _end_with_session() -> None:
        """Leave a page that stays open, such as the camera's, when the session ends."""
        if not _is_admitted(login):
            st.rerun()

    _end_with_session()


if __name__ == "__main__":
    main()
