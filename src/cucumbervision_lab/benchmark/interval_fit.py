"""Learn the intervals from simulated fruit, and see whether they cover others."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.measurement.intervals import (
    RAW_FEATURES,
    TUBE_EDGES,
    TUBE_FEATURES,
    IntervalModels,
    fit_interval_model,
    raw_features,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cucumbervision.accuracy.records import Record

__all__ = ["KEYS", "fit_interval_models", "record_features", "record_truth_m", "with_intervals"]

KEYS = ("M1", "M2", "M3", "M4", "M5", "M6", "M6 thread", "M6 chord")


def record_truth_m(record: Record, key: str) -> float | None:
    """Give the true length that a key's interval is to cover."""
    if key == "M6 thread":
        return record.thread_m
    return record.chord_m if key == "M6 chord" else record.centreline_m


def record_features(record: Record, key: str) -> dict[str, float] | None:
    """Give what was known of one reading at run time; None where nothing was read."""
    length = record.lengths_m.get(key)
    if length is None:
        return None
    if key.startswith("M6"):
        found: dict[str, float] | None = record.details.get("m6_features")
        return found
    return raw_features(length, record.distance_m, record.fill)


def fit_interval_models(records: Sequence[Record], level: float = 0.90) -> IntervalModels:
    """Fit one model a key on the records, depth scale known.

    Parameters
    ----------
    records : sequence of Record
        Of calibration fruit, which no test ever sees.
    level : float
        Level of the intervals.

    Raises
    ------
    ValueError
        If there are too few fruit for the level.
    """
    models = {}
    for key in KEYS:
        names = TUBE_FEATURES if key.startswith("M6") else RAW_FEATURES
        errors, columns, fruit = _training(records, key, names)
        features = {name: columns[:, k] for k, name in enumerate(names)}
        edges = TUBE_EDGES if key.startswith("M6") else ()
        models[key] = fit_interval_model(key, errors, features, fruit, level, edges)
    return IntervalModels(level, models, len({record.fruit for record in records}))


def _training(records: Sequence[Record], key: str, names: Sequence[str]) -> tuple[Any, Any, Any]:
    errors, rows, fruit = [], [], []
    for record in records:
        length, truth = record.lengths_m.get(key), record_truth_m(record, key)
        features = record_features(record, key)
        if length is None or truth is None or features is None:
            continue
        errors.append(np.log(length / truth))
        rows.append([features[name] for name in names])
        fruit.append(record.fruit)
    return np.array(errors), np.array(rows).reshape(len(rows), len(names)), np.array(fruit)


def with_intervals(record: Record, book: IntervalModels) -> dict[str, Any]:
    """Give a record's intervals by key, with the depth scale known and unknown.

    With the scale unknown the camera reads every length times its own scale error, and the
    interval allows for it.

    Returns
    -------
    dict
        key: {'known': [low_m, high_m], 'unknown': [low_m, high_m]}.
    """
    found: dict[str, Any] = {}
    for key in KEYS:
        features, length = record_features(record, key), record.lengths_m.get(key)
        if features is None or length is None:
            continue
        known = book.interval(key, length, features, scale_known=True)
        unknown = book.interval(key, length * record.depth_scale, features, scale_known=False)
        if known and unknown:
            found[key] = {"known": list(known), "unknown": list(unknown)}
    return found
