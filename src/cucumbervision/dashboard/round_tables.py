"""A round as the pages show it: its fruit with their grades, statistics, tables and charts."""

from __future__ import annotations

import math
import time
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import altair as alt
import numpy as np
import pyarrow as pa
from altair.utils.schemapi import disable_debug_mode

from cucumbervision.agronomy.grades import Verdict as GradeVerdict
from cucumbervision.pipeline.fields import FIELDS
from cucumbervision.rounds.forecasting import grade_of
from cucumbervision.rounds.remarks import remarks as said_of
from cucumbervision.store.views import Verdict

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from cucumbervision.agronomy.forecast import Forecast
    from cucumbervision.agronomy.grades import Grade
    from cucumbervision.agronomy.picking import Span
    from cucumbervision.agronomy.profiles import CropProfile
    from cucumbervision.capture.frames import Stop
    from cucumbervision.dashboard.settings import Units
    from cucumbervision.rounds.from_store import RoundContent
    from cucumbervision.rounds.row_fruit import CountEstimate
    from cucumbervision.store.records import DetectionRecord, MethodRecord
    from cucumbervision.store.views import DetectionView, StopView

# Vega itself says what is wrong with a chart; to check each against its schema takes longer than
# all else that a page does.
disable_debug_mode()

DOUBT = 0.45  # confidence under which a fruit that is seen once may be none


@dataclass(frozen=True, eq=False)
class RoundLists:
    """A round as the pages show it.

    Parameters
    ----------
    fruit : tuple of DetectionView
        Each fruit once: the view that stands.
    grades : dict of str to Grade
        By fruit key.
    detections : int
        How many detections the fruit are made of.
    """

    fruit: tuple[DetectionView, ...]
    grades: Mapping[str, Grade]
    detections: int


def list_round(content: RoundContent, profile: CropProfile) -> RoundLists:
    """Return a round's fruit with their grades."""
    fruit = tuple(view for view in content.views if view.best)
    grades = {view.key: grade_of(view.record, profile) for view in fruit}
    return RoundLists(fruit, grades, len(content.views))


def doubtful(views: Iterable[DetectionView]) -> list[DetectionView]:
    """Return the fruit that one view alone shows, unsurely, and nobody has looked at."""
    return [
        view
        for view in views
        if view.views == 1 and view.verdict is None and view.record.score < DOUBT
    ]


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


def length_words(record: DetectionRecord, units: Units) -> str:
    """Return a length as people say it: a lower bound as such, and 'not measured' for none.

    Examples
    --------
    >>> from cucumbervision.dashboard.settings import Units
    >>> from cucumbervision.store.records import DetectionRecord
    >>> length_words(DetectionRecord(1, length_m=0.241, flags="end-hidden"), Units("cm"))
    'at least 24.1 cm'
    """
    if record.length_m is None:
        return "not measured"
    return ("at least " if record.partial else "") + units.text(record.length_m)


def counted(number: int, one: str, many: str) -> str:
    """Return a number with its word.

    Examples
    --------
    >>> counted(1, "stop", "stops"), counted(2, "stop", "stops")
    ('1 stop', '2 stops')
    """
    return f"{number} {one if number == 1 else many}"


def round_day(at_s: float) -> str:
    """Return a moment as the day and time of this place.

    Examples
    --------
    >>> len(round_day(1_700_000_000.0))
    17
    """
    return time.strftime("%d %b %Y %H:%M", time.localtime(at_s))


def remarks(record: DetectionRecord, units: Units) -> str:
    """Return what else to know of a fruit, as short sentences; what only we need is left out.

    Examples
    --------
    >>> from cucumbervision.dashboard.settings import Units
    >>> from cucumbervision.store.records import DetectionRecord
    >>> fruit = DetectionRecord(1, length_m=0.24, flags="keypoints-logged end-hidden")
    >>> remarks(fruit, Units("cm"))
    'an end is hidden: at least 24.0 cm'
    """
    is_bound = record.partial and record.length_m is not None
    return said_of(record.flags, length_words(record, units) if is_bound else "")


