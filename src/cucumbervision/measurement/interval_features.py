"""What is known at run time of how far to trust an M6 length."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from cucumbervision.measurement.results import Measurement

__all__ = ["FEATURES", "interval_features"]

FEATURES = (
    "log_sd",
    "tilt",
    "tilt_steep",
    "hidden",
    "distance_m",
    "holes",
    "unexplained",
    "log_pixels",
    "end_hidden",
    "end_on",
    "poor_fit",
)
STEEP_DEG = 35.0


def interval_features(measurement: Measurement) -> dict[str, float]:
    """Give the features of `uncertainty.IntervalModel` for an M6 measurement.

    Parameters
    ----------
    measurement : Measurement
        By M6, with its fit.

    Returns
    -------
    dict of str to float
        One value for each of `FEATURES`.

    Raises
    ------
    ValueError
        If nothing was fitted.
    """
    fit, tube = measurement.fit, measurement.tube
    if fit is None or tube is None:
        raise ValueError("there is no tube to tell features of")
    distance = float(np.median(fit.traits.axis_m[:, 2]))
    length = tube.centreline_m
    tilt = fit.traits.tilt_deg
    return {
        "log_sd": float(np.log(max(fit.centreline_sd_m / length, 1e-5))),
        "tilt": tilt / 60.0,
        "tilt_steep": max(0.0, tilt - STEEP_DEG) / 25.0,
        "hidden": fit.hidden_share,
        "distance_m": distance,
        "holes": 1.0 - fit.fill,
        "unexplained": 1.0 - fit.explained,
        "log_pixels": float(np.log(length / distance)),
        "end_hidden": float("end-hidden" in fit.flags),
        "end_on": float("end-on" in fit.flags),
        "poor_fit": float("poor-fit" in fit.flags),
    }
