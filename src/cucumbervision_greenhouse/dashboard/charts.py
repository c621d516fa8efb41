"""Charts of a round: lengths by class and by method, the map of a row, the forecast by day."""

from __future__ import annotations

import json
import math
from collections import Counter
from datetime import date, datetime
from typing import TYPE_CHECKING, Any

import altair as alt
import numpy as np
import pyarrow as pa
import streamlit as st
from altair.utils.schemapi import disable_debug_mode

from cucumbervision.agronomy.classes import class_name
from cucumbervision_greenhouse.backend.fruit_pictures import CLASS_GREENS, OTHER_COLORS, class_color
from cucumbervision_greenhouse.backend.fruit_words import class_words, label_words
from cucumbervision_greenhouse.backend.language import date_names, day_month_words, decimal_words
from cucumbervision_greenhouse.backend.language import gettext as _
from cucumbervision_greenhouse.backend.round_words import date_words
from cucumbervision_greenhouse.backend.theme import ink
from cucumbervision_greenhouse.rounds.forecasting import date_after
from cucumbervision_greenhouse.rounds.merge_and_link import DAY_S

if TYPE_CHECKING:
    from collections.abc import Iterable

    from cucumbervision_greenhouse.agronomy.forecast import Forecast
    from cucumbervision_greenhouse.backend.settings import Units

# Checking each chart against Altair's schema takes longer than all other work of a page, and Vega
# reports faults itself. For the same reason channels are named instead of parsed from strings.
disable_debug_mode()

MAP_PX = 1000, 560
"""Width and height of a row's map, in its own pixels."""

_MAP_EDGE_PX = 50
# From viridis: lighter with increasing length.
_STEP_COLORS = ("#440154", "#414487", "#2a788e", "#22a884", "#7ad151", "#fde725")


_WEEKDAYS = 14  # days that have room for their weekday
_MANY = 40  # number of fruit from which narrow bars are informative


def _class_colors(names: Iterable[str]) -> alt.Scale:
    """Return a scale with a colour for each class: classes in greens, the best darkest and first.

    Examples
    --------
    >>> _class_colors(["too long", "class I", "class I"]).to_dict()
    {'domain': ['class I', 'too long'], 'range': ['#1B7837', '#D55E00']}
    """
    present = set(names)
    classes = sorted(present - set(OTHER_COLORS))  # 'class I' before 'class II'
    other_names = [name for name in OTHER_COLORS if name in present]
    greens = [CLASS_GREENS[min(k, len(CLASS_GREENS) - 1)] for k in range(len(classes))]
    return alt.Scale(
        domain=[label_words(name) for name in (*classes, *other_names)],
        range=[*greens, *(OTHER_COLORS[name] for name in other_names)],
    )


_BELOW = alt.Legend(orient="bottom", columns=3)  # where a phone has space for it


def _ink() -> str:
    """Return the colour of lines that are seen in the viewer's theme."""
    return ink(st.context.theme.type)


def _color_of_class(names: Iterable[str]) -> alt.Color:
    return alt.Color("class:N", scale=_class_colors(names), title=None, legend=_BELOW)


