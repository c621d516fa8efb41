"""Elements that several pages draw: buttons, a job's progress, columns, tables."""

from __future__ import annotations

import time
from collections.abc import Callable, Container, Mapping, Sequence
from functools import lru_cache
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import streamlit as st
from streamlit.delta_generator import DeltaGenerator

from cucumbervision.errors import CucumberVisionError
from cucumbervision.names import readable
from cucumbervision_greenhouse import resources, round_view, tasks
from cucumbervision_greenhouse.fruit_pictures import PICTURE_FILES
from cucumbervision_greenhouse.language import counted, language, page_text, plain, sentence
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.round_view import RoundView
from cucumbervision_greenhouse.rounds.forecasting import Age, age_of
from cucumbervision_greenhouse.row_drawing import draw_rows
from cucumbervision_greenhouse.settings import Units
from cucumbervision_greenhouse.store.records import FruitRow, Round, Verdict
from cucumbervision_greenhouse.words import (
    age_words,
    clock_words,
    hours_words,
    round_day,
    step_words,
    taken_back,
)

_PICTURE_PX = 168  # two abreast on a phone
_NEWS_S = 1.0  # how soon a page shows what another viewer did
_SHORT_S = 5.0  # the time left is not shown for less


def section(label: str, icon: str, key: str, *, opened: bool = False) -> DeltaGenerator | None:
    """Draw a part of a page that is closed at first; return it where it is open.

    What nobody sees would take as long to draw and to send as what is seen.
    """
    icon = f":material/{icon}:"
    part = st.expander(label, expanded=opened, icon=icon, key=key, on_change="rerun")
    return part if part.open else None


def button(
    place: Any, label: str, icon: str, act: Callable[..., object], *args: Any, **options: Any
) -> None:
    """Draw a button as wide as its place; pressing it does `act` before the page is drawn anew."""
    icon = f":material/{icon}:"
    options.setdefault("width", "stretch")
    place.button(label, icon=icon, on_click=do, args=(act, *args), **options)


def do(act: Callable[..., object], *args: Any) -> None:
    """Do what a button asks for, or show why it cannot be done until somebody has read it."""
    try:
        act(*args)
    except CucumberVisionError as error:
        st.toast(sentence(error), icon=":material/error:", duration="infinite")


def judge(round_key: str, key: str, verdict: Verdict | None) -> None:
    """Mark all views of a fruit, as they are grouped now: one would represent it otherwise."""
    views = resources.store().detections(round_key)
    groups = {view.group for view in views if view.key == key}
    resources.store().set_verdict([view.key for view in views if view.group in groups], verdict)


def draw_undo(round_key: str) -> None:
    """Draw a button that undoes the viewer's last action."""

    def undo() -> None:
        action = tasks.undo(resources.store(), round_key)
        st.toast(plain(taken_back(action)), icon=":material/undo:")

    button(st, _("Undo"), "undo", undo, shortcut="Z")


def choose(draw: Callable[..., Any], label: str, names: Mapping[Any, str], **options: Any) -> Any:
    """Draw a choice between the keys of `names`, which are shown, by one of Streamlit's fields."""
    return draw(label, list(names), format_func=names.__getitem__, **options)


def setting(
    name: str,
    draw: Callable[..., Any],
    label: str,
    *args: Any,
    field: str = "",
    shown: Callable[[Any], Any] = lambda saved: saved,
    meant: Callable[[Any], Any] = lambda value: value,
    **options: Any,
) -> None:
    """Draw a field that shows a setting, and changes it when somebody changes the field.

    A page that others have left behind changes nothing else; where another viewer has changed this
    setting since the page was drawn, the page says so.

    Parameters
    ----------
    name : str
        Name in `Settings`.
    draw : callable
        Streamlit's field, with `label`, `args` and `options`.
    field : str
        Name of the field, where a setting has several.
    shown, meant : callable
        From the setting to what the field holds, and back.
    """
    key = f"setting_{name}{field}"

    def choose() -> None:
        if getattr(resources.settings(), name) != st.session_state[f"{key}_drawn"]:
            words = _("Somebody else has changed this meanwhile; what you chose counts now.")
            st.toast(words, icon=":material/info:")
        resources.change_settings(**{name: meant(st.session_state[key])})

    saved = getattr(resources.settings(), name)
    st.session_state[f"{key}_drawn"], st.session_state[key] = saved, shown(saved)
    draw(label, *args, key=key, on_change=choose, **options)


