"""What a crop profile says: lengths that can be, classes, shape, weights, density and growth.

Profiles are written by people, in the units that people use: centimetres, millimetres, grams.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Literal, Self, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from cucumbervision.measurement.results import Length

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = [
    "TOO_LONG",
    "TOO_SHORT",
    "CropProfile",
    "Density",
    "DiameterBand",
    "GrowthFigures",
    "LengthClass",
    "LengthLimits",
    "ShapeBand",
    "WeightBand",
]

TOO_SHORT, TOO_LONG = "too short", "too long"  # out of grade, and on which side

Positive = Annotated[float, Field(gt=0)]
ModelT = TypeVar("ModelT", bound=BaseModel)


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


class LengthLimits(_Strict):
    """Lengths in cm that this crop can have; anything else is a measuring error."""

    min_cm: Positive
    max_cm: Positive

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        return _min_before_max(self, self.min_cm, self.max_cm)


class LengthClass(_Strict):
    """A class by length: from `min_cm`, inclusive, to `max_cm`, exclusive."""

    name: Annotated[str, Field(min_length=1)]
    min_cm: Positive
    max_cm: Positive

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        return _min_before_max(self, self.min_cm, self.max_cm)


class ShapeBand(_Strict):
    """How crooked, by the inner arc's height in mm for each 10 cm of chord.

    Up to `max_mm_per_10cm`, inclusive (the last band has none), and the best class that such a
    fruit may still have.
    """

    name: Annotated[str, Field(min_length=1)]
    max_mm_per_10cm: Positive | None = None
    best_class: str


class WeightBand(_Strict):
    """A weight class in grams: from `min_g`, inclusive, to `max_g`, exclusive.

    `shortest_cm` is the chord that a fruit of this weight must have for any class that
    `shortest_for` names.
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
    """Mass for each volume of fruit, and where the figure is from."""

    kg_m3: Annotated[float, Field(ge=200, le=1400)]
    source: Annotated[str, Field(min_length=1)]


class GrowthFigures(_Strict):
    """What is believed of growth before this house was seen, in cm a day.

    Parameters
    ----------
    mean, house_sd : float
        Mean growth, and how far the mean of one house may lie from it.
    row_sd, fruit_sd : float
        Between the rows of a house, and between the fruit of a row.
    day_sd, fruit_day_sd : float
        Between days, for all fruit of a house together (weather) and for each by itself.
    full_cm : float, optional
        The length at which growth stops, where it is known; left out, links decide (`curve`).
    source : str
        Where the figures are from.
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
    """One crop, as its TOML file says it.

    Parameters
    ----------
    title : str
        The crop, as people call it.
    length : {'thread', 'centreline', 'chord'}
        Which length the classes are about.
    acceptance : LengthLimits
        Lengths that can be.
    classes : tuple of LengthClass
        Best first; together without gap or overlap.
    pick : tuple of str
        The classes that are ready to be picked.
    shape : tuple of ShapeBand
        Straightest first; empty where the crop has no such rule.
    size_rules : {'remark', 'decide'}
        Whether the rules on weight and diameter are only said beside a class, or decide on it.
    minimum_g, minimum_diameter_mm : float, optional
        Lightest and thinnest fruit that may be sold.
    weights, diameters : tuple
        Further classes; empty where the crop has none.
    density : Density
        For the mass from the fitted volume.
    growth : GrowthFigures
        What is believed of growth beforehand.
    rules : dict of str to str
        The rule or assumption behind 'classes', 'shape', 'minimum_g', 'minimum_diameter_mm',
        'weights' and 'diameters': a grade quotes it.
    """

    title: Annotated[str, Field(min_length=1)]
    length: Length = Length.THREAD
    acceptance: LengthLimits
    classes: Annotated[tuple[LengthClass, ...], Field(min_length=1)]
    pick: Annotated[tuple[str, ...], Field(min_length=1)]
    shape: tuple[ShapeBand, ...] = ()
    size_rules: Literal["remark", "decide"] = "remark"
    minimum_g: Positive | None = None
    minimum_diameter_mm: Positive | None = None
    weights: tuple[WeightBand, ...] = ()
    diameters: tuple[DiameterBand, ...] = ()
    density: Density
    growth: GrowthFigures
    rules: dict[str, str] = {}

    @model_validator(mode="after")
    def _agrees(self) -> Self:
        names = [c.name for c in self.classes]
        taken = {*names} & {TOO_SHORT, TOO_LONG}
        if len({*names}) < len(names) or taken:
            raise ValueError(f"classes: each needs a name of its own, none may be {TOO_SHORT!r}")
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
    def edges_m(self) -> NDArray[np.float64]:
        """Where one class ends and the next begins, metres, ascending, float64."""
        cuts = {c.min_cm for c in self.classes} | {c.max_cm for c in self.classes}
        return np.array(sorted(cuts)) / 100

    @property
    def outcomes(self) -> tuple[str, ...]:
        """The classes, best first, then the two ways to be out of grade."""
        return (*(c.name for c in self.classes), TOO_SHORT, TOO_LONG)

    @property
    def outcome_of_bin(self) -> tuple[int, ...]:
        """Index into `outcomes` of the bins between `edges_m`, the outer two included."""
        by_length = sorted(range(len(self.classes)), key=lambda k: self.classes[k].min_cm)
        return (len(self.classes), *by_length, len(self.classes) + 1)


def _min_before_max(entry: ModelT, lowest: float, highest: float) -> ModelT:
    if lowest >= highest:
        raise ValueError(f"min_cm {lowest:g} must be less than max_cm {highest:g}")
    return entry


def _check_order(key: str, limits: list[float | None]) -> None:
    known = [limit for limit in limits if limit is not None]
    if None in limits[:-1] or known != sorted(set(known)):
        raise ValueError(f"{key}: the limits must rise, and only the last may be left out")