def histogram(lines: list[dict[str, Any]], units: Units) -> alt.LayerChart:
    """Return a histogram by class, with a line at the mean and a band of one standard deviation."""
    step = (1.0 if len(lines) >= _MANY else 2.0) / (1 if units.name == "cm" else 2)
    lengths = np.array([line["length"] for line in lines], np.float64)
    mean, sd = float(lengths.mean()), float(lengths.std(ddof=1)) if len(lengths) > 1 else 0.0
    # Counted here, so that the browser gets a few dozen bars whatever the number of fruit.
    counted = Counter((math.floor(line["length"] / step), line["class"]) for line in lines)
    table = [
        {"from": k * step, "to": (k + 1) * step, "class": label_words(name), "fruit": number}
        for (k, name), number in sorted(counted.items())
    ]
    bars = (
        alt.Chart(_data(table))
        .mark_bar(stroke="white")
        .encode(
            x=alt.X(
                "from:Q",
                bin="binned",
                title=_("Length [{unit}]").format(unit=units.name),
                scale=alt.Scale(zero=False),
            ),
            x2=alt.X2("to:Q"),
            y=alt.Y("fruit:Q", title=_("Fruit"), axis=alt.Axis(tickMinStep=1, format="d")),
            color=_color_of_class(x["class"] for x in lines),
            tooltip=[
                alt.Tooltip("fruit:Q", title=_("Fruit")),
                alt.Tooltip("class:N", title=_("Class")),
            ],
        )
    )
    spread = _data([{"low": mean - sd, "high": mean + sd, "mean": mean}])
    band = (
        alt.Chart(spread)
        .mark_rect(opacity=0.12, color=_ink())
        .encode(x=alt.X("low:Q"), x2=alt.X2("high:Q"))
    )
    line = alt.Chart(spread).mark_rule(color=_ink(), strokeWidth=2).encode(x=alt.X("mean:Q"))
    chart: alt.LayerChart = (band + bars + line).properties(height=260)
    return chart


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
    """
    ends = {name: _ends(all_lines, name) for name in ("along", "height")}

    def place(name: str, value: float) -> float:
        (start, end), size = ends[name], MAP_PX[name == "height"]
        share = (value - start) / max(end - start, 0.1)
        across = _MAP_EDGE_PX + share * (size - 2 * _MAP_EDGE_PX)
        return round(size - across if name == "height" else across, 1)

    layers: dict[str, dict[str, Any]] = {}
    for line in sorted(lines, key=lambda line: line["length"] or 0.0):
        name, color = _length_step(line["length"], units) if by_length else _class(line["class"])
        layer = layers.setdefault(name, {"name": name, "color": color, "on": True, "shapes": []})
        mark = {
            "kind": "mark",
            "points": [place("along", line["along"]), place("height", line["height"])],
            "key": line["key"],
            "mark": line["mark"],
            "once": line["views"] == 1,
            "says": line["says"],
        }
        layer["shapes"].append(mark)
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


def _data(lines: list[dict[str, Any]]) -> Any:
    # Sent as a table, since values within the chart's description are slow.
    return pa.Table.from_pylist(lines)


def _ends(lines: list[dict[str, Any]], name: str) -> tuple[float, float]:
    values = [float(line[name]) for line in lines if line[name] is not None] or [0.0]
    return min(values), max(values)


def forecast_chart(prediction: Forecast) -> alt.LayerChart:
    """Return the expected number in each class on each day, with its interval."""
    drawn = expected_classes(prediction)
    share = 0.8 / max(len(drawn), 1)  # of a day, which is 1 wide
    lines = [
        {
            "day": forecast_day(prediction, day),
            "class": class_words(prediction.classes[k]),
            "from": day - 0.4 + n * share,
            "to": day - 0.4 + (n + 0.85) * share,
            "middle": day - 0.4 + (n + 0.425) * share,
            "floor": 0.0,
            "expected": float(prediction.house.expected[day, k]),
            "low": float(prediction.house.low[day, k]),
            "high": float(prediction.house.high[day, k]),
        }
        for day in prediction.days.tolist()
        for n, k in enumerate(drawn)
    ]
    names = [class_name(prediction.classes[k]) for k in drawn]
    days = prediction.days.tolist()
    label_expression = (
        " : ".join(f"datum.value == {day} ? '{forecast_day(prediction, day)}'" for day in days)
        + " : ''"
    )
    axis = alt.Axis(
        values=days, labelExpr=label_expression, labelAngle=0, labelOverlap=True, grid=False
    )
    ends = alt.Scale(domain=[-0.5, days[-1] + 0.5], nice=False)
    base = alt.Chart(_data(lines))
    bars = base.mark_bar().encode(
        x=alt.X("from:Q", title=_("Day"), axis=axis, scale=ends),
        x2=alt.X2("to:Q"),
        y=alt.Y("expected:Q", title=_("Fruit")),
        y2=alt.Y2("floor:Q"),
        color=_color_of_class(names),
        tooltip=[
            alt.Tooltip("day:N", title=_("Day")),
            alt.Tooltip("class:N", title=_("Class")),
            alt.Tooltip("expected:Q", title=_("Expected"), format=".0f"),
            alt.Tooltip("low:Q", title=_("Likely from"), format=".0f"),
            alt.Tooltip("high:Q", title=_("to"), format=".0f"),
        ],
    )
    whiskers = base.mark_rule(strokeWidth=2, color=_ink()).encode(
        x=alt.X("middle:Q"), y=alt.Y("low:Q"), y2=alt.Y2("high:Q")
    )
    chart: alt.LayerChart = (bars + whiskers).properties(height=320)
    return chart


def trend_chart(lines: list[dict[str, Any]]) -> alt.Chart:
    """Return the fruit of each day, by class; days without a round stay empty.

    Parameters
    ----------
    lines : list of dict
        'day' (ISO 8601), 'class' and 'fruit'.
    """
    days = {line["day"] for line in lines}
    names = [line["class"] for line in lines]
    lines = [{**line, "class": label_words(line["class"])} for line in lines]
    for line in lines:
        line["when"] = day_month_words(date.fromisoformat(line["day"]))
        line["day"] += "T00:00"  # browsers read a date alone as one in UTC
    axis = _day_axis(weekday=len(days) <= _WEEKDAYS)
    chart: alt.Chart = (
        alt.Chart(_data(lines))
        .mark_bar()
        .encode(
            x=alt.X("day:T", timeUnit="yearmonthdate", title=None, axis=axis),
            y=alt.Y("fruit:Q", title=_("Fruit"), axis=alt.Axis(format="d")),
            color=_color_of_class(names),
            tooltip=[
                alt.Tooltip("when:N", title=_("Day")),
                alt.Tooltip("class:N", title=_("Class")),
                alt.Tooltip("fruit:Q", title=_("Fruit")),
            ],
        )
        .properties(height=260)
    )
    return chart


def _day_axis(*, weekday: bool = True, **options: Any) -> alt.Axis:
    """Return an axis of days in the language that is shown, which Vega does not know."""
    weekdays, months = map(json.dumps, date_names())
    words = f"date(datum.value) + ' ' + {months}[month(datum.value)]"
    if weekday:
        words = f"{weekdays}[day(datum.value)] + ' ' + {words}"
    return alt.Axis(labelExpr=words, labelOverlap=True, **options)


def growth_chart(lines: list[dict[str, Any]], units: Units) -> alt.LayerChart:
    """Return the length of one fruit on its days, with intervals.

    Parameters
    ----------
    lines : list of dict
        'at' (ISO 8601), 'length', 'low' and 'high'; the last two may be None.
    units : Units
        Unit of the lengths.
    """
    title = _("Length [{unit}]").format(unit=units.name)
    lines = [
        {**line, "when": day_month_words(datetime.fromisoformat(line["at"]))} for line in lines
    ]
    axis = _day_axis(tickCount="day")
    base = alt.Chart(_data(lines)).encode(x=alt.X("at:T", title=None, axis=axis))
    point = alt.OverlayMarkDef(color=CLASS_GREENS[0], size=80)
    points = base.mark_line(point=point, color=CLASS_GREENS[0]).encode(
        y=alt.Y("length:Q", title=title, scale=alt.Scale(zero=False)),
        tooltip=[
            alt.Tooltip("when:N", title=_("Day")),
            alt.Tooltip("length:Q", title=title),
        ],
    )
    whiskers = base.mark_rule(color=_ink()).encode(y=alt.Y("low:Q", title=title), y2="high:Q")
    chart: alt.LayerChart = (whiskers + points).properties(height=220)
    return chart


def forecast_day(prediction: Forecast, day: int) -> str:
    """Return the name of a day of a forecast, counted from its day 0."""
    return date_words(date_after(prediction.today * DAY_S, day), date.today())


def first_days(prediction: Forecast) -> dict[str, int]:
    """Return the first day on which a fruit is expected in each class that is picked."""
    first = {}
    for k, name in enumerate(prediction.classes):
        (days,) = np.nonzero(prediction.house.expected[:, k] >= 1)
        if name in prediction.pick and len(days):
            first[name] = int(prediction.days[days[0]])
    return first


def expected_classes(prediction: Forecast) -> list[int]:
    """Return which classes any fruit may be in on any of the days."""
    return [k for k in range(len(prediction.classes)) if prediction.house.high[:, k].max() >= 1]
