"""Learn the intervals from simulated fruit, and see whether they cover others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from cucumbervision.measurement.intervals import (
    RAW_FEATURES,
    TUBE_EDGES,
    TUBE_FEATURES,
    IntervalModels,
    fit_interval_model,
    raw_features,
)

__all__ = ["KEYS", "TRUTH_OF", "fit_interval_models", "reading_features", "with_intervals"]

TRUTH_OF = {
    **dict.fromkeys(("M1", "M2", "M3", "M4", "M5", "M6"), "centreline_m"),
    "M6 thread": "thread_m",
    "M6 chord": "chord_m",
}
"""The column of the true length that the interval of each method's reading is to cover."""

KEYS = tuple(TRUTH_OF)


def reading_features(reading: pd.Series[Any]) -> dict[str, float] | None:
    """Return what was known of one reading at run time; None where nothing was read.

    Parameters
    ----------
    reading : Series
        A row of `readings_frame`, of one of `KEYS`.
    """
    if np.isnan(reading["length_m"]):
        return None
    if reading["method"].startswith("M6"):
        found = reading.get("m6_features")
        return found if isinstance(found, dict) else None
    return raw_features(reading["length_m"], reading["distance_m"], reading["fill"])


def fit_interval_models(readings: pd.DataFrame, level: float = 0.90) -> IntervalModels:
    """Fit one model a method on readings, depth scale known.

    Parameters
    ----------
    readings : DataFrame
        Of calibration fruit, which no test ever sees, as `readings_frame` gives them.
    level : float
        Level of the intervals.

    Raises
    ------
    ValueError
        If there are too few fruit for the level.
    """
    models = {}
    for key, truth in TRUTH_OF.items():
        names = TUBE_FEATURES if key.startswith("M6") else RAW_FEATURES
        rows = readings[(readings["method"] == key) & readings[truth].notna()]
        known = [one for one in rows.apply(reading_features, axis=1).items() if one[1] is not None]
        rows = rows.loc[[label for label, _ in known]]
        errors = np.log(rows["length_m"] / rows[truth]).to_numpy()
        features = {name: np.array([said[name] for _, said in known]) for name in names}
        edges = TUBE_EDGES if key.startswith("M6") else ()
        fruit = rows["fruit"].to_numpy()
        models[key] = fit_interval_model(key, errors, features, fruit, level, edges)
    return IntervalModels(level, models, readings["fruit"].nunique())


def with_intervals(
    readings: pd.DataFrame, book: IntervalModels, *, scale_known: bool = True
) -> pd.DataFrame:
    """Return readings with `low_m` and `high_m`, NaN where there is no interval.

    With the scale unknown the camera reads every length times its own scale error, and the
    interval allows for it.

    Parameters
    ----------
    readings : DataFrame
        As `readings_frame` gives them, with distinct row labels.
    book : IntervalModels
        The models.
    scale_known : bool
        Whether the depth scale is exact, as after a calibration.
    """
    ends = {}
    for label, reading in readings[readings["method"].isin(KEYS)].iterrows():
        features = reading_features(reading)
        if features is not None:
            scale = 1.0 if scale_known else reading["depth_scale"]
            length_m = reading["length_m"] * scale
            found = book.interval(reading["method"], length_m, features, scale_known=scale_known)
            ends[label] = found or (np.nan, np.nan)
    found = pd.DataFrame.from_dict(ends, "index", columns=["low_m", "high_m"], dtype=float)
    return readings.join(found)
