"""Doubts about the data of a round, in the words of the command `measure`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cucumbervision.measurement.methods import AVAILABLE
from cucumbervision.measurement.result import Choice
from cucumbervision.pipeline.summary import Summary
from cucumbervision_greenhouse.store.views import Verdict

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from cucumbervision.pipeline.fields import Cell
    from cucumbervision_greenhouse.store.records import DetectionRecord, MethodRecord
    from cucumbervision_greenhouse.store.repository import Store
    from cucumbervision_greenhouse.store.views import DetectionSummary

_REFUSED = (Choice.IMPLAUSIBLE, Choice.IMPLAUSIBLE_DIAMETER)


def round_doubts(store: Store, views: Iterable[DetectionSummary]) -> list[str]:
    """Return the doubts about the data of a round, one line each with the remedy.

    Parameters
    ----------
    store : Store
        Source of every method's length, read if fruit have impossible sizes.
    views : iterable of DetectionSummary
        Detections of one round; rejected ones are ignored.
    """
    fruit = [view for view in views if view.verdict is not Verdict.REJECTED]
    methods: dict[str, tuple[MethodRecord, ...]] = {}
    for round_key in {view.round_key for view in fruit if view.record.reason in _REFUSED}:
        methods |= store.measurements(round_key)
    summary = Summary()
    summary.add(_row(view.record, methods.get(view.key, ())) for view in fruit)
    return summary.doubts()


def _row(record: DetectionRecord, methods: Sequence[MethodRecord]) -> dict[str, Cell]:
    """Return what `Summary` counts of a fruit, as `pipeline.fields.csv` names it."""
    lengths_cm = {
        method.method: 100 * method.length_m for method in methods if method.length_m is not None
    }
    return {
        "length_cm": None if record.length_m is None else 100 * record.length_m,
        "method": record.method,
        "reason": record.reason if lengths_cm else "",
        "flags": record.flags,
        "mask_source": record.mask_source,
        "label": record.label,
        "simulated": False,
        **{f"{method.lower()}_cm": lengths_cm.get(method) for method in AVAILABLE},
    }
