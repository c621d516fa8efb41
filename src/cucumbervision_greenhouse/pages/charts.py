"""Charts of a round: lengths by class, the forecast by day, and days of a house."""

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

from cucumbervision.crop.grades import class_name
from cucumbervision_greenhouse.fruit_pictures import CLASS_GREENS, OTHER_COLORS
from cucumbervision_greenhouse.language import date_names, day_month_words
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.theme import ink
from cucumbervision_greenhouse.words import class_words, expected_classes, forecast_day, label_words

if TYPE_CHECKING:
    from collections.abc import Iterable

    from cucumbervision_greenhouse.forecast.forecast import Forecast
    from cucumbervision_greenhouse.settings import Units

# Checking each chart against Altair's schema takes longer than all other work of a page, and Vega
# reports faults itself. For the same reason channels are named instead of parsed from strings.
disable_debug_mode()

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


def _readable(chart: Any, height_px: int) -> Any:
    """Return a chart with its words in the colour of the page's text, to be read in the sun."""
    color = _ink()
    chart = chart.properties(height=height_px)
    chart = chart.configure_axis(labelColor=color, titleColor=color)
    return chart.configure_legend(labelColor=color)


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
    chart: alt.LayerChart = _readable(band + bars + line, 260)
    return chart


def _data(lines: list[dict[str, Any]]) -> Any:
    # Sent as a table, since values within the chart's description are slow.
    return pa.Table.from_pylist(lines)


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
    chart: alt.LayerChart = _readable(bars + whiskers, 320)
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
    bars = (
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
    )
    chart: alt.Chart = _readable(bars, 260)
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
        tooltip=[alt.Tooltip("when:N", title=_("Day")), alt.Tooltip("length:Q", title=title)],
    )
    whiskers = base.mark_rule(color=_ink()).encode(y=alt.Y("low:Q", title=title), y2="high:Q")
    chart: alt.LayerChart = _readable(whiskers + points, 220)
    return chart