def stop_name(stop: Stop | StopView) -> str:
    """Return where a stop is, for people.

    Examples
    --------
    >>> from cucumbervision.capture.frames import Stop
    >>> stop_name(Stop("3", "left", 1.2, 4))
    'Stop 4: row 3, left, 1.20 m'
    """
    number = "Stop" if stop.step is None else f"Stop {stop.step}"
    at = "" if stop.position_m is None else f"{stop.position_m:.2f} m"
    where = ", ".join(filter(None, (stop.row and f"row {stop.row}", stop.side, at)))
    return f"{number}: {where or 'no place given'}"


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


def method_lines(
    by_fruit: Mapping[str, Sequence[MethodRecord]], keys: set[str], units: Units
) -> list[dict[str, Any]]:
    """Return a line for each method's own length of each fruit, by fruit key."""
    return [
        {"method": method.method, "length": units.value(method.length_m)}
        for key, methods in by_fruit.items()
        if key in keys
        for method in methods
        if method.length_m is not None and method.measured_by is None
    ]


def row_name(row: str | None) -> str:
    """Return what a row is called in a sentence.

    Examples
    --------
    >>> row_name("3"), row_name("")
    ('Row 3', 'Row ?')
    """
    return f"Row {row or '?'}"


def count_words(count: CountEstimate) -> str:
    """Return how many fruit a row has, with its interval, and how many were found.

    Examples
    --------
    >>> from cucumbervision.rounds.row_fruit import CountEstimate
    >>> count_words(CountEstimate.of_nothing())
    'no fruit found'
    """
    if not len(count.seen):
        return "no fruit found"
    low, high = count.interval()
    there = f"{low} to {high}" if low < high else f"{low}"
    found = counted(len(count.seen), "was", "were")
    return f"{count.expected:.0f} fruit ({there}, 90 %), of which {found} found"


def map_lines(lists: RoundLists, units: Units) -> list[dict[str, Any]]:
    """Return a line for each fruit with a position: along the row, height, class, length."""
    return [
        {
            "key": view.key,
            "row": row_name(view.row) + (f", {view.side}" if view.side else ""),
            "along": round(view.along_m, 2),
            "height": -round(view.record.centre_y_m or 0.0, 3),
            "length": units.value(view.record.length_m),
            "class": grade_name(lists.grades[view.key]),
            "views": view.views,
            "mark": _mark_of(view),
            "capture": view.capture,
        }
        for view in lists.fruit
        if view.along_m is not None
    ]


MARKS = {"seen": "circle", "picked": "cross", "drawn": "diamond"}  # on the map


def _mark_of(view: DetectionView) -> str:
    if view.simulated:
        return "drawn"
    return "seen" if view.picked_s is None else "picked"


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


