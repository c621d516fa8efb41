"""The crop on 'Settings': browse crops, choose that of new rounds, edit the limits of classes."""

from __future__ import annotations

import unicodedata
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import streamlit as st

from cucumbervision.capture.source import safe_name
from cucumbervision.crop.grades import grade
from cucumbervision.crop.profiles import CropProfile, profiles, profiles_folder
from cucumbervision.errors import CucumberVisionError, Message, ProfileError
from cucumbervision.files import parse_model
from cucumbervision.names import checked_name
from cucumbervision_greenhouse import resources, round_view
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.language import marked, plain, sentence, told_apart, words_of
from cucumbervision_greenhouse.pages import page_elements
from cucumbervision_greenhouse.rounds.fruit_table import on_the_plant
from cucumbervision_greenhouse.settings import replace_text
from cucumbervision_greenhouse.words import class_words, label_words, round_name

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from cucumbervision_greenhouse.store.records import FruitRow


def draw() -> None:
    """Draw the choice of a crop, its limits, and the form that changes them."""
    saved = resources.settings().profile
    entries = {entry.name: entry for entry in profiles()}
    readable = {
        name: profile for name, entry in entries.items() if (profile := entry.profile) is not None
    }
    titles = told_apart({name: _(profile.title) for name, profile in readable.items()})
    name = st.selectbox(
        _("Crop"),
        list(readable),
        index=list(readable).index(saved) if saved in readable else 0,
        format_func=titles.__getitem__,
    )
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
    limits = _fields(name, profile)
    title = st.text_input(
        _("Name of your crop"),
        profile.title if own else _("{crop}, own limits").format(crop=_(profile.title)),
        key=f"{_key(name, profile)}_title",
    )
    try:
        changed = limits.applied_to(profile, title.strip())
    except CucumberVisionError as error:
        st.error(sentence(error), icon=":material/error:")
        return
    _preview(profile, changed)

    def save() -> None:
        try:
            path = save_own_profile(changed, profile)
        except CucumberVisionError as error:
            st.session_state["limits_fault"] = words_of(error)
            return
        resources.forget_profiles()
        resources.change_settings(profile=path.stem)
        words = _("Saved: new rounds have the crop '{crop}'.")
        st.toast(plain(words.format(crop=changed.title)))

    page_elements.button(
        st,
        _("Save and use for new rounds"),
        "save",
        save,
        type="primary",
        disabled=not title.strip(),
    )
    if fault := st.session_state.pop("limits_fault", None):
        st.error(sentence(fault), icon=":material/error:")
    st.caption(
        _(
            "Saved as a crop of your own; the one that the program brings stays as it is. Rounds "
            "that have a crop of this name are graded by the new limits."
        )
    )


def _key(name: str, profile: CropProfile) -> str:
    """Return what the keys of a crop's fields begin with: others where its limits were changed."""
    return f"limits_{name}_{hash(CropLimits.of(profile))}"


def _fields(name: str, profile: CropProfile) -> CropLimits:
    """Draw the limits of a profile as fields, and return what they hold."""
    limits, key = CropLimits.of(profile), _key(name, profile)
    edges_m = _edge_fields(key, profile, limits)
    arcs = [
        st.number_input(
            sentence(
                _("{shape} up to [mm of arc for 10 cm]").format(shape=_(profile.shape[number].name))
            ),
            *page_elements.spanning(0.5, 100.0, arc),
            0.5,
            format="%.1f",
            key=f"{key}_arc_{number}",
        )
        for number, arc in enumerate(limits.arc_mm_per_10cm)
    ]
    thin, light = st.columns(2)
    diameter_mm = thin.number_input(
        _("Thinnest [mm]; 0: no limit"),
        *page_elements.spanning(0.0, 200.0, limits.minimum_diameter_mm or 0.0),
        1.0,
        format="%.0f",
        key=f"{key}_thin",
    )
    weight_g = light.number_input(
        _("Lightest [g]; 0: no limit"),
        *page_elements.spanning(0.0, 5000.0, limits.minimum_g or 0.0),
        10.0,
        format="%.0f",
        key=f"{key}_light",
    )
    decide = st.toggle(
        _("Thickness and weight decide on the class"), limits.decide, key=f"{key}_decide"
    )
    names = [c.name for c in profile.classes]
    pick = st.pills(
        _("Ready to be picked"),
        names,
        format_func=lambda name: plain(class_words(name)),
        selection_mode="multi",
        default=limits.pick,
        key=f"{key}_pick",
    )
    return CropLimits(
        edges_m=edges_m,
        pick=tuple(pick),
        arc_mm_per_10cm=tuple(arcs),
        minimum_diameter_mm=diameter_mm or None,
        minimum_g=weight_g or None,
        decide=decide,
    )


def _edge_fields(key: str, profile: CropProfile, limits: CropLimits) -> tuple[float, ...]:
    """Draw the lengths between the classes two abreast, and return them in metres."""
    units = resources.settings().units
    names = [class_words(c.name) for c in sorted(profile.classes, key=lambda c: c.min_cm)]
    labels = [_("{name} from").format(name=name) for name in names]
    labels.append(_("{name} below").format(name=names[-1]))
    places = [place for _pair in labels[::2] for place in st.columns(2)]
    edges_m = []
    for number, (place, edge_m) in enumerate(zip(places, limits.edges_m, strict=False)):
        shown = units.value(edge_m) or 0.0
        value = place.number_input(
            sentence(f"{labels[number]} [{units.name}]"),
            *page_elements.spanning(0.1, 200.0, shown),
            0.5 if units.name == "cm" else 0.25,
            format=f"%.{units.digits}f",
            key=f"{key}_{number}_{units.name}",
        )
        # A limit that was not changed is not rounded as it is shown in inches.
        edges_m.append(edge_m if value == shown else units.metres(float(value or 0.0)))
    return tuple(edges_m)


