"""A round as tables: its fruit with their grades, its statistics, the lines of its charts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.agronomy.grades import Verdict as GradeVerdict
from cucumbervision.pipeline.fields import FIELDS
from cucumbervision.rounds.forecasting import grade_of
from cucumbervision.store.views import Verdict

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from cucumbervision.agronomy.grades import Grade
    from cucumbervision.agronomy.profiles import CropProfile
    from cucumbervision.dashboard.settings import Units
    from cucumbervision.store.records import DetectionRecord, MethodRecord
    from cucumbervision.store.repository import Store
    from cucumbervision.store.views import DetectionView

__all__ = [
    "RoundLists",
    "figure_lines",
    "grade_name",
    "length_lines",
    "map_lines",
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