def metrics(figures: Mapping[str, Any], below: Mapping[str, str] | None = None) -> None:
    """Draw figures side by side, each under its name and, where it has some, above words."""
    with st.container(horizontal=True):
        for label, value in figures.items():
            how: dict[str, Any] = {"delta_color": "off", "delta_arrow": "off", "width": "content"}
            st.metric(plain(label), value, (below or {}).get(label) or None, **how)


def step(words: str, page: str, label: str, **parts: str) -> None:
    """Draw words with a link to another page of the round beside them."""
    says, go = st.columns([3, 1], vertical_alignment="center")
    says.markdown(words)
    with go:
        link(page, label, **parts)


def draw_age(round_summary: Round) -> None:
    """Say when a round was walked, and what that means for its figures of today."""
    days, age = age_of(round_summary.walked_s, time.time())
    if days < 0:
        st.warning(clock_words(round_summary.walked_s), icon=":material/error:")
        return
    parts = {"age": age_words(days), "when": round_day(round_summary.walked_s)}
    words = _("**Measured {age}** (last stop {when}).").format(**parts)
    if age is Age.FRESH:
        st.markdown(words)
        return
    meaning = _("The figures of today are right only if nothing was picked since. Walk again.")
    if age is Age.USELESS:
        meaning = _("It is too old for today. Walk the house again for today's list.")
    st.warning(f"{words} {meaning}", icon=":material/history:")


def spanning(low: float, high: float, value: float) -> tuple[float, float, float]:
    """Return limits and value of a field for numbers: a file may hold a value beyond the limits.

    Streamlit would not draw such a field.

    Examples
    --------
    >>> spanning(0.5, 100.0, 150.0)
    (0.5, 150.0, 150.0)
    """
    return min(low, value), max(high, value), value


def table(lines: list[dict[str, Any]]) -> None:
    """Draw a table; its words wrap on a phone, and columns without values are left out.

    Streamlit's own tables need pandas, which takes longer to import than all pages, and in the
    browser what reads Arrow.
    """
    columns = [name for name in (lines[0] if lines else ()) if any(x[name] != "–" for x in lines)]
    if not columns:
        return
    kinds = {name: _kind([str(x[name]) for x in lines]) for name in columns[1:]}
    kinds[columns[0]] = ""  # names of the lines, also where they are numbers
    head = "".join(f'<th scope="col"{kinds[name]}>{_literal(name)}</th>' for name in columns)
    body = "".join(
        f"<tr>{''.join(f'<td{kinds[name]}>{_literal(line[name])}</td>' for name in columns)}</tr>"
        for line in lines
    )
    st.html(f'<table class="figures"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>')


def _kind(cells: list[str]) -> str:
    """Return the class of a column: whole numbers stand under each other."""
    is_number = all(cell.lstrip("+−").isdecimal() for cell in cells if cell) and any(cells)
    return ' class="number"' if is_number else ""


def _literal(text: object) -> str:
    return escape(readable(" ".join(str(text).split())))


