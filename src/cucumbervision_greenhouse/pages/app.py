"""The script that Streamlit runs for every viewer: navigation, and the frame of a page."""

from __future__ import annotations

import json
import os
from html import escape
from pathlib import Path
from urllib.parse import urlencode

import streamlit as st

from cucumbervision._version import __version__
from cucumbervision.about import LICENCE, installed_versions, source_offer
from cucumbervision.errors import AccessError, CucumberVisionError
from cucumbervision_greenhouse import resources, tasks
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.language import language, marked, plain
from cucumbervision_greenhouse.pages import (
    accuracy,
    days,
    forecast,
    page_elements,
    results,
    row_map,
    settings,
    today,
    upload,
)
from cucumbervision_greenhouse.settings import LOGIN_VARIABLE
from cucumbervision_greenhouse.theme import THEME_STYLE

_IN_BAR = 4  # pages of the bar at the bottom of a phone; 'More' has the others
_WITH_FRUIT = ("", "results")  # keyboard focus goes to their lists at once

_ICON = Path(__file__).parents[1] / "camera/static/icon.svg"
_HEAD = """<script>document.documentElement.lang = "{language}"</script>
<div class="head"><h1 class="quiet">{title}</h1><a class="brand" href="{home}"
target="_self">CucumberVision</a><span class="house">{house}</span></div>"""


def main() -> None:
    """Draw the page that the viewer chose."""
    st.set_page_config(page_title="CucumberVision", page_icon=_ICON, layout="wide")
    for style in (THEME_STYLE, Path(__file__).with_name("static") / "pages.css"):
        st.html(style)
    try:
        _check_guard()
        pages = _pages()
        st.session_state["pages"] = {page.url_path or "today": page for page in pages}
        chosen = st.navigation(pages, position="hidden")
        tasks.prepare()
        read_address()
        _draw_navigation(pages, chosen)
        page_elements.live()
        chosen.run()
        if chosen != pages[-1]:
            footer(pages[-1])
    except CucumberVisionError as error:
        st.error(plain(error), icon=":material/error:")


def _pages() -> list[st.Page]:
    draw = [
        (marked("Today"), today.page, ":material/today:"),
        (marked("Capture"), _leave_for_capture, ":material/photo_camera:"),
        (marked("Results"), results.page, ":material/straighten:"),
        (marked("Row map"), row_map.page, ":material/map:"),
        (marked("Upload"), upload.page, ":material/upload:"),
        (marked("Days"), days.page, ":material/date_range:"),
        (marked("Forecast"), forecast.page, ":material/calendar_month:"),
        (marked("Accuracy"), accuracy.page, ":material/target:"),
        (marked("Settings"), settings.page, ":material/settings:"),
        (marked("About"), about, ":material/info:"),
    ]
    return [
        st.Page(
            page,
            title=_(title),
            icon=icon,
            url_path=title.split()[-1].lower(),
            default=page is today.page,
        )
        for title, page, icon in draw
    ]


def _leave_for_capture() -> None:
    """Open the capture page, which is not a Streamlit page."""
    address = json.dumps(f"/capture?{urlencode(page_elements.here())}")
    st.html(f"<script>location.replace({address})</script>", unsafe_allow_javascript=True)


def _draw_navigation(pages: list[st.Page], chosen: st.Page) -> None:
    if chosen.url_path in _WITH_FRUIT and "fruit" not in st.query_params:
        st.html(f'<a class="skip" href="#list">{_("To the fruit")}</a>')
    st.set_page_config(page_title=f"{chosen.title} · CucumberVision")
    with st.container(key="head", horizontal=True):
        st.html(_head(chosen.title), width="content", unsafe_allow_javascript=True)
        with st.container(horizontal=True, key="nav", gap="small"):
            _links(pages[:-1])
            # On a phone, where the links are a bar at the bottom; a new one is closed.
            with st.popover(_("More"), key=f"more_{chosen.url_path}"):
                _links(pages[_IN_BAR:])


def _links(pages: list[st.Page]) -> None:
    for page in pages:
        st.page_link(page, label=page.title, query_params=page_elements.here())


def _head(title: str) -> str:
    """Return the top of a page: the program and the house that is open."""
    walk = resources.store().round(page_elements.opened_round())
    parts = {
        "language": language(),
        "home": escape(f"/?{urlencode(page_elements.here())}"),
        "house": escape(walk.house if walk else ""),
        "title": escape(title),
    }
    return _HEAD.format(**parts)


def read_address() -> None:
    """Open the round in the address, and keep the open round in the address."""
    named = st.query_params.get("round")
    if named == st.session_state.get("named"):
        st.session_state.pop("named_before", None)
    elif named and named != st.session_state.get("named_before"):
        st.session_state["round"] = st.session_state["named"] = named


def footer(about_page: st.Page) -> None:
    """Draw the link to the licence and the source (AGPL-3.0, section 13)."""
    with st.container(key="about", horizontal_alignment="right"):
        st.page_link(
            about_page, label=_("About"), query_params=page_elements.here(), width="content"
        )


def _check_guard() -> None:
    """Refuse to draw pages if no guard checks their requests."""
    if LOGIN_VARIABLE not in os.environ:
        raise AccessError(
            "the pages run without their guard", remedy="start them with `cucumbervision dashboard`"
        )


def about() -> None:
    """Draw the page 'About': the offer of the source that the AGPL-3.0, section 13, asks for."""
    offer = source_offer()
    st.header(_("About"))
    words = _(
        "CucumberVision {version} measures greenhouse cucumbers. Its licence is {licence}: "
        "everyone who uses it over a network may have its source."
    )
    st.write(words.format(version=__version__, licence=LICENCE))
    if offer.startswith("http"):
        st.link_button(_("Source code"), offer, icon=":material/code:")
    else:
        st.write(_("Source code: {offer}").format(offer=plain(offer)))
    with st.expander(_("Details"), icon=":material/list:"):
        lines = [
            {_("Package"): name, _("Version"): version}
            for name, version in installed_versions().items()
        ]
        page_elements.table(lines)


if __name__ == "__main__":
    main()
