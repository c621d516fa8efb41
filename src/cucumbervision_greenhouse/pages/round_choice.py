"""The choice of a round above every page; rounds are begun, renamed, deleted and restored."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Any

import streamlit as st

from cucumbervision.errors import CucumberVisionError
from cucumbervision.names import same_house
from cucumbervision_greenhouse import resources, tasks
from cucumbervision_greenhouse.language import (
    Option,
    counted,
    plain,
    sentence,
    told_apart,
    words_of,
)
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.rounds.merge_and_link import delete_round, move_rounds
from cucumbervision_greenhouse.store.records import Round, new_key
from cucumbervision_greenhouse.words import round_name


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
_BEGINNING, _CHANGING = "beginning_round", "changing_round"


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
    )
    round_summary = rounds.get(key) if key else None
    if round_summary is not None and st.query_params.get("round") != round_summary.key:
        # A slow browser sends the earlier round again, which must not open it.
        st.session_state["named_before"] = st.session_state.get("named")
        st.query_params["round"] = st.session_state["named"] = round_summary.key
    tall: dict[str, Any] = {"width": "stretch", "on_change": "rerun"}
    with new.popover(_("New round"), icon=":material/add:", key=_popover_key(_BEGINNING), **tall):
        _begin(rounds.values())
    tall |= {"help": _("Rename or delete")}
    with change.popover("", icon=":material/edit:", key=_popover_key(_CHANGING), **tall):
        _change(round_summary)
    return round_summary


def _popover_key(name: str) -> str:
    return f"{name}_{st.session_state.get(name, 0)}"


def _close(name: str) -> None:
    """Close a popover from inside it.

    It gets a new key: where a button in it is pressed before the server has drawn it open, the
    browser ignores a state that says closed, since none ever said open.
    """
    st.session_state[name] = st.session_state.get(name, 0) + 1


def missing_round() -> str:
    """Return the round in the address if it does not exist, else an empty text."""
    return str(st.session_state.get(_MISSING) or "")


def _begin(rounds: Collection[Round]) -> None:
    st.text_input(_("Name"), placeholder=_(resources.USUAL_NAME), key="new_name")
    houses = resources.houses(rounds)
    newest = next((x.house for x in rounds), "")
    st.session_state.setdefault("new_house", newest)
    # Never a choice that text is typed into: a house that is not picked from it would be lost.
    st.text_input(_("House"), placeholder=_(resources.USUAL_HOUSE), key="new_house")
    if len(houses) > 1:
        st.pills(_("Known houses"), houses, key="known_house", on_change=_choose_house)
    titles = resources.crop_titles()
    usual = resources.settings().profile
    crop = st.selectbox(
        _("Crop"),
        list(titles),
        index=list(titles).index(usual) if usual in titles else 0,
        format_func=titles.__getitem__,
    )

    def begin(key: str) -> None:
        # Read the fields' current values: the page may not have been redrawn since they changed.
        name, house = (str(st.session_state.get(key, "")) for key in ("new_name", "new_house"))
        record = resources.new_round(name, house, crop, key)
        try:
            resources.store().save_round(record)
        except CucumberVisionError as error:
            st.session_state["begin_fault"] = words_of(error)
            return
        if (same := same_house(record.house, houses)) != " ".join(record.house.split()):
            words = _("The round is in the house '{house}', which is known by that name.")
            st.toast(plain(words.format(house=same)))
        st.session_state["round"] = record.key
        _close(_BEGINNING)

    # Pressed twice before the page is drawn again, it begins the same round.
    button: dict[str, Any] = {"key": f"begin_{_popover_key(_BEGINNING)}", "args": (new_key(),)}
    st.button(_("Start this round"), type="primary", width="stretch", on_click=begin, **button)
    if fault := st.session_state.pop("begin_fault", None):
        st.warning(sentence(fault), icon=":material/error:")


def _choose_house() -> None:
    st.session_state["new_house"] = st.session_state["known_house"] or ""


def _change(walk: Round | None) -> None:
    if fault := st.session_state.pop("round_fault", None):
        st.warning(sentence(fault), icon=":material/error:")
    if walk is not None:
        title = _(resources.profile_of(walk)[1].title)
        st.caption(plain(_("Crop: {title}").format(title=title)))
        field = f"name_{walk.key}_{walk.name}"  # a new field where somebody renamed it
        name = st.text_input(_("Name of this round"), walk.name, key=field)
        _button(_("Rename"), partial(_rename, walk, field), disabled=not name.strip())
        _house(walk)
        _button(_("Delete this round"), partial(_delete, walk.key), icon=":material/delete:")
    for gone in resources.store().rounds(deleted=True):
        words = _("Restore: {round}").format(round=plain(round_name(gone)))
        _button(
            words, partial(_bring_back, gone.key), icon=":material/undo:", key=f"back_{gone.key}"
        )


def _button(label: str, act: Callable[[], None], **how: Any) -> None:
    """Draw a button that changes a round and closes the popover, or shows the fault in it."""

    def do() -> None:
        try:
            act()
        except CucumberVisionError as error:
            st.session_state["round_fault"] = words_of(error)
        else:
            _close(_CHANGING)

    st.button(label, width="stretch", on_click=do, **how)


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
    _button(_("Move this round"), partial(_move, [key], house, typed))
    if house:  # rounds without a house are not of one house
        _button(words, partial(_move, of_house, house, typed))


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