def _preview(profile: CropProfile, changed: CropProfile) -> None:
    """Show what the limits would change among the fruit of the newest round."""
    newest = next((x for x in resources.rounds() if x.fruit), None)
    if newest is None:
        return
    fruit = on_the_plant(round_view.graded_round(newest).fruit)
    before, after = class_counts(fruit, profile), class_counts(fruit, changed)
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


@dataclass(frozen=True)
class CropLimits:
    """The limits of a crop's classes.

    Parameters
    ----------
    edges_m : tuple of float
        Lengths between the classes, metres, ascending: the lower limit of each class from the
        shortest to the longest, and the upper limit of the last.
    pick : tuple of str
        Classes that are ready to be picked.
    arc_mm_per_10cm : tuple of float
        Highest inner arc of each band of crookedness but the last, ascending.
    minimum_diameter_mm, minimum_g : float, optional
        Thinnest and lightest fruit of any class; None for no limit.
    decide : bool
        Whether diameter and weight decide on the class instead of adding a remark.
    """

    edges_m: tuple[float, ...]
    pick: tuple[str, ...]
    arc_mm_per_10cm: tuple[float, ...] = ()
    minimum_diameter_mm: float | None = None
    minimum_g: float | None = None
    decide: bool = False

    @classmethod
    def of(cls, profile: CropProfile) -> CropLimits:
        """Return the limits of a profile.

        Examples
        --------
        >>> from cucumbervision.crop.profiles import load_profile
        >>> limits = CropLimits.of(load_profile("long-cucumber"))
        >>> limits.edges_m, limits.pick, limits.arc_mm_per_10cm, limits.minimum_g
        ((0.2, 0.25, 0.35), ('I',), (10.0, 20.0), 250.0)
        """
        arcs = [band.max_mm_per_10cm for band in profile.shape]
        return cls(
            edges_m=tuple(profile.edges_m.tolist()),
            pick=profile.pick,
            arc_mm_per_10cm=tuple(arc for arc in arcs if arc is not None),
            minimum_diameter_mm=profile.minimum_diameter_mm,
            minimum_g=profile.minimum_g,
            decide=profile.size_rules == "decide",
        )

    def applied_to(self, profile: CropProfile, title: str = "") -> CropProfile:
        """Return a profile with these limits instead of its own.

        Parameters
        ----------
        profile : CropProfile
            With as many classes, and as many limits of crookedness.
        title : str
            The new profile's title; the old one's where it is empty.

        Raises
        ------
        ProfileError
            If the limits do not rise, no class is picked, or they contradict the profile.
        """
        if list(self.edges_m) != sorted(set(self.edges_m)):
            raise ProfileError("the lengths do not rise", remedy="give each class a longer limit")
        if not self.pick:
            raise ProfileError("no class is ready to be picked", remedy="choose at least one")
        names = [c.name for c in sorted(profile.classes, key=lambda c: c.min_cm)]
        edges_cm = [round(100 * edge_m, 3) for edge_m in self.edges_m]
        limits = {name: edges_cm[k : k + 2] for k, name in enumerate(names)}
        content = profile.model_dump(mode="json", exclude_none=True)
        for length_class in content["classes"]:
            length_class["min_cm"], length_class["max_cm"] = limits[length_class["name"]]
        for band, arc in zip(content["shape"], self.arc_mm_per_10cm, strict=False):
            band["max_mm_per_10cm"] = arc
        optional = {"minimum_diameter_mm": self.minimum_diameter_mm, "minimum_g": self.minimum_g}
        content |= {
            "title": title or profile.title,
            "pick": list(self.pick),
            "size_rules": "decide" if self.decide else "remark",
            "rules": {**profile.rules, "classes": _OWN_RULE},
            **optional,
        }
        return parse_model(CropProfile, content, source=Message("the limits"), error=ProfileError)


def class_counts(views: Iterable[FruitRow], profile: CropProfile) -> Counter[str]:
    """Return how many fruit are in each class by a profile."""
    return Counter(grade(view, profile).label for view in views)


def save_own_profile(profile: CropProfile, before: CropProfile | None = None) -> Path:
    """Write a profile into the user's folder of profiles, named after its title.

    Parameters
    ----------
    profile : CropProfile
        The profile.
    before : CropProfile, optional
        The one that was changed.

    Returns
    -------
    Path
        The file; the crop of this title is replaced.

    Raises
    ------
    ProfileError
        If the title has no letter or digit or is too like another crop's, if somebody else has
        changed the crop since, or if the file cannot be written.
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
        if before is not None and before.title == saved.title and before != saved:
            raise ProfileError(
                "it was changed again since", remedy="look at its limits as they are now"
            )
    content = profile.model_dump(mode="json", exclude_none=True)
    replace_text(path, tomli_w.dumps(content))
    return path


def _compared(title: str) -> str:
    """Return a title as two are compared: in one case, and in one form of Unicode."""
    return unicodedata.normalize("NFC", title.casefold())
