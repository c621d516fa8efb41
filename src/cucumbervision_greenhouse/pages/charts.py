"""Charts of a round: lengths by class, the forecast by day, and days of a house."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from datetime import date, timedelta
from typing import Any

import altair as alt
import numpy as np
import pyarrow as pa
import streamlit as st
from altair.utils.schemapi import disable_debug_mode

from cucumbervision.crop.grades import class_name
from cucumbervision_greenhouse import words as texts
from cucumbervision_greenhouse.forecast.forecast import Forecast
from cucumbervision_greenhouse.forecast.picking import Span
from cucumbervision_greenhouse.fruit_pictures import CLASS_GREENS, OTHER_COLORS
from cucumbervision_greenhouse.language import day_month_words
from cucumbervision_greenhouse.language import gettext as _
from cucumbervision_greenhouse.settings import Units
from cucumbervision_greenhouse.store.records import FruitRow
from cucumbervision_greenhouse.theme import ink

# Checking each chart against Altair's schema takes longer than all other work of a page, and Vega
# reports faults itself.
disable_debug_mode()

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
        domain=[texts.label_words(name) for name in (*classes, *other_names)],
        range=[*greens, *(OTHER_COLORS[name] for name in other_names)],
    )


def _ink() -> str:
    """Return the colour of lines that are seen in the viewer's theme."""
    return ink(st.context.theme.type)


def _bars(lines: list[dict[str, Any]], y: Any, **encoding: Any) -> Any:
    """Return bars in the colours of the classes, which `lines` name by their labels."""
    names = [line["class"] for line in lines]
    table = [{**line, "class": texts.label_words(line["class"])} for line in lines]
    below = alt.Legend(orient="bottom", columns=3)  # where a phone has space for it
    color = alt.Color("class:N", scale=_class_colors(names), title=None, legend=below)
    return _chart(table).mark_bar(stroke="white").encode(y=y, color=color, **encoding)


def _counted(name: str) -> alt.Y:
    return alt.Y(f"{name}:Q", title=_("Fruit"), axis=alt.Axis(tickMinStep=1, format="d"))


def _days(name: str, days: Iterable[date]) -> alt.X:
    """Return an axis of all days between some, in the language that is shown."""
    first, last = min(days), max(days)
    words = [day_month_words(first + timedelta(k)) for k in range((last - first).days + 1)]
    axis = alt.Axis(labelOverlap=True, labelAngle=0)
    return alt.X(f"{name}:O", title=None, scale=alt.Scale(domain=words), axis=axis)


def _tips(**titles: str) -> list[alt.Tooltip]:
    return [alt.Tooltip(f"{name}:N", title=title) for name, title in titles.items()]


def _chart(lines: list[dict[str, Any]]) -> alt.Chart:
    # Sent as a table, since values within the chart's description are slow.
    return alt.Chart(pa.Table.from_pylist(lines))


def _readable(chart: Any, height_px: int) -> Any:
    """Return a chart with its words in the colour of the page's text, to be read in the sun."""
    color = {"labelColor": _ink(), "titleColor": _ink()}
    return chart.properties(height=height_px).configure_axis(**color).configure_legend(**color)


def histogram(lines: list[dict[str, Any]], units: Units) -> Any:
    """Return a histogram by class, with a line at the mean and a band of one standard deviation."""
    step = (1.0 if len(lines) >= _MANY else 2.0) / (1 if units.name == "cm" else 2)
    lengths = np.array([line["length"] for line in lines], np.float64)
    mean, sd = float(lengths.mean()), float(lengths.std(ddof=1)) if len(lengths) > 1 else 0.0
    # Counted here, so that the browser gets a few dozen bars whatever the number of fruit.
    counted = Counter((math.floor(line["length"] / step), line["class"]) for line in lines)
    table = [
        {"from": k * step, "to": (k + 1) * step, "class": name, "fruit": number}
        for (k, name), number in sorted(counted.items())
    ]
    title, scale = _("Length [{unit}]").format(unit=units.name), alt.Scale(zero=False)
    x = alt.X("from:Q", bin="binned", title=title, scale=scale)
    tips = _tips(**{"fruit": _("Fruit"), "class": _("Class")})
    bars = _bars(table, _counted("fruit"), x=x, x2="to:Q", tooltip=tips)
    spread = _chart([{"low": mean - sd, "high": mean + sd, "mean": mean}])
    band = spread.mark_rect(opacity=0.12, color=_ink()).encode(x="low:Q", x2="high:Q")
    line = spread.mark_rule(color=_ink(), strokeWidth=2).encode(x="mean:Q")
    return _readable(band + bars + line, 260)


def forecast_chart(prediction: Forecast) -> Any:
    """Return the expected number in each class on each day, with its interval."""
    drawn, house, lines = texts.expected_classes(prediction), prediction.house, []
    labels = {k: class_name(prediction.classes[k]) for k in drawn}
    for day in prediction.days.tolist():
        for k in drawn:
            span = Span(*(float(x[day, k]) for x in (house.expected, house.low, house.high)))
            words = {"day": texts.forecast_day(prediction, day), "class": labels[k]}
            lines.append({**words, **vars(span), "likely": texts.span_words(span)})
    axis = alt.Axis(labelAngle=0, labelOverlap=True)
    place = {
        "x": alt.X("day:O", title=_("Day"), sort=None, axis=axis),
        "xOffset": alt.XOffset("class:N", sort=[texts.label_words(x) for x in labels.values()]),
    }
    tips = _tips(**{"day": _("Day"), "class": _("Class"), "likely": _("Expected")})
    bars = _bars(lines, alt.Y("expected:Q", title=_("Fruit")), tooltip=tips, **place)
    whiskers = alt.Chart(bars.data).mark_rule(strokeWidth=2, color=_ink())
    return _readable(bars + whiskers.encode(y="low:Q", y2="high:Q", **place), 320)


def trend_chart(lines: list[dict[str, Any]]) -> Any:
    """Return the fruit of each day, by class; days without a round stay empty.

    Parameters
    ----------
    lines : list of dict
        'day' (ISO 8601), 'class' and 'fruit'.
    """
    days = [date.fromisoformat(line["day"]) for line in lines]
    table = [{**x, "day": day_month_words(d)} for x, d in zip(lines, days, strict=True)]
    tips = _tips(**{"day": _("Day"), "class": _("Class"), "fruit": _("Fruit")})
    return _readable(_bars(table, _counted("fruit"), x=_days("day", days), tooltip=tips), 260)


def growth_chart(views: Iterable[FruitRow], units: Units) -> Any:
    """Return the length of one fruit on its days, with intervals, in a unit of lengths."""
    measured = [(view.taken_s, view.length) for view in views if view.length is not None]
    days = [date.fromtimestamp(taken_s) for taken_s, _length in measured]
    lines = [
        {"day": day_month_words(day)}
        | {name: units.value(getattr(length, f"{name}_m")) for name in ("value", "low", "high")}
        for day, (_taken_s, length) in zip(days, measured, strict=True)
    ]
    title = _("Length [{unit}]").format(unit=units.name)
    y = alt.Y("value:Q", title=title, scale=alt.Scale(zero=False))
    base = _chart(lines).encode(x=_days("day", days), tooltip=_tips(day=_("Day"), value=title))
    points = base.mark_line(point=alt.OverlayMarkDef(size=80), color=CLASS_GREENS[0]).encode(y=y)
    whiskers = base.mark_rule(color=_ink()).encode(y=alt.Y("low:Q", title=title), y2="high:Q")
    return _readable(whiskers + points, 220)