def fruit_list(
    key: str,
    label: str,
    fruit: list[dict[str, Any]],
    words: str,
    on_taps: Callable[[], None] | None = None,
    *,
    opened: str = "",
) -> None:
    """Draw a list of fruit to tick off or to open; opening one puts it into the address.

    Parameters
    ----------
    key, label : str
        The element's own, and its name for screen readers.
    fruit : list of dict
        'key', 'picture' (a data URL, or None), 'says' (words that are drawn side by side, or under
        each other on a phone), and 'picked'.
    words : str
        Heading of the list, after the number of picked fruit.
    on_taps : callable
        Called with every tap, before anything is drawn, so that all totals count it; None for
        fruit to be opened.
    opened : str
        Key of the fruit that is shown beside the list.
    """

    def open_it() -> None:
        name_in_address("fruit", st.session_state[key].opened)

    data = {
        "fruit": tuple(fruit),  # Streamlit looks for tables in lists, and imports pandas for it
        "words": words,
        "label": label,
        "opens": on_taps is None,
        "opened": opened,
    }
    tapped = {"on_opened_change": open_it} if on_taps is None else {"on_taps_change": on_taps}
    component("fruitlist")(key=key, data=data, **tapped)


def pictures(views: Sequence[FruitRow], words: Callable[[FruitRow], str]) -> None:
    """Draw views side by side, each with words below."""
    with st.container(horizontal=True):
        for view in views:
            with st.container(width=_PICTURE_PX):
                if (cut := round_view.cutout_of(view)) is not None:
                    st.image(
                        cut,
                        width="stretch",
                        alt=_("Fruit at {stop}").format(stop=step_words(view.step).lower()),
                    )
                st.caption(words(view))


def first_of(items: Sequence[Any], key: str, size: int) -> Sequence[Any]:
    """Return the items that are drawn: more with each press of the button of `draw_more`."""
    return items[: st.session_state.get(key, size)]


def draw_more(items: Sequence[Any], key: str, size: int) -> None:
    """Draw the button that shows more items, where there are more."""
    drawn = st.session_state.get(key, size)
    if len(items) > drawn:
        words = _("Show more ({drawn} of {all})").format(drawn=drawn, all=len(items))
        button(st, words, "expand_more", st.session_state.__setitem__, key, drawn + 5 * size)


def first_steps(*, begun: bool) -> None:
    """Draw the steps to a house's first list; the first is done where its round is begun."""
    missing = _("This round has no stops yet.") if begun else _("There is no round yet.")
    st.markdown(f"**{missing}** {_('Three steps to its first list:')}")
    steps = (
        (_("Start a round"), _("'New round' above: a name, the house and its crop.")),
        (_("Photograph a row"), _("Walk with the camera, or upload photos of another one.")),
        (_("See what is ready"), _("Fruit by class and row, with the list to pick from.")),
    )
    lines = [
        f"<li{' class=done' if begun and not k else ''}><b>{escape(name)}</b>{escape(words)}</li>"
        for k, (name, words) in enumerate(steps)
    ]
    st.html(f'<ol class="steps">{"".join(lines)}</ol>')
    if begun:
        capture, upload = st.columns(2)
        with capture:
            link("capture", _("Capture"))
        with upload:
            link("upload", _("Upload"))


def link(page: str, label: str, **parts: str) -> None:
    """Draw a link to another page of the round; its name is the end of the address."""
    target = st.session_state.get("pages", {}).get(page)
    if target is not None:
        st.page_link(
            target, label=label, icon=target.icon, query_params=here(**parts), width="stretch"
        )


def here(**parts: str) -> dict[str, str]:
    """Return the parameters of an address: the open round and other parts."""
    opened = st.session_state.get("round")
    return ({"round": opened} if opened else {}) | parts


def work_words(hours: float, crates: float) -> str:
    """Return the work and crates that picking takes, in words.

    Examples
    --------
    >>> work_words(0.2333, 6.0)
    '14 min and 6 crates'
    """
    work = hours_words(hours)
    return counted(int(crates), "{hours} and {n} crate", "{hours} and {n} crates", hours=work)


def name_in_address(name: str, value: str | None) -> None:
    """Put a fruit, row or stop into the address, so that it can be shared; None removes it."""
    if value is not None:
        st.query_params[name] = value
    elif name in st.query_params:
        del st.query_params[name]


