"""A round as the pages show it: its fruit with their grades, statistics, tables and charts."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import altair as alt
import numpy as np
import pyarrow as pa

from cucumbervision.agronomy.grades import Verdict as GradeVerdict
from cucumbervision.pipeline.fields import FIELDS
from cucumbervision.rounds.forecasting import grade_of
from cucumbervision.store.views import Verdict

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from cucumbervision.agronomy.forecast import Forecast
    from cucumbervision.agronomy.grades import Grade
    from cucumbervision.agronomy.profiles import CropProfile
    from cucumbervision.dashboard.settings import Units
    from cucumbervision.store.records import DetectionRecord, MethodRecord
    from cucumbervision.store.repository import Store
    from cucumbervision.store.views import DetectionView

__all__ = [
    "RoundLists",
    "class_colors",
    "class_name",
    "day_name",
    "figure_lines",
    "forecast_chart",
    "grade_name",
    "histogram",
    "length_lines",
    "map_chart",
    "map_lines",
    "method_chart",
    "method_lines",
    "read_lists",
    "statistics",
]


@dataclass(frozen=True, eq=False)
class RoundLists:
    """A round as the pages show it.

    Parameters
    ----------
    fruit : tuple of DetectionView
        Each fruit once: the view that stands.
    grades : dict of str to Grade
        By fruit key.
    methods : dict of str to tuple of MethodRecord
        By fruit key, without paths.
    detections : int
        How many detections the fruit are made of.
    """

    fruit: tuple[DetectionView, ...]
    grades: Mapping[str, Grade]
    methods: Mapping[str, tuple[MethodRecord, ...]]
    detections: int


def read_lists(store: Store, round_key: str, profile: CropProfile) -> RoundLists:
    """Return a round's fruit with their grades."""
    every = store.detections(round_key)
    fruit = tuple(view for view in every if view.best)
    grades = {view.key: grade_of(view.record, profile) for view in fruit}
    return RoundLists(fruit, grades, store.measurements(round_key), len(every))


def grade_name(grade: Grade) -> str:
    """Return a grade in a word or two: 'class I', 'out of grade', 'not graded'.

    Examples
    --------
    >>> from cucumbervision.agronomy.grades import GradingTraits, grade
    >>> from cucumbervision.agronomy.profiles import load_profile
    >>> grade_name(grade(GradingTraits(thread_m=0.26), load_profile("long-cucumber")))
    'class I'
    """
    if grade.verdict in (GradeVerdict.REFUSED, GradeVerdict.MISSING):
        return "not graded"
    return grade.name if grade.name == "out of grade" else f"class {grade.name}"


def statistics(lists: RoundLists) -> dict[str, float | int | None]:
    """Compute numbers of fruit, mean and spread of lengths in metres; rejected fruit are left out.

    Returns
    -------
    dict
        'fruit', 'measured', 'rejected', 'picked', 'detections', 'mean_m', 'sd_m'.
    """
    kept = [view for view in lists.fruit if view.verdict is not Verdict.REJECTED]
    lengths = np.array([v.record.length_m for v in kept if v.record.length_m is not None])
    many = len(lengths) > 1
    return {
        "fruit": len(kept),
        "measured": len(lengths),
        "rejected": len(lists.fruit) - len(kept),
        "picked": sum(view.picked_s is not None for view in kept),
        "detections": lists.detections,
        "mean_m": float(lengths.mean()) if len(lengths) else None,
        "sd_m": float(lengths.std(ddof=1)) if many else None,
    }


def figure_lines(record: DetectionRecord) -> list[dict[str, str]]:
    """Return a line for every figure that the store keeps of a fruit: what it is, and its value.

    Examples
    --------
    >>> from cucumbervision.store.records import DetectionRecord
    >>> figure_lines(DetectionRecord(1, diameter_max_m=0.0412))[-1]
    {'What': 'Largest diameter', 'Value': '41.2 mm'}
    """
    lines = []
    for one in FIELDS:
        cell = one.cell(getattr(record, one.si_name, None), one.digits)
        if one.type == "number" and cell is not None and not one.name.startswith("box_"):
            value = f"{cell:g} {one.unit}".strip()
            lines.append({"What": one.says[0].upper() + one.says[1:], "Value": value})
    return lines


