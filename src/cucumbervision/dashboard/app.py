"""The script that Streamlit runs for every viewer: login, navigation and what frames a page."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import streamlit as st
from streamlit.runtime.scriptrunner import get_script_run_ctx

from cucumbervision._version import __version__
from cucumbervision.about import LICENCE, source_offer
from cucumbervision.dashboard import page_elements, resources
from cucumbervision.dashboard.access import Login, note_viewer, read_openid_connect
from cucumbervision.dashboard.server import LOGIN_VARIABLE
from cucumbervision.dashboard.views import (
    accuracy,
    capture,
    forecast,
    results,
    row_map,
    settings,
    today,
    upload,
)
from cucumbervision.dashboard.words import plain
from cucumbervision.errors import AccessError, CucumberVisionError

if TYPE_CHECKING:
    from streamlit.navigation.page import StreamlitPage

# Streamlit forgets the input of a page that is left; these are kept for its return.
_KEPT_INPUTS = (
    "round",
    *("source", "fruit", "color_by", "list_page", "pick_row"),
)
_SESSION_CHECK_S = 10.0

_STYLE = """<style>
.stButton button, .stDownloadButton button, .stLinkButton a, [data-testid="stPopoverButton"] {
  min-height: 3rem; }
.st-key-live [data-testid="stHorizontalBlock"] { flex-wrap: nowrap; gap: 6px; }
.st-key-live [data-testid="stColumn"] { min-width: 0; flex: 1 1 0; }
.stNumberInput input, .stTextInput input, [data-baseweb="select"] > div { min-height: 2.75rem; }
[data-testid="stButtonGroup"] button { min-height: 2.75rem; }
.stNumberInput button { min-width: 2.75rem; }
.st-key-point_cloud [data-testid="stDeckGlJsonChart"] { background: #14181d; border-radius: 8px; }
.block-container { padding-top: 4.2rem; padding-bottom: 2rem; }
@media (max-width: 640px) {
  .st-key-rounds [data-testid="stHorizontalBlock"] { gap: 8px; }
  .st-key-rounds [data-testid="stColumn"] { min-width: 0; flex: 1 1 0; }
  .st-key-rounds [data-testid="stColumn"]:first-child { min-width: 100%; } }
@media (max-width: 1000px) {
  .st-key-halves > div > [data-testid="stHorizontalBlock"] { flex-wrap: wrap; }
  .st-key-halves > div > [data-testid="stHorizontalBlock"] > [data-testid="stColumn"] {
    min-width: 100%; } }
@media print {
  header, .stButton, .st-key-noprint, [data-testid="stToolbar"] { display: none !important; }
  .block-container { padding: 0 !important; } }
</style>"""


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
        chosen = st.navigation(pages, position="top" if admitted else "hidden")
        if admitted:
            _draw_log_out(login)
            keep_inputs()
            page_elements.progress(resources.prepare())
            chosen.run()
        else:
            _draw_login()
    except CucumberVisionError as error:
        st.error(plain(error), icon=":material/error:")
    footer()


def _pages() -> list[StreamlitPage]:
    modules = [
        ("Today", today, ":material/today:"),
        ("Capture", capture, ":material/photo_camera:"),
        ("Upload", upload, ":material/upload:"),
        ("Results", results, ":material/straighten:"),
        ("Row map", row_map, ":material/map:"),
        ("Forecast", forecast, ":material/calendar_month:"),
        ("Accuracy", accuracy, ":material/target:"),
        ("Settings", settings, ":material/settings:"),
    ]
    return [
        st.Page(
            module.page,
            title=title,
            icon=icon,
            url_path=title.split()[-1].lower(),
            default=module is today,
        )
        for title, module, icon in modules
    ]


def keep_inputs() -> None:
    """Keep the input of pages that are not shown."""
    for name in _KEPT_INPUTS:
        if name in st.session_state:
            st.session_state[name] = st.session_state[name]


def footer() -> None:
    """Name the program, its licence and where its source is (AGPL-3.0, section 13)."""
    offer = source_offer()
    where = f"[source code]({offer})" if offer.startswith("http") else f"source code: {offer}"
    st.divider()
    st.caption(f"CucumberVision {__version__} · {LICENCE} · {where}")


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
        note_viewer(context.session_id, is_admitted if admitted else None)
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
