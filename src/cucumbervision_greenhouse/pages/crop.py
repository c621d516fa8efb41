"""The crop on 'Settings': browse crops, choose that of new rounds, edit the limits of classes."""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import streamlit as st

from cucumbervision.capture.source import safe_name
from cucumbervision.crop.profiles import CropProfile, profiles, profiles_folder
from cucumbervision.errors import CucumberVisionError, Message, ProfileError
from cucumbervision.files import parse_model
from cucumbervision.names import checked_name
from cucumbervision_greenhouse import resources, round_view
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.language import marked, plain, sentence, told_apart
from cucumbervision_greenhouse.pages import page_elements
from cucumbervision_greenhouse.rounds.fruit_table import on_the_plant
from cucumbervision_greenhouse.settings import replace_text
from cucumbervision_greenhouse.words import class_words, label_words, round_name


def draw() -> None:
    """Draw the choice of a crop, its limits, and the form that changes them."""
    saved = resources.settings().profile
    entries = {entry.name: entry for entry in profiles()}
    readable = {
        name: profile for name, entry in entries.items() if (profile := entry.profile) is not None
    }
    titles = told_apart({name: _(profile.title) for name, profile in readable.items()})
    usual = list(readable).index(saved) if saved in readable else 0
    name = page_elements.choose(st.selectbox, _("Crop"), titles, index=usual)
    if name == saved:
        st.caption(_("New rounds have this crop. Rounds that were begun keep theirs."))
    else:
        page_elements.button(
            st, _("Use for new rounds"), "check", lambda: resources.change_settings(profile=name)
        )
    profile = readable[name]
    _limits(profile)
    with st.expander(_("Change the limits"), icon=":material/edit:"):
        _form(name, profile, own=not entries[name].shipped)
    for entry in entries.values():
        if entry.fault:
            st.warning(plain(entry.fault), icon=":material/error:")


def _limits(profile: CropProfile) -> None:
    units = resources.settings().units
    lines = [
        {
            _("Class"): c.name,
            _("From"): units.text(c.min_cm / 100),
            _("Below"): units.text(c.max_cm / 100),
        }
        for c in profile.classes
    ]
    page_elements.table(lines)
    for rule in profile.rules.values():
        st.caption(plain(_(rule)))


def _form(name: str, profile: CropProfile, *, own: bool) -> None:
    """Draw the limits as fields, what they would change, and the button that saves them."""
    key = f"limits_{name}_{hash(profile.model_dump_json())}"  # new fields where it was changed
    limits = _fields(key, profile)
    usual = profile.title if own else _("{crop}, own limits").format(crop=_(profile.title))
    title = st.text_input(_("Name of your crop"), usual, key=f"{key}_title").strip()
    try:
        changed = with_limits(profile, title=title, **limits)
    except CucumberVisionError as error:
        st.error(sentence(error), icon=":material/error:")
        return
    _preview(profile, changed)

    def save() -> None:
        path = save_own_profile(changed)
        resources.forget_profiles()
        resources.change_settings(profile=path.stem)
        words = _("Saved: new rounds have the crop '{crop}'.")
        st.toast(plain(words.format(crop=changed.title)))

    how: dict[str, Any] = {"type": "primary", "disabled": not title}
    page_elements.button(st, _("Save and use for new rounds"), "save", save, **how)
    st.caption(
        _(
            "Saved as a crop of your own; the one that the program brings stays as it is. Rounds "
            "that have a crop of this name are graded by the new limits."
        )
    )


def _fields(key: str, profile: CropProfile) -> dict[str, Any]:
    """Draw the limits of a profile as fields, and return what they hold, for `with_limits`."""
    units = resources.settings().units

    def number(
        place: Any, label: str, least: float, most: float, value: float, step: float
    ) -> float:
        digits = max(-math.floor(math.log10(step)), 0)
        span = page_elements.spanning(least, most, value)
        how = {"format": f"%.{digits}f", "key": f"{key}_{label}"}
        return float(place.number_input(sentence(label), *span, step, **how))

    classes = sorted(profile.classes, key=lambda c: c.min_cm)
    labels = [_("{name} from").format(name=class_words(c.name)) for c in classes]
    labels.append(_("{name} below").format(name=class_words(classes[-1].name)))
    two = st.columns(2)
    edges_m = []
    for k, (label, edge_m) in enumerate(zip(labels, profile.edges_m.tolist(), strict=True)):
        shown, step = units.value(edge_m) or 0.0, 0.5 if units.name == "cm" else 0.25
        value = number(two[k % 2], f"{label} [{units.name}]", 0.1, 200.0, shown, step)
        # A limit that was not changed is not rounded as it is shown in inches.
        edges_m.append(edge_m if value == shown else units.metres(value))
    up_to = _("{shape} up to [mm of arc for 10 cm]")
    arcs = [
        number(st, up_to.format(shape=_(band.name)), 0.5, 100.0, band.max_mm_per_10cm, 0.5)
        for band in profile.shape
        if band.max_mm_per_10cm is not None
    ]
    thinnest, lightest = _("Thinnest [mm]; 0: no limit"), _("Lightest [g]; 0: no limit")
    first, second = st.columns(2)
    diameter_mm = number(first, thinnest, 0.0, 200.0, profile.minimum_diameter_mm or 0.0, 1.0)
    mass_g = number(second, lightest, 0.0, 5000.0, profile.minimum_g or 0.0, 10.0)
    words = _("Thickness and weight decide on the class")
    decide = st.toggle(words, profile.size_rules == "decide", key=f"{key}_decide")
    names = {c.name: plain(class_words(c.name)) for c in profile.classes}
    how: dict[str, Any] = {"selection_mode": "multi", "default": profile.pick}
    ready = _("Ready to be picked")
    pick = page_elements.choose(st.pills, ready, names, key=f"{key}_pick", **how)
    sizes = {"minimum_diameter_mm": diameter_mm or None, "minimum_g": mass_g or None}
    rules = {"pick": pick, "size_rules": "decide" if decide else "remark"}
    return {"edges_m": edges_m, "arcs": arcs, **sizes, **rules}


