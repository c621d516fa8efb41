"""Limits of a crop's classes, edited on a page: what they would change, and the profile's file."""

from __future__ import annotations

import unicodedata
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

from cucumbervision.capture.source import safe_name
from cucumbervision.crop.grades import grade
from cucumbervision.crop.profiles import CropProfile, profiles, profiles_folder
from cucumbervision.errors import Message, ProfileError
from cucumbervision.files import parse_model
from cucumbervision.names import checked_name
from cucumbervision_greenhouse.settings import replace_text

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from cucumbervision_greenhouse.store.records import FruitRow

_OWN_RULE = "limits of this house"


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