def class_color(name: str) -> str:
    """Return the colour of a class: greens for classes, the best darkest.

    Examples
    --------
    >>> class_color("class I"), class_color("too long")
    ('#1B7837', '#D55E00')
    """
    return OTHERS.get(name) or GREENS[min(name.count("I"), len(GREENS)) - 1]


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
        alt.Tooltip("mark:N", title="Mark"),
        alt.Tooltip("capture:N", title="Capture"),
    ]
    chart: alt.Chart = (
        alt.Chart(_data(lines))
        .mark_point(filled=True, size=160, strokeWidth=2.5)
        .encode(
            fillOpacity=alt.condition("datum.views > 1", alt.value(0.85), alt.value(0.25)),
            x=alt.X("along:Q", title="Along the row [m]", scale=_scale(shown, "along")),
            y=alt.Y("height:Q", title="Height [m]", scale=_scale(shown, "height")),
            color=color,
            shape=alt.Shape(
                "mark:N",
                scale=alt.Scale(domain=list(MARKS), range=list(MARKS.values())),
                legend=None,
            ),
            tooltip=tooltip,
        )
        .properties(height=220)
        .add_params(alt.selection_point(name="fruit", fields=["key"], toggle=False))
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
    drawn = expected_classes(found)
    share = 0.8 / max(len(drawn), 1)  # of a day, which is 1 wide
    lines = [
        {
            "day": day_name(day),
            "class": class_name(found, k),
            "from": day - 0.4 + n * share,
            "to": day - 0.4 + (n + 0.85) * share,
            "middle": day - 0.4 + (n + 0.425) * share,
            "floor": 0.0,
            "expected": float(found.house.expected[day, k]),
            "low": float(found.house.low[day, k]),
            "high": float(found.house.high[day, k]),
        }
        for day in found.days.tolist()
        for n, k in enumerate(drawn)
    ]
    names = [class_name(found, k) for k in drawn]
    days = found.days.tolist()
    said = " : ".join(f"datum.value == {day} ? '{day_name(day)}'" for day in days) + " : ''"
    axis = alt.Axis(values=days, labelExpr=said, labelAngle=0, grid=False)
    ends = alt.Scale(domain=[-0.5, days[-1] + 0.5], nice=False)
    base = alt.Chart(_data(lines))
    bars = base.mark_bar().encode(
        x=alt.X("from:Q", title="Day", axis=axis, scale=ends),
        x2="to:Q",
        y=alt.Y("expected:Q", title="Fruit"),
        y2="floor:Q",
        color=alt.Color("class:N", scale=class_colors(names), title=None),
        tooltip=[
            alt.Tooltip("day:N", title="Day"),
            alt.Tooltip("class:N", title="Class"),
            alt.Tooltip("expected:Q", title="Expected", format=".0f"),
            alt.Tooltip("low:Q", title="80 %: from", format=".0f"),
            alt.Tooltip("high:Q", title="to", format=".0f"),
        ],
    )
    whiskers = base.mark_rule(strokeWidth=2, color="#222").encode(
        x="middle:Q", y="low:Q", y2="high:Q"
    )
    chart: alt.LayerChart = (bars + whiskers).properties(height=320)
    return chart


def expected_classes(found: Forecast) -> list[int]:
    """Return which classes any fruit may be in on any of the days."""
    return [k for k in range(len(found.classes)) if found.house.high[:, k].max() >= 1]


def span_words(of: Span) -> str:
    """Return a number of fruit with its interval, both whole.

    Examples
    --------
    >>> from cucumbervision.agronomy.picking import Span
    >>> span_words(Span(3.8, 3.0, 5.0)), span_words(Span(0.2, 0.0, 1.0)), span_words(Span(0, 0, 0))
    ('4 (3 to 5)', '0 to 1', '–')
    """
    if of.high < 0.5:
        return "–"
    if of.expected < 0.5:
        return f"0 to {of.high:.0f}"
    words = f"{of.expected:.0f}"
    return words if of.low == of.high else f"{words} ({of.low:.0f} to {of.high:.0f})"


def hours_words(of: Span) -> str:
    """Return hours of work with their interval: in minutes where they are few.

    Examples
    --------
    >>> from cucumbervision.agronomy.picking import Span
    >>> hours_words(Span(0.31, 0.2, 0.5)), hours_words(Span(3.24, 2.9, 4.0))
    ('20 min (15 to 30)', '3.2 h (2.9 to 4.0)')
    """
    if of.expected >= 1.5:
        return f"{of.expected:.1f} h ({of.low:.1f} to {of.high:.1f})"
    low, at, high = (5 * math.ceil(12 * x - 1e-9) for x in (of.low, of.expected, of.high))
    return f"{at} min" if low == high else f"{at} min ({low} to {high})"


def class_name(found: Forecast, k: int) -> str:
    """Return the name of a forecast's class for people."""
    return name_of_class(found.classes[k])


def name_of_class(name: str) -> str:
    """Return the name of a class for people.

    Examples
    --------
    >>> name_of_class("I"), name_of_class("too long")
    ('class I', 'too long')
    """
    return name if name in OTHERS else f"class {name}"
