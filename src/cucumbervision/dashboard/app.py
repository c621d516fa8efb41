"""The script that Streamlit runs for every viewer: login, navigation and what frames a page."""

from __future__ import annotations

from typing import TYPE_CHECKING

import streamlit as st
from streamlit.runtime.scriptrunner import get_script_run_ctx

from cucumbervision._version import __version__
from cucumbervision.about import LICENCE, source_offer
from cucumbervision.dashboard import page_elements, resources
from cucumbervision.dashboard.access import (
    Login,
    PasswordChecker,
    Session,
    accounts_file,
    configured_login,
    read_accounts,
    read_openid_connect,
)
from cucumbervision.dashboard.plain_text import plain
from cucumbervision.dashboard.uploaders import note_viewer
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
from cucumbervision.errors import CucumberVisionError

if TYPE_CHECKING:
    from collections.abc import Callable

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
        login = configured_login(st.get_option("server.address") or "")
        inside = _is_inside(login)
        # Without a login too, so that each page's address leads to the form.
        pages = _pages()
        st.session_state["pages"] = {page.url_path or "today": page for page in pages}
        chosen = st.navigation(pages, position="top" if inside else "hidden")
        if inside:
            _draw_log_out(login)
            keep_inputs()
            page_elements.progress(resources.prepare())
            chosen.run()
        else:
            _draw_login(login)
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


def _is_inside(login: Login) -> bool:
    """Return whether the viewer may see the pages; uploads are let in by the same answer."""
    holds = _who(login)
    inside = holds()
    context = get_script_run_ctx()
    if context is not None:
        note_viewer(context.session_id, holds if inside else None)
    return inside


def _who(login: Login) -> Callable[[], bool]:
    """Return what says whether the viewer is inside, at any later time and in any thread."""
    if login is Login.PASSWORD:
        session: Session | None = st.session_state.get("session")
        return lambda: session is not None and session.holds(read_accounts(accounts_file()))
    if login is Login.OIDC:
        logged_in, claims = bool(st.user.is_logged_in), st.user.to_dict()

        def admitted() -> bool:
            oidc = read_openid_connect()
            return logged_in and oidc is not None and oidc.admits(claims)

        return admitted
    return lambda: True


def _draw_login(login: Login) -> None:
    oidc = read_openid_connect()
    if login is Login.PASSWORD or oidc is None:
        _draw_password_form()
    elif st.user.is_logged_in:
        name = plain(st.user.get("email") or st.user.get("sub"))
        st.error(
            f"The login as {name} is not admitted, or older than 12 hours.",
            icon=":material/lock:",
        )
        st.button("Log out", icon=":material/logout:", on_click=st.logout)
    else:
        for name in oidc.providers or ("",):
            st.button(
                f"Log in with {name}" if name else "Log in",
                type="primary",
                on_click=st.login,
                args=(name,) if name else (),
            )


@st.cache_resource(show_spinner=False)
def _checker() -> PasswordChecker:
    return PasswordChecker()


def _draw_password_form() -> None:
    with st.form("login"):
        account = st.text_input("Account", autocomplete="username")
        password = st.text_input("Password", type="password", autocomplete="current-password")
        if not st.form_submit_button("Log in", type="primary"):
            return
        session = _checker().log_in(read_accounts(accounts_file()), account, password)
        if session is None:
            st.error("Account or password is wrong.", icon=":material/lock:")
        else:
            st.session_state["session"] = session
            st.rerun()


def _draw_log_out(login: Login) -> None:
    if login is Login.NONE:
        return
    leave = st.logout if login is Login.OIDC else st.session_state.clear
    st.button("Log out", icon=":material/logout:", on_click=leave)

    @st.fragment(run_every=_SESSION_CHECK_S)
    def _end_with_session() -> None:
        """Leave a page that stays open, such as the camera's, when the session ends."""
        if not _is_inside(login):
            st.rerun()

    _end_with_session()


if __name__ == "__main__":
    main()
