"""A round's fruit, each once, with the length of all its views; and the context of one fruit."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from statistics import fmean, stdev
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.methods.matching import pooled_length
from cucumbervision.methods.result import INTERVAL_Z
from cucumbervision.methods.table import AVAILABLE
from cucumbervision.run.fields import table_row
from cucumbervision.run.tables import Summary
from cucumbervision_greenhouse.forecast.forecast import natural_key
from cucumbervision_greenhouse.rounds.from_store import (
    CONTENTS,
    RoundContent,
    counted_fruit,
    stored_merging,
)
from cucumbervision_greenhouse.store.records import Verdict

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from cucumbervision.run.fields import Cell
    from cucumbervision_greenhouse.store.records import FruitRow


@dataclass(frozen=True)
class RoundFigures:
    """The figures of a round, the same on all pages and in all files, without deleted fruit.

    Parameters
    ----------
    fruit, measured, picked : int
        Fruit, each once; those with a length; and those that were picked.
    detections : int
        Number of their detections.
    mean_m, sd_m, shortest_m, longest_m : float, optional
        Of the lengths of the fruit on the plant, metres; lower bounds and lengths of which
        nothing is known are left out.
    """

    fruit: int
    measured: int
    picked: int
    detections: int
    mean_m: float | None
    sd_m: float | None
    shortest_m: float | None
    longest_m: float | None


def on_the_plant(fruit: Iterable[FruitRow]) -> list[FruitRow]:
    """Return the fruit that count today: neither deleted, picked nor doubtful."""
    return [
        view
        for view in fruit
        if view.picked_s is None and view.verdict is not Verdict.REJECTED and not view.doubtful
    ]


def hanging_lengths_m(fruit: Iterable[FruitRow]) -> list[float]:
    """Return the lengths of the fruit on the plant, metres, that count (`whole_length`)."""
    lengths = (view.whole_length for view in on_the_plant(fruit))
    return [length.value_m for length in lengths if length is not None]


def round_figures(content: RoundContent, table: Sequence[FruitRow]) -> RoundFigures:
    """Return the figures of a round from its content and its `fruit_table`."""
    lengths_m = hanging_lengths_m(line for line in table)
    return RoundFigures(
        fruit=len(table),
        measured=sum(line.length_m is not None for line in table),
        picked=sum(line.picked_s is not None for line in table),
        detections=sum(view.verdict is not Verdict.REJECTED for view in content.views),
        mean_m=fmean(lengths_m) if lengths_m else None,
        sd_m=stdev(lengths_m) if len(lengths_m) > 1 else None,
        shortest_m=min(lengths_m, default=None),
        longest_m=max(lengths_m, default=None),
    )


@lru_cache(maxsize=CONTENTS)  # all pages of a round ask for the same
def fruit_table(content: RoundContent) -> tuple[FruitRow, ...]:
    """Return a round's fruit, each once, by row and position; rejected ones are left out."""
    pooled = _pooled(content)
    best = counted_fruit(content.views)
    best.sort(key=lambda v: (natural_key(v.row or ""), v.along_m is None, v.along_m or 0.0, v.key))
    return tuple(
        view.with_(number=number, **_pooled_length(view, pooled.get(view.key)))
        for number, view in enumerate(best, 1)
    )


def _pooled_length(view: FruitRow, pooled: tuple[float, float] | None) -> dict[str, Any]:
    """Return the length of all views of a fruit."""
    if pooled is None or view.length is None:
        return {}
    length_m, sd_m = pooled
    length = replace(view.length, value_m=length_m)
    if length.low_m is not None:
        spread = math.exp(INTERVAL_Z * sd_m / length_m)
        length = replace(length, low_m=length_m / spread, high_m=length_m * spread)
    return {"length": length}


def _pooled(content: RoundContent) -> dict[str, tuple[float, float]]:
    """Return the pooled lengths of fruit by all keys of their views.

    Only of those that two or more views show whole, with lengths of one kind.
    """
    lengths: dict[str, tuple[float, float]] = {}
    kind = {view.key: view.length and view.length.kind for view in content.views}
    for row in content.rows:
        (cluster, _), views = stored_merging(content, row), row.views
        order = np.argsort(cluster, kind="stable")
        for members in np.split(order, np.flatnonzero(np.diff(cluster[order])) + 1):
            measured = members[np.isfinite(views.length_m[members]) & ~views.partial[members]]
            kinds = {kind[row.fruit_keys[k]] for k in measured.tolist()}
            length = pooled_length(
                views.length_m[members], views.length_sd[members], views.partial[members]
            )
            if length is not None and len(measured) > 1 and len(kinds) == 1:
                lengths |= dict.fromkeys((row.fruit_keys[k] for k in members.tolist()), length)
    return lengths


def least_sure_first(fruit: Sequence[FruitRow]) -> list[FruitRow]:
    """Return unjudged fruit with a single view, the least certain first."""
    once = [view for view in fruit if view.views == 1 and view.verdict is None]
    return sorted(once, key=lambda view: (view.score, view.key))


def round_doubts(views: Iterable[FruitRow]) -> list[str]:
    """Return the doubts about the fruit of a round, one line each with the remedy.

    Rejected ones are left out.
    """
    summary = Summary()
    summary.add(_row(view) for view in views if view.verdict is not Verdict.REJECTED)
    return summary.doubts()


def _row(view: FruitRow) -> dict[str, Cell]:
    row = table_row(vars(view))
    is_measured = any(row[f"{method.lower()}_cm"] is not None for method in AVAILABLE)
    return {**row, "reason": row["reason"] if is_measured else "", "simulated": False}
