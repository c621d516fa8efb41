"""The choice of a round above every page; rounds are begun, renamed, deleted and restored."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from functools import partial, wraps
from typing import Any

import streamlit as st

from cucumbervision.names import same_house
from cucumbervision_greenhouse import resources, round_view, tasks
from cucumbervision_greenhouse.language import Option, counted, plain, told_apart
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.pages import page_elements
from cucumbervision_greenhouse.pages.page_elements import button
from cucumbervision_greenhouse.round_view import RoundView
from cucumbervision_greenhouse.rounds.merge_and_link import delete_round, move_rounds
from cucumbervision_greenhouse.rounds.walking import is_demonstration
from cucumbervision_greenhouse.store.records import Round, new_key
from cucumbervision_greenhouse.words import round_name


def of_round(draw: Callable[[RoundView], None], *, needs_stops: bool = True) -> Callable[[], None]:
    """Make a page of a function that draws a round: the round is chosen above it."""

    @wraps(draw)
    def page() -> None:
        round_summary = choose_round()
        if missing := st.session_state.get(_MISSING):
            words = _("There is no round '{name}'. Choose one above, or start a new one.")
            words = words.format(name=plain(str(missing)[:40]))
            st.warning(words, icon=":material/search_off:")
        elif round_summary is None:
            page_elements.first_steps(begun=False)
        elif needs_stops and not round_summary.stops:
            _draw_empty(round_summary.key)
        else:
            draw(round_view.view_of(round_summary))

    return page


def _draw_empty(round_key: str) -> None:
    """Draw a round without stops: they are being measured, are to come, or were deleted."""
    progress = tasks.progress(round_key)
    words = progress.first
    if progress.waiting:
        tasks.wake()
    elif is_demonstration(round_key) and progress.words:
        words = _("The example is being measured; its fruit appear here.")
    if words:
        st.info(words, icon=":material/hourglass_empty:")
    else:
        page_elements.first_steps(begun=True)
    if resources.store().own_actions(round_key):
        page_elements.draw_undo(round_key)


def label_options(key: str, names: Mapping[Option, str]) -> Callable[[Option], str]:
    """Return the labels of a choice that is drawn next: unique, and never reused for another.

    Streamlit identifies a choice by its label alone. Labels contain numbers of stops or fruit, so a
    browser may answer with an earlier label.

    Parameters
    ----------
    key : str
        Key of the choice in the session.
    names : mapping
        The options with their names.

    Returns
    -------
    callable
        The label of an option, as `format_func` of the choice.
    """
    labels = told_apart(names)
    meant = st.session_state.setdefault(f"{key}_labels", {})
    chosen = st.session_state.get(key)
    if chosen not in names and chosen in meant:
        st.session_state[key] = meant[chosen]
    meant.update({label: option for option, label in labels.items()})
    return lambda option: labels.get(option, str(option))


_MISSING = "missing_round"


def choose_round() -> Round | None:
    """Draw the choice, and return the open round, or None."""
    rounds = {round_summary.key: round_summary for round_summary in resources.rounds()}
    names = {key: round_name(round_summary) for key, round_summary in rounds.items()}
    label = label_options("round", names)
    asked = st.session_state.get("round")
    if asked in rounds:
        st.session_state.pop(_MISSING, None)
    elif asked is None and not st.session_state.get(_MISSING):
        st.session_state["round"] = next(iter(rounds), None)
    else:  # no other round is shown instead
        st.session_state[_MISSING] = asked or st.session_state[_MISSING]
        st.session_state["round"] = None
    with st.container(key="rounds"):
        chosen, new, change = st.columns([6, 2, 1], vertical_alignment="center")
    key = chosen.selectbox(
        _("Round"),
        list(rounds),
        format_func=label,
        key="round",
        placeholder=_("Choose a round") if rounds else _("No round yet"),
        label_visibility="collapsed",
        persist_state="session",
    )
    round_summary = rounds.get(key) if key else None
    if round_summary is not None and st.query_params.get("round") != round_summary.key:
        # A slow browser sends the earlier round again, which must not open it.
        st.session_state["named_before"] = st.session_state.get("named")
        st.query_params["round"] = st.session_state["named"] = round_summary.key
    closed = st.session_state.setdefault("popovers_closed", 0)
    tall: dict[str, Any] = {"width": "stretch", "on_change": "rerun"}
    with new.popover(_("New round"), icon=":material/add:", key=f"new_{closed}", **tall):
        _begin(rounds.values())
    tall |= {"help": _("Rename or delete"), "key": f"change_{closed}"}
    with change.popover("", icon=":material/edit:", **tall):
        _change(round_summary)
    return round_summary


def _do(act: Callable[[], object]) -> None:
    """Do what a button of a popover asks for, and close it.

    The popovers get new keys: where a button in one is pressed before the server has drawn it open,
    the browser ignores a state that says closed, since none ever said open.
    """
    act()
    st.session_state["popovers_closed"] += 1


def _begin(rounds: Collection[Round]) -> None:
    st.text_input(_("Name"), placeholder=_(resources.USUAL_NAME), key="new_name")
    houses = resources.houses(rounds)
    newest = next((x.house for x in rounds), "")
    st.session_state.setdefault("new_house", newest)
    # Never a choice that text is typed into: a house that is not picked from it would be lost.
    st.text_input(_("House"), placeholder=_(resources.USUAL_HOUSE), key="new_house")
    if len(houses) > 1:
        st.pills(_("Known houses"), houses, key="known_house", on_change=_choose_house)
    titles, saved = resources.crop_titles(), resources.settings().profile
    usual = list(titles).index(saved) if saved in titles else 0
    crop = page_elements.choose(st.selectbox, _("Crop"), titles, index=usual)

    def begin(key: str) -> None:
        # Read the fields' current values: the page may not have been redrawn since they changed.
        name, house = (str(st.session_state.get(key, "")) for key in ("new_name", "new_house"))
        record = resources.new_round(name, house, crop, key)
        resources.store().save_round(record)
        if (same := same_house(record.house, houses)) != " ".join(record.house.split()):
            words = _("The round is in the house '{house}', which is known by that name.")
            st.toast(plain(words.format(house=same)))
        st.session_state["round"] = record.key

    # Pressed twice before the page is drawn again, it begins the same round.
    act = partial(begin, new_key())
    button(st, _("Start this round"), "add", _do, act, type="primary")


def _choose_house() -> None:
    st.session_state["new_house"] = st.session_state["known_house"] or ""


def _change(walk: Round | None) -> None:
    if walk is not None:
        title = _(resources.profile_of(walk)[1].title)
        st.caption(plain(_("Crop: {title}").format(title=title)))
        field = f"name_{walk.key}_{walk.name}"  # a new field where somebody renamed it
        name = st.text_input(_("Name of this round"), walk.name, key=field)
        rename = partial(_rename, walk, field)
        button(st, _("Rename"), "edit", _do, rename, disabled=not name.strip())
        _house(walk)
        button(st, _("Delete this round"), "delete", _do, partial(_delete, walk.key))
    for gone in resources.store().rounds(deleted=True):
        words = _("Restore: {round}").format(round=plain(round_name(gone)))
        button(st, words, "undo", _do, partial(_bring_back, gone.key), key=f"back_{gone.key}")


def _house(walk: Round) -> None:
    """Draw the house of a round: the round moves, or the house gets another name or is merged."""
    key, house = walk.key, walk.house
    field = st.text_input(_("House"), house, key=f"house_{key}_{house}")
    typed = " ".join(field.split())
    if typed == house:
        return
    rounds = resources.rounds()
    houses = resources.houses(rounds)
    of_house = [x.key for x in rounds if x.house == house]
    same_name = same_house(typed, [name for name in houses if name != house])
    words = _("Rename the house")
    if same_name in houses:
        words = _("Merge the house with '{house}'").format(house=same_name)
    words = f"{plain(words)} ({counted(len(of_house), '{n} round', '{n} rounds')})"
    button(st, _("Move this round"), "house", _do, partial(_move, [key], house, typed))
    if house:  # rounds without a house are not of one house
        button(st, words, "merge", _do, partial(_move, of_house, house, typed))


def _move(keys: list[str], seen: str, house: str) -> None:
    for key in move_rounds(resources.store(), keys, house, seen):
        tasks.merge(key)  # linked to the other rounds of its house now


def _rename(walk: Round, field: str) -> None:
    # Read the field's current value, which may have changed since it was drawn.
    if name := st.session_state[field].strip():
        resources.store().rename_round(walk.key, name, walk.name)


def _delete(key: str) -> None:
    for after in delete_round(resources.store(), key, resources.waiting()):
        tasks.merge(after)
    st.session_state["round"] = None  # the newest of the others


def _bring_back(key: str) -> None:
    resources.store().restore_round(key)
    tasks.merge(key)  # the neighbouring rounds were linked without it
    st.session_state["round"] = key
