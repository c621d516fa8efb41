"""Crop profiles: the shipped ones and the user's own."""

from __future__ import annotations

import os
import tomllib
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from cucumbervision.arrays import Array
from cucumbervision.errors import ProfileError
from cucumbervision.files import parse_model, read_bytes
from cucumbervision.methods.result import LengthDefinition

_TOO_SHORT, TOO_LONG = "too short", "too long"  # out of grade, and on which side

Positive = Annotated[float, Field(gt=0)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


class _Range(_Strict):
    min_cm: Positive
    max_cm: Positive

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.min_cm >= self.max_cm:
            raise ValueError(f"min_cm {self.min_cm:g} must be less than max_cm {self.max_cm:g}")
        return self


class SizeLimits(_Range):
    """Plausible lengths and mean diameters of this crop in cm; others are measurement errors."""

    min_diameter_cm: Positive = 0.1
    max_diameter_cm: Positive = 100.0


class LengthClass(_Range):
    """A class by length: from `min_cm`, inclusive, to `max_cm`, exclusive."""

    name: Annotated[str, Field(min_length=1)]


class ShapeBand(_Strict):
    """A shape class, by the inner arc's height in mm per 10 cm of chord.

    Up to `max_mm_per_10cm`, inclusive (the last band has no limit); `best_class` is the best class
    that such a fruit may have.
    """

    name: Annotated[str, Field(min_length=1)]
    max_mm_per_10cm: Positive | None = None
    best_class: str


class WeightBand(_Strict):
    """A weight class in grams: from `min_g`, inclusive, to `max_g`, exclusive.

    `shortest_cm` is the least chord of a fruit of this weight for the classes in `shortest_for`.
    """

    name: Annotated[str, Field(min_length=1)]
    min_g: Positive
    max_g: Positive | None = None
    shortest_cm: Positive | None = None
    shortest_for: tuple[str, ...] = ()


class DiameterBand(_Strict):
    """A class by largest diameter in mm: above the band before, up to `max_mm`, inclusive."""

    name: Annotated[str, Field(min_length=1)]
    max_mm: Positive | None = None


class Density(_Strict):
    """Density of the fruit, with its source."""

    kg_m3: Annotated[float, Field(ge=200, le=1400)]
    source: Annotated[str, Field(min_length=1)]


class GrowthFigures(_Strict):
    """Prior of growth for a house without data, in cm a day.

    Parameters
    ----------
    mean, house_sd : float
        Mean growth, and the standard deviation between houses.
    row_sd, fruit_sd : float
        Between the rows of a house, and between the fruit of a row.
    day_sd, fruit_day_sd : float
        Between days, for all fruit of a house together (weather) and for each fruit.
    full_cm : float, optional
        The length at which growth stops, if known: growth falls linearly from half of it on.
    source : str
        Source of the figures.
    """

    mean: Positive
    house_sd: Positive
    row_sd: Positive
    fruit_sd: Positive
    day_sd: Positive
    fruit_day_sd: Positive
    full_cm: Positive | None = None
    source: Annotated[str, Field(min_length=1)]


class CropProfile(_Strict):
    """One crop profile, as in its TOML file.

    Parameters
    ----------
    title : str
        Name of the crop.
    length : {'thread', 'centreline', 'chord'}
        The length that the classes use.
    acceptance : SizeLimits
        Plausible lengths and diameters.
    classes : tuple of LengthClass
        Best first, without gaps or overlaps.
    pick : tuple of str
        The classes that are ready to be picked.
    shape : tuple of ShapeBand
        Straightest first; empty if the crop has no such rule.
    size_rules : {'remark', 'decide'}
        Whether the rules on weight and diameter only add a remark, or decide the class.
    minimum_g, minimum_diameter_mm : float, optional
        Lightest and thinnest fruit that may be sold.
    weights, diameters : tuple
        Further classes; empty if the crop has none.
    cut_cm : float
        Distance of the cut beyond the stem end, cm.
    density : Density
        For the mass from the fitted volume.
    growth : GrowthFigures
        Prior of growth.
    rules : dict of str to str
        The rule or assumption behind 'classes', 'shape', 'minimum_g', 'minimum_diameter_mm',
        'weights' and 'diameters', quoted by a grade.
    """

    title: Annotated[str, Field(min_length=1)]
    length: LengthDefinition = LengthDefinition.CENTRELINE
    acceptance: SizeLimits
    classes: Annotated[tuple[LengthClass, ...], Field(min_length=1)]
    pick: Annotated[tuple[str, ...], Field(min_length=1)]
    shape: tuple[ShapeBand, ...] = ()
    size_rules: Literal["remark", "decide"] = "remark"
    minimum_g: Positive | None = None
    minimum_diameter_mm: Positive | None = None
    weights: tuple[WeightBand, ...] = ()
    diameters: tuple[DiameterBand, ...] = ()
    cut_cm: Positive = 2.0
    density: Density
    growth: GrowthFigures
    rules: dict[str, str] = {}

    @model_validator(mode="after")
    def _agrees(self) -> Self:
        names = [c.name for c in self.classes]
        taken = {*names} & {_TOO_SHORT, TOO_LONG}
        if len({*names}) < len(names) or taken:
            raise ValueError(f"classes: each needs a name of its own, none may be {_TOO_SHORT!r}")
        for lower, upper in pairwise(sorted(self.classes, key=lambda c: c.min_cm)):
            if upper.min_cm != lower.max_cm:
                raise ValueError(
                    f"classes: {lower.name!r} ends at {lower.max_cm:g} cm but {upper.name!r} "
                    f"begins at {upper.min_cm:g} cm; give both the same figure"
                )
        ends = self.edges_m[[0, -1]] * 100
        if ends[0] < self.acceptance.min_cm - 1e-9 or ends[1] > self.acceptance.max_cm + 1e-9:
            raise ValueError("acceptance: it must span every class")
        named = {*self.pick, *(b.best_class for b in self.shape)}
        named |= {name for b in self.weights for name in b.shortest_for}
        if unknown := sorted(named - {*names}):
            raise ValueError(f"no class is called {unknown[0]!r}; there are {', '.join(names)}")
        full = self.growth.full_cm
        if full is not None and full <= ends[1]:
            raise ValueError(f"growth.full_cm {full:g} must be beyond every class")
        _check_order("shape", [b.max_mm_per_10cm for b in self.shape])
        _check_order("weights", [b.max_g for b in self.weights])
        _check_order("diameters", [b.max_mm for b in self.diameters])
        return self

    @property
    def accepted_m(self) -> tuple[float, float]:
        """Shortest and longest plausible length, metres."""
        return self.acceptance.min_cm / 100, self.acceptance.max_cm / 100

    @property
    def accepted_diameter_m(self) -> tuple[float, float]:
        """Least and largest plausible mean diameter, metres."""
        return self.acceptance.min_diameter_cm / 100, self.acceptance.max_diameter_cm / 100

    def mass_g(self, volume_m3: float) -> float:
        """Return the mass of a volume in cubic metres, grams."""
        return 1000 * volume_m3 * self.density.kg_m3

    @property
    def edges_m(self) -> Array:
        """Limits between classes, metres, ascending, float64."""
        cuts = {c.min_cm for c in self.classes} | {c.max_cm for c in self.classes}
        return np.array(sorted(cuts)) / 100

    @property
    def outcomes(self) -> tuple[str, ...]:
        """The classes, best first, followed by 'too short' and 'too long'."""
        return (*(c.name for c in self.classes), _TOO_SHORT, TOO_LONG)

    @property
    def outcome_of_bin(self) -> tuple[int, ...]:
        """Index into `outcomes` of each bin between `edges_m`, including the outer two."""
        by_length = sorted(range(len(self.classes)), key=lambda k: self.classes[k].min_cm)
        return (len(self.classes), *by_length, len(self.classes) + 1)


def _check_order(key: str, limits: list[float | None]) -> None:
    finite_limits = [limit for limit in limits if limit is not None]
    if None in limits[:-1] or finite_limits != sorted(set(finite_limits)):
        raise ValueError(f"{key}: the limits must rise, and only the last may be left out")


PACK_PROFILE = "profile.toml"
"""The profile of a crop's own folder."""

_SHIPPED = Path(__file__).parent / "crops"


@dataclass(frozen=True)
class ProfileEntry:
    """One available profile.

    Parameters
    ----------
    name : str
        The file's name without `.toml`.
    path : Path
        The file.
    shipped : bool
        Whether it is part of the package.
    profile : CropProfile, optional
        The profile; None if it cannot be read.
    fault : str
        Why not.
    """

    name: str
    path: Path
    shipped: bool
    profile: CropProfile | None
    fault: str = ""


def profiles_folder() -> Path:
    """Return the user's profile folder: `CUCUMBERVISION_PROFILES`, or in the user's settings."""
    if chosen := os.environ.get("CUCUMBERVISION_PROFILES"):
        return Path(chosen)
    import platformdirs

    return Path(platformdirs.user_config_dir("cucumbervision", appauthor=False)) / "profiles"


def profiles() -> tuple[ProfileEntry, ...]:
    """Return all profiles, the user's own first; they replace shipped ones of the same name.

    Returns
    -------
    tuple of ProfileEntry
        An unreadable file is listed with its fault.

    Examples
    --------
    >>> [entry.name for entry in profiles() if entry.shipped]
    ['aubergine', 'courgette', 'green-bean', 'long-cucumber', 'mini-cucumber']
    """
    entries: dict[str, ProfileEntry] = {}
    for folder in (profiles_folder(), _SHIPPED):
        for path in sorted(folder.glob("*.toml")):
            entries.setdefault(path.stem, _entry(path, shipped=folder is _SHIPPED))
    return tuple(entries.values())


def load_profile(name_or_path: str | Path) -> CropProfile:
    """Read a crop profile.

    Parameters
    ----------
    name_or_path : str or Path
        A profile's name, a TOML file, or a path (`./courgette`) of a folder with `profile.toml`.

    Raises
    ------
    ProfileError
        If no profile has that name, or the file is invalid.

    Examples
    --------
    >>> profile = load_profile("long-cucumber")
    >>> [(c.name, c.min_cm, c.max_cm) for c in profile.classes]
    [('I', 25.0, 35.0), ('II', 20.0, 25.0)]
    >>> load_profile("gherkin")
    Traceback (most recent call last):
    ...
    cucumbervision.errors.ProfileError: no crop profile is called 'gherkin'; take one of ...
    """
    return _read(profile_path(name_or_path))


def profile_path(name_or_path: str | Path) -> Path:
    """Return the file of a profile. Parameters and errors as those of `load_profile`."""
    text = str(name_or_path)
    if isinstance(name_or_path, Path) or text.endswith(".toml") or Path(text).name != text:
        path = Path(name_or_path)
        return path / PACK_PROFILE if path.is_dir() else path
    for place in (profiles_folder(), _SHIPPED):
        # Compared by name: a text that is no valid file name matches none.
        paths = {path.stem: path for path in place.glob("*.toml")}
        if text in paths:
            return paths[text]
    names = ", ".join(entry.name for entry in profiles())
    raise ProfileError(
        "no crop profile is called {name!r}",
        remedy="take one of {names}, or put your own {text}.toml into {folder}",
        name=text,
        names=names,
        text=text,
        folder=profiles_folder(),
    )


def _entry(path: Path, *, shipped: bool) -> ProfileEntry:
    try:
        return ProfileEntry(path.stem, path, shipped, _read(path))
    except ProfileError as error:
        return ProfileEntry(path.stem, path, shipped, None, str(error))


def _read(path: Path) -> CropProfile:
    text = read_bytes(path, ProfileError, "give a profile's file")
    try:
        data = tomllib.loads(text.decode())
    except (ValueError, RecursionError) as error:
        raise ProfileError(
            "not valid TOML ({reason})", source=path, remedy="correct that line", reason=error
        ) from None
    return parse_model(CropProfile, data, source=path, error=ProfileError)
