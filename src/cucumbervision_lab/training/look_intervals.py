"""Learn the intervals of fruit at whose ends a network looked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.instances.end_crops import EndCrop
from cucumbervision.measurement.intervals import (
    LOOKED,
    PERCEIVED,
    IntervalModel,
    has_no_interval,
    look_features,
    shipped_interval_models,
)
from cucumbervision.perception.end_look import EndLooker
from cucumbervision_lab.benchmark.interval_fit import (
    TUBE_FEATURES,
    fit_interval_model,
    write_interval_models,
)

if TYPE_CHECKING:
    from pathlib import Path

    from cucumbervision.instances.end_crops import EndLook
    from cucumbervision.measurement.end_looks import LookAtEnds
    from cucumbervision_lab.training.end_crops import EndCrops
    from cucumbervision_lab.training.measured_ends import MeasuredFruit

LOOK_FEATURES = (
    *(name for name in TUBE_FEATURES if name != "closed"),
    *("covered", "running_on", "log_missing", "log_above", "log_below"),
)

LOOK_EDGES: tuple[tuple[str, tuple[float, ...]], ...] = (
    ("covered", (0.1, 0.5)),
    ("distance_m", (1.2,)),
)
"""Groups: by how likely the look says that fruit go on out of sight, and by distance.

Farther away a pixel of an outline is a larger part of the length.
"""

SMALLEST_GROUP = 100
"""Fruit of a group that has quantiles of its own."""

LEAST_FRUIT = 60
"""Fruit without which no intervals are learnt."""

_AT_ONCE = 256  # crops
_KEYS = ("M6", "M6 thread", "M6 chord")


def looked_fruit(
    fruit: Sequence[MeasuredFruit], crops: EndCrops, look: LookAtEnds
) -> tuple[list[MeasuredFruit], list[tuple[EndLook, EndLook]]]:
    """Return the held-out fruit on networks' masks, and what a network says of their ends.

    Parameters
    ----------
    fruit : sequence of MeasuredFruit
        As the crops number them.
    crops : EndCrops
        Both ends of each fruit, one after the other.
    look : callable
        What looks, as `EndLooker.look`.
    """
    drawn = np.array([not measured.given for measured in fruit])[crops.fruit]
    held = crops.only(crops.held_out & ~crops.moved & drawn)
    looks: list[EndLook] = []
    for start in range(0, len(held.planes), _AT_ONCE):
        part = zip(held.planes[start:][:_AT_ONCE], held.shapes[start:][:_AT_ONCE], strict=True)
        looks += look([EndCrop(planes, (float(a), float(b))) for planes, (a, b) in part])
    chosen = [fruit[k] for k in held.fruit[::2]]
    return chosen, list(zip(looks[::2], looks[1::2], strict=True))


def fit_look_intervals(
    fruit: Sequence[MeasuredFruit],
    looks: Sequence[tuple[EndLook, EndLook]],
    level: float = 0.90,
) -> dict[str, IntervalModel]:
    """Fit interval models of M6's three lengths on fruit whose ends were looked at.

    Parameters
    ----------
    fruit : sequence of MeasuredFruit
        Measured on masks that networks drew, of scenes that the network did not learn from. Those
        that the picture's edge cuts are left out, and those with hardly any depth.
    looks : sequence of (EndLook, EndLook)
        What their ends look like.
    level : float
        Nominal coverage.

    Raises
    ------
    ValueError
        If there are too few fruit for the level.
    """
    candidates = [
        (measured, {**measured.features, **look_features(pair)})
        for measured, pair in zip(fruit, looks, strict=True)
    ]
    chosen = [
        (measured, row)
        for measured, row in candidates
        if not (measured.given or has_no_interval(row))
    ]
    features = {name: np.array([row.get(name, 0.0) for _, row in chosen]) for name in LOOK_FEATURES}
    names = [measured.picture for measured, _ in chosen]
    models = {}
    for k, key in enumerate(_KEYS):
        errors = np.log([measured.lengths_m[k] / measured.true_m[k] for measured, _ in chosen])
        name = key + PERCEIVED + LOOKED
        models[name] = fit_interval_model(
            name,
            errors,
            features,
            names,
            level,
            LOOK_EDGES,
            smallest_group=SMALLEST_GROUP,
            missing="log_missing",
        )
    return models


def learn_look_intervals(
    fruit: Sequence[MeasuredFruit], crops: EndCrops, network: Path, file: Path
) -> int:
    """Write the shipped intervals with those by a network's looks; return how many fruit taught it.

    Too few fruit teach nothing, and no file is written.
    """
    chosen, looks = looked_fruit(fruit, crops, EndLooker(network).look)
    if len(chosen) >= LEAST_FRUIT:
        book = shipped_interval_models()
        models = {**book.models, **fit_look_intervals(chosen, looks)}
        write_interval_models(file, replace(book, models=models))
    return len(chosen)