def length_lines(
    fruit: Sequence[DetectionView], grades: Mapping[str, Grade], units: Units
) -> list[dict[str, Any]]:
    """Return a line for each measured fruit for the histogram: length and class."""
    return [
        {"length": units.value(view.record.length_m), "class": grade_name(grades[view.key])}
        for view in fruit
        if view.record.length_m is not None
    ]


def method_lines(lists: RoundLists, keys: set[str], units: Units) -> list[dict[str, Any]]:
    """Return a line for each method's own length of each fruit."""
    return [
        {"method": method.method, "length": units.value(method.length_m)}
        for key, methods in lists.methods.items()
        if key in keys
        for method in methods
        if method.length_m is not None and method.measured_by is None
    ]


def map_lines(lists: RoundLists, units: Units) -> list[dict[str, Any]]:
    """Return a line for each fruit with a position: along the row, height, class, length."""
    return [
        {
            "row": f"Row {view.row or '?'}" + (f", {view.side}" if view.side else ""),
            "along": round(view.along_m, 2),
            "height": -round(view.record.centre_y_m or 0.0, 3),
            "length": units.value(view.record.length_m),
            "class": grade_name(lists.grades[view.key]),
            "views": view.views,
            "picked": view.picked_s is not None,
            "capture": view.capture,
        }
        for view in lists.fruit
        if view.along_m is not None
    ]


MANY = 40  # fruit from which narrow bars say more than they scatter

GREENS = ("#1B7837", "#5AAE61", "#A6DBA0")

OTHERS = {
    "out of grade": "#E69F00",
    "too short": "#56B4E9",
    "too long": "#D55E00",
    "not graded": "#999999",
}


def class_colors(names: Iterable[str]) -> alt.Scale:
    """Return a scale with a colour for each class: classes in greens, the best darkest and first.

    Examples
    --------
    >>> class_colors(["out of grade", "class I", "class I"]).to_dict()
    {'domain': ['class I', 'out of grade'], 'range': ['#1B7837', '#E69F00']}
    """
    present = set(names)
    classes = sorted(present - set(OTHERS))  # 'class I' before 'class II'
    others = [name for name in OTHERS if name in present]
    greens = [GREENS[min(k, len(GREENS) - 1)] for k in range(len(classes))]
    return alt.Scale(
        domain=[*classes, *others], range=[*greens, *(OTHERS[name] for name in others)]
    )


def day_name(day: int) -> str:
    """Return the name of a day by its distance from today.

    Examples
    --------
    >>> day_name(0), day_name(1), day_name(2)
    ('today', 'tomorrow', 'in 2 days')
    """
    return ("today", "tomorrow")[day] if day < 2 else f"in {day} days"


def histogram(lines: list[dict[str, Any]], units: Units) -> alt.LayerChart:
    """Return a histogram by class, with a line at the mean and a band of one standard deviation."""
    step = (1.0 if len(lines) >= MANY else 2.0) / (1 if units.name == "cm" else 2)
    lengths = np.array([line["length"] for line in lines], np.float64)
    mean, sd = float(lengths.mean()), float(lengths.std(ddof=1)) if len(lengths) > 1 else 0.0
    # Counted here: the browser is sent some dozen bars, however many fruit there are.
    counted = Counter((math.floor(line["length"] / step), line["class"]) for line in lines)
    table = [
        {"from": k * step, "to": (k + 1) * step, "class": name, "fruit": number}
        for (k, name), number in sorted(counted.items())
    ]
    bars = (
        alt.Chart(_data(table))
        .mark_bar(stroke="white")
        .encode(
            x=alt.X(
                "from:Q",
                bin="binned",
                title=f"Length [{units.name}]",
                scale=alt.Scale(zero=False),
            ),
            x2="to:Q",
            y=alt.Y("fruit:Q", title="Fruit", axis=alt.Axis(tickMinStep=1, format="d")),
            color=alt.Color("class:N", scale=class_colors(x["class"] for x in lines), title=None),
            tooltip=[alt.Tooltip("fruit:Q", title="Fruit"), alt.Tooltip("class:N", title="Class")],
        )
    )
    spread = _data([{"low": mean - sd, "high": mean + sd, "mean": mean}])
    band = alt.Chart(spread).mark_rect(opacity=0.12, color="#000").encode(x="low:Q", x2="high:Q")
    line = alt.Chart(spread).mark_rule(color="#000", strokeWidth=2).encode(x="mean:Q")
    chart: alt.LayerChart = (band + bars + line).properties(height=260)
    return chart