def say_missing(name: str, present: Container[str | None], words: str) -> None:
    """Show that the object in the address does not exist, instead of another object.

    Parameters
    ----------
    name : str
        The part of the address: 'fruit', 'stop' or 'row'.
    present : container of str
        The existing objects.
    words : str
        The words.
    """
    if (named := st.query_params.get(name)) is not None and named not in present:
        st.warning(words.format(plain(named[:40])), icon=":material/search_off:")


def live() -> None:
    """Show the current work; draw the page anew after a change of its round by anybody."""
    _live(round_view.news(opened_round())["version"])


def opened_round() -> str:
    """Return the key of the open round; the newest before a page has chosen one, empty without."""
    return st.session_state.get("round") or next((walk.key for walk in resources.rounds()), "")


@st.fragment(run_every=_NEWS_S)
def _live(version: str) -> None:
    news = round_view.news(opened_round())
    if version != news["version"]:
        st.rerun()
    work = news["work"]
    if not work["words"]:
        st.session_state.pop("work_begun", None)
    elif work["total"]:
        share = min(work["done"] / work["total"], 1.0)
        st.progress(share, plain(work["words"] + _time_left(work)))
    else:
        st.caption(plain(work["words"]))


def _time_left(work: Mapping[str, Any]) -> str:
    """Return how long work takes until its end, by the steps since this page showed it first."""
    name, now_s = work["words"].split(":")[0], time.monotonic()
    begun = st.session_state.get("work_begun", ("", 0.0, 0))
    if begun[0] != name:
        begun = st.session_state["work_begun"] = (name, now_s, work["done"])
    if work["done"] <= begun[2]:
        return ""
    left_s = (now_s - begun[1]) / (work["done"] - begun[2]) * (work["total"] - work["done"])
    if left_s < _SHORT_S:
        return ""
    if left_s < 90:
        return ", " + _("about {n} s left").format(n=round(left_s))
    return ", " + _("about {n} min left").format(n=round(left_s / 60))


def rows(walk: RoundView, rows: Sequence[str] = (), *, opened: str = "") -> dict[str, str]:
    """Draw rows as they hang, small ones where they are named, and return all drawings.

    A tap opens the fruit; `opened` is the key of the one to show.
    """
    drawn = _drawn(walk, tuple(rows), resources.settings().units, language())
    figures = "".join(
        f"<figure><figcaption>{escape(title)}</figcaption>"
        f'<div class="strip" tabindex="0" role="group" aria-label="{escape(title)}">{svg}</div>'
        "</figure>"
        for title, svg in drawn.items()
    )
    data = {"rows": figures, "small": bool(rows), "opened": opened, "place": walk.key}
    data["address"] = f"/results?{urlencode(here(fruit=''))}"
    key = f"rows_{walk.key}_{'_'.join(map(str, rows))}"
    tapped = component("row")(key=key, data=data, on_opened_change=lambda: None).opened
    if tapped and (target := st.session_state.get("pages", {}).get("results")):
        st.switch_page(target, query_params=here(fruit=tapped))
    return drawn


@lru_cache(maxsize=16)
def _drawn(walk: RoundView, rows: tuple[str, ...], units: Units, _language: str) -> dict[str, str]:
    fruit = [view for view in walk.shaped if not rows or (view.row or "") in rows]
    return draw_rows(fruit, walk.content.stops, walk.grades, units)


def component(name: str) -> Any:
    """Return a component made of the files of that name in `static`, in the language shown."""
    return _component(name, language())


@st.cache_resource(show_spinner=False)
def _component(name: str, code: str) -> Any:
    folder = PICTURE_FILES if name == "picture" else Path(__file__).with_name("static")
    html, css, js = (
        page_text((folder / f"{name}.{kind}").read_text(encoding="utf-8"), kind)
        for kind in ("html", "css", "js")
    )
    name = f"cucumbervision_{name}_{code}"
    return st.components.v2.component(name, html=html, css=css, js=js)