def _preview(profile: CropProfile, changed: CropProfile) -> None:
    """Show what the limits would change among the fruit of the newest round."""
    newest = next((x for x in resources.rounds() if x.fruit), None)
    if newest is None:
        return
    fruit = on_the_plant(round_view.view_of(newest).fruit)
    before, after = (round_view.class_counts(fruit, x) for x in (profile, changed))
    lines = [
        {
            _("Class"): label_words(label),
            _("Now"): before[label],
            _("With these limits"): after[label],
        }
        for label in sorted({*before, *after})
    ]
    st.caption(plain(_("Fruit on the plant: {round}").format(round=round_name(newest))))
    page_elements.table(lines)


_OWN_RULE = marked("limits of this house")


def with_limits(
    profile: CropProfile,
    *,
    title: str = "",
    edges_m: Sequence[float] = (),
    arcs: Sequence[float] = (),
    **limits: object,
) -> CropProfile:
    """Return a profile with other limits.

    Parameters
    ----------
    profile : CropProfile
        The profile.
    title : str
        The new one's title.
    edges_m : sequence of float
        Lengths between the classes, metres, ascending: the lower limit of each class from the
        shortest to the longest, and the upper limit of the last.
    arcs : sequence of float
        Highest inner arc of each band of crookedness but the last, mm for 10 cm, ascending.
    **limits
        'pick', 'minimum_diameter_mm', 'minimum_g' and 'size_rules', as in `CropProfile`. What is
        not given stays.

    Raises
    ------
    ProfileError
        If the limits do not rise, no class is picked, or they contradict the profile.

    Examples
    --------
    >>> from cucumbervision.crop.profiles import load_profile
    >>> short = with_limits(load_profile("long-cucumber"), edges_m=(0.18, 0.22, 0.30))
    >>> [(c.name, c.min_cm, c.max_cm) for c in short.classes]
    [('I', 22.0, 30.0), ('II', 18.0, 22.0)]
    """
    if list(edges_m) != sorted(set(edges_m)):
        raise ProfileError("the lengths do not rise", remedy="give each class a longer limit")
    if not limits.get("pick", profile.pick):
        raise ProfileError("no class is ready to be picked", remedy="choose at least one")
    content = profile.model_dump(mode="json", exclude_none=True)
    classes = sorted(content["classes"], key=lambda c: c["min_cm"])
    for length_class, low_m, high_m in zip(classes, edges_m, edges_m[1:], strict=False):
        length_class |= {"min_cm": round(100 * low_m, 3), "max_cm": round(100 * high_m, 3)}
    for band, arc in zip(content["shape"], arcs, strict=False):
        band["max_mm_per_10cm"] = arc
    rules = {**profile.rules, "classes": _OWN_RULE}
    content |= {"title": title or profile.title, "rules": rules, **limits}
    return parse_model(CropProfile, content, source=Message("the limits"), error=ProfileError)


def save_own_profile(profile: CropProfile) -> Path:
    """Write a profile into the user's folder of profiles, named after its title; return the file.

    The crop of this title is replaced.

    Raises
    ------
    ProfileError
        If the title has no letter or digit or is too like another crop's, or if the file cannot be
        written.
    NameRefusedError
        If it is no name.
    """
    import tomli_w

    title = _compared(checked_name(profile.title, "crop"))
    if not any(letter.isalnum() for letter in title):
        raise ProfileError("the crop has no name", remedy="give it one with letters or digits")
    path = profiles_folder() / f"{safe_name(title)}.toml"
    taken = next((entry for entry in profiles() if entry.name == path.stem), None)
    if taken is not None:
        saved = taken.profile
        if taken.shipped or saved is None or _compared(saved.title) != title:
            named = taken.name if saved is None else saved.title
            raise ProfileError(
                "the crop '{name}' is saved by that name",
                remedy="give it a name with other letters or digits",
                name=named,
            )
    content = profile.model_dump(mode="json", exclude_none=True)
    replace_text(path, tomli_w.dumps(content))
    return path


def _compared(title: str) -> str:
    """Return a title as two are compared: in one case, and in one form of Unicode."""
    return unicodedata.normalize("NFC", title.casefold())
