"""Charts of a round: lengths, methods, map, forecast."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import altair as alt
import numpy as np
import pandas as pd

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cucumbervision.agronomy.forecast import Forecast
    from cucumbervision.dashboard.units import Units

__all__ = ["class_colors", "day_name", "forecast_chart", "histogram", "map_chart", "method_chart"]

MANY = 40  # fruit from which narrow bars say more than they scatter
GREENS = ("#1B7837", "#5AAE61", "#A6DBA0")
OTHERS = {
    "out of grade": "#E69F00",
    "too short": "#56B4E9",
    "too long": "#D55E00",
    "not graded": "#999999",
}


def class_colors(names: Sequence[str]) -> alt.Scale:
    """Give each class its colour: greens for classes, best darkest, others told apart.

    Examples
    --------
    >>> class_colors(["class I", "out of grade"]).range
    ['#1B7837', '#E69F00']
    """
    classes = [name for name in names if name not in OTHERS]
    colors = {name: GREENS[min(k, len(GREENS) - 1)] for k, name in enumerate(classes)}
    return alt.Scale(domain=list(names), range=[{**OTHERS, **colors}[name] for name in names])


def day_name(day: int) -> str:
    """Name a day by its distance from today.

    Examples
    --------
    >>> day_name(0), day_name(1), day_name(2)
    ('today', 'tomorrow', 'in 2 days')
    """
    return ("today", "tomorrow")[day] if day < 2 else f"in {day} days"


def histogram(lines: list[dict[str, Any]], classes: Sequence[str], units: Units) -> alt.LayerChart:
    """Draw lengths by class, with a line at the mean and a band of one standard deviation."""
    step = (1.0 if len(lines) >= MANY else 2.5) / (1 if units.name == "cm" else 2.5)
    table = pd.DataFrame(lines)
    mean, sd = float(table["length"].mean()), float(np.nan_to_num(table["length"].std()))
    bars = (
        alt.Chart(table)
        .mark_bar()
        .encode(
            x=alt.X(
                "length:Q",
                bin=alt.Bin(step=step),
                title=f"Length [{units.name}]",
                scale=alt.Scale(zero=False),
            ),
            y=alt.Y("count()", title="Fruit", axis=alt.Axis(tickMinStep=1, format="d")),
            color=alt.Color("class:N", scale=class_colors(classes), title=None),
            tooltip=[alt.Tooltip("count()", title="Fruit"), alt.Tooltip("class:N", title="Class")],
        )
    )
    spread = pd.DataFrame([{"low": mean - sd, "high": mean + sd, "mean": mean}])
    band = alt.Chart(spread).mark_rect(opacity=0.12, color="#000").encode(x="low:Q", x2="high:Q")
    line = alt.Chart(spread).mark_rule(color="#000", strokeWidth=2).encode(x="mean:Q")
    return (band + bars + line).properties(height=260)


def method_chart(lines: list[dict[str, Any]], units: Units) -> alt.Chart:
    """Draw each method's lengths as boxes over their range."""
    return (
        alt.Chart(pd.DataFrame(lines))
        .mark_boxplot(extent="min-max", size=18, color="#5AAE61")
        .encode(
            x=alt.X("length:Q", title=f"Length [{units.name}]", scale=alt.Scale(zero=False)),
            y=alt.Y("method:N", title=None),
        )
        .properties(height=260)
    )


def map_chart(
    lines: list[dict[str, Any]], classes: Sequence[str], units: Units, by_length: bool
) -> alt.FacetChart:
    """Draw fruit by position and height, a strip for each row and side."""
    color = (
        alt.Color(
            "length:Q",
            title=f"Length [{units.name}]",
            scale=alt.Scale(scheme="viridis"),
        )
        if by_length
        else alt.Color("class:N", scale=class_colors(classes), title=None)
    )
    tooltip = [
        alt.Tooltip("length:Q", title=f"Length [{units.name}]", format=f".{units.digits}f"),
        alt.Tooltip("class:N", title="Class"),
        alt.Tooltip("along:Q", title="Along the row [m]", format=".2f"),
        alt.Tooltip("height:Q", title="Above the camera [m]", format=".2f"),
        alt.Tooltip("views:Q", title="Seen from stops"),
        alt.Tooltip("capture:N", title="Capture"),
    ]
    points = (
        alt.Chart(pd.DataFrame(lines))
        .mark_point(filled=True, size=90, opacity=0.85)
        .encode(
            x=alt.X("along:Q", title="Along the row [m]", scale=alt.Scale(zero=False)),
            y=alt.Y("height:Q", title="Above the camera [m]", scale=alt.Scale(zero=False)),
            color=color,
            shape=alt.Shape(
                "picked:N",
                scale=alt.Scale(domain=[False, True], range=["circle", "cross"]),
                legend=None,
            ),
            tooltip=tooltip,
        )
        .properties(height=170, width="container")
    )
    return points.facet(row=alt.Row("row:N", title=None, header=alt.Header(labelFontSize=14)))


def forecast_chart(found: Forecast) -> alt.LayerChart:
    """Draw the expected number in each class on each day, with its interval."""
    lines = [
        {
            "day": day_name(day),
            "class": _named(found, k),
            "expected": float(found.house.expected[day, k]),
            "low": float(found.house.low[day, k]),
            "high": float(found.house.high[day, k]),
        }
        for day in found.days.tolist()
        for k in range(len(found.classes))
    ]
    table = pd.DataFrame(lines)
    names = [_named(found, k) for k in range(len(found.classes))]
    order = list(dict.fromkeys(table["day"]))
    base = alt.Chart(table).encode(
        x=alt.X("day:N", sort=order, title="Day", axis=alt.Axis(labelAngle=0)),
        xOffset=alt.XOffset("class:N", sort=names),
        color=alt.Color("class:N", scale=class_colors(names), title=None),
    )
    bars = base.mark_bar().encode(
        y=alt.Y("expected:Q", title="Fruit"),
        tooltip=[
            alt.Tooltip("day:N", title="Day"),
            alt.Tooltip("class:N", title="Class"),
            alt.Tooltip("expected:Q", title="Expected", format=".0f"),
            alt.Tooltip("low:Q", title="80 %: from", format=".0f"),
            alt.Tooltip("high:Q", title="to", format=".0f"),
        ],
    )
    whiskers = base.mark_rule().encode(
        y="low:Q",
        y2="high:Q",
        xOffset=alt.XOffset("class:N", sort=names, bandPosition=0.5),
        color=alt.value("#222"),
        strokeWidth=alt.value(2),
    )
    return (bars + whiskers).properties(height=320)


def _named(found: Forecast, k: int) -> str:
    name = found.classes[k]
    return name if name in OTHERS else f"class {name}"