def method_chart(lines: list[dict[str, Any]], units: Units) -> alt.LayerChart:
    """Return a box for each method from quartile to quartile, its median, lines to the ends."""
    by_method: dict[str, list[float]] = {}
    for line in lines:
        by_method.setdefault(line["method"], []).append(line["length"])
    table = [
        dict(
            zip(
                ("low", "q1", "median", "q3", "high"),
                np.quantile(lengths, [0, 0.25, 0.5, 0.75, 1]).round(2).tolist(),
                strict=True,
            ),
            method=method,
            fruit=len(lengths),
        )
        for method, lengths in sorted(by_method.items())
    ]
    x = alt.X("low:Q", title=f"Length [{units.name}]", scale=alt.Scale(zero=False))
    said = [alt.Tooltip(f"{name}:Q") for name in ("fruit", "median", "low", "high")]
    base = alt.Chart(_data(table)).encode(y=alt.Y("method:N", title=None), tooltip=said)
    ends = base.mark_rule(color="#1B7837").encode(x=x, x2="high:Q")
    box = base.mark_bar(size=18, color="#5AAE61").encode(x="q1:Q", x2="q3:Q")
    median = base.mark_tick(color="white", size=18, thickness=2).encode(x="median:Q")
    chart: alt.LayerChart = (ends + box + median).properties(height=260)
    return chart


def map_chart(
    lines: list[dict[str, Any]], shown: list[dict[str, Any]], units: Units, *, by_length: bool
) -> alt.Chart:
    """Return the fruit of one row and side by position and height; scales fit all that is shown."""
    color = (
        alt.Color(
            "length:Q",
            title=f"Length [{units.name}]",
            scale=alt.Scale(scheme="viridis", domain=_ends(shown, "length")),
        )
        if by_length
        else alt.Color("class:N", scale=class_colors(x["class"] for x in shown), title=None)
    )
    tooltip = [
        alt.Tooltip("length:Q", title=f"Length [{units.name}]", format=f".{units.digits}f"),
        alt.Tooltip("class:N", title="Class"),
        alt.Tooltip("along:Q", title="Along the row [m]", format=".2f"),
        alt.Tooltip("height:Q", title="Above the camera [m]", format=".2f"),
        alt.Tooltip("views:Q", title="Views"),
        alt.Tooltip("capture:N", title="Capture"),
    ]
    chart: alt.Chart = (
        alt.Chart(_data(lines))
        .mark_point(filled=True, size=90, opacity=0.85)
        .encode(
            x=alt.X("along:Q", title="Along the row [m]", scale=_scale(shown, "along")),
            y=alt.Y("height:Q", title="Height [m]", scale=_scale(shown, "height")),
            color=color,
            shape=alt.Shape(
                "picked:N",
                scale=alt.Scale(domain=[False, True], range=["circle", "cross"]),
                legend=None,
            ),
            tooltip=tooltip,
        )
        .properties(height=200)
    )
    return chart


def _data(lines: list[dict[str, Any]]) -> Any:
    # Sent as a table rather than within the chart's description, where each value costs time.
    return pa.Table.from_pylist(lines)


def _ends(lines: list[dict[str, Any]], name: str) -> list[float]:
    known = [float(line[name]) for line in lines if line[name] is not None] or [0.0]
    return [min(known), max(known)]


def _scale(lines: list[dict[str, Any]], name: str) -> alt.Scale:
    low, high = _ends(lines, name)
    return alt.Scale(domain=[low - 0.05, high + 0.05], nice=False)


def forecast_chart(found: Forecast) -> alt.LayerChart:
    """Return the expected number in each class on each day, with its interval."""
    lines = [
        {
            "day": day_name(day),
            "class": class_name(found, k),
            "expected": float(found.house.expected[day, k]),
            "low": float(found.house.low[day, k]),
            "high": float(found.house.high[day, k]),
        }
        for day in found.days.tolist()
        for k in range(len(found.classes))
    ]
    table = _data(lines)
    names = [class_name(found, k) for k in range(len(found.classes))]
    order = [day_name(day) for day in found.days.tolist()]
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
    whiskers = base.mark_bar(width=2).encode(y="low:Q", y2="high:Q", color=alt.value("#222"))
    chart: alt.LayerChart = (bars + whiskers).properties(height=320)
    return chart


def class_name(found: Forecast, k: int) -> str:
    """Return the name of a forecast's class for people."""
    name = found.classes[k]
    return name if name in OTHERS else f"class {name}"
