"""The map of a row: where its fruit hang, as layers of a picture."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from cucumbervision_greenhouse.fruit_pictures import OTHER_COLORS, class_color
from cucumbervision_greenhouse.language import decimal_words
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.words import label_words

if TYPE_CHECKING:
    from cucumbervision_greenhouse.settings import Units

MAP_PX = 1000, 560
"""Width and height of a row's map, in its own pixels."""

_MAP_EDGE_PX = 50
# From viridis: lighter with increasing length.
_STEP_COLORS = ("#440154", "#414487", "#2a788e", "#22a884", "#7ad151", "#fde725")


def map_picture(
    lines: list[dict[str, Any]], all_lines: list[dict[str, Any]], units: Units, *, by_length: bool
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the fruit of one row and side as layers of a picture of `MAP_PX`, and its grid.

    Parameters
    ----------
    lines : list of dict
        The fruit, as `round_tables.map_lines` gives them.
    all_lines : list of dict
        All that are shown, which the scales fit.
    by_length : bool
        A layer for every step of the length; else one a class.

    Returns
    -------
    layers : list of dict
        As `page_elements.picture` takes them, with 'marks': of each fruit x and y, key, words,
        kind of mark, and whether it was seen once.
    grid : dict
        Lines 'across' and 'up' with their words.
    """
    ends = {name: _ends(all_lines, name) for name in ("along", "height")}

    def place(name: str, value: float) -> float:
        (start, end), size = ends[name], MAP_PX[name == "height"]
        share = (value - start) / max(end - start, 0.1)
        across = _MAP_EDGE_PX + share * (size - 2 * _MAP_EDGE_PX)
        return round(size - across if name == "height" else across, 1)

    by_class = {name: _class(name) for name in {line["class"] for line in lines}}
    layers: dict[str, dict[str, Any]] = {}
    for line in sorted(lines, key=lambda line: line["length"] or 0.0):
        name, color = _length_step(line["length"], units) if by_length else by_class[line["class"]]
        layer = layers.setdefault(
            name, {"name": name, "color": color, "on": True, "shapes": [], "marks": []}
        )
        # Without names: a round has thousands of them.
        at = place("along", line["along"]), place("height", line["height"])
        layer["marks"].append((*at, line["key"], line["says"], line["mark"], line["views"] == 1))
    grid = {
        name: [
            (place(axis, value), f"{decimal_words(f'{value:g}')} {units.along[0]}")
            for value in _round_values(*ends[axis])
        ]
        for name, axis in (("across", "along"), ("up", "height"))
    }
    return list(layers.values()), grid


def _class(name: str) -> tuple[str, str]:
    return label_words(name), class_color(name)


def _length_step(length: float | None, units: Units) -> tuple[str, str]:
    """Return the name and colour of the step of 5 cm or 2 inches that a length is in."""
    if length is None:
        return _("not measured"), OTHER_COLORS["not measured"]
    step = 5 if units.name == "cm" else 2
    number = int(length // step)
    high = f"{(number + 1) * step} {units.name}"
    name = _("{low} to {high}").format(low=number * step, high=high)
    return name, _STEP_COLORS[min(max(number - 1, 0), len(_STEP_COLORS) - 1)]


def _round_values(first_value: float, last_value: float) -> list[float]:
    """Return round values between two ends, at most ten.

    Examples
    --------
    >>> _round_values(-0.31, 0.42), _round_values(0.2, 23.9)
    ([-0.2, 0.0, 0.2, 0.4], [5.0, 10.0, 15.0, 20.0])
    """
    steps = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
    step = next((s for s in steps if (last_value - first_value) / s <= 5), 100.0)
    first, last = math.ceil(first_value / step), math.floor(last_value / step)
    return [round(k * step, 1) for k in range(first, last + 1)]


def _ends(lines: list[dict[str, Any]], name: str) -> tuple[float, float]:
    values = [float(line[name]) for line in lines if line[name] is not None] or [0.0]
    return min(values), max(values)
