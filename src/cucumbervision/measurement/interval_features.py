"""What is known at run time of how far to trust a length."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from cucumbervision.measurement.results import Measurement

__all__ = ["RAW_FEATURES", "TUBE_EDGES", "TUBE_FEATURES", "raw_features", "tube_features"]

TUBE_FEATURES = (
    "log_sd",
    "log_outline",
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
RAW_FEATURES = ("distance_m", "holes", "log_pixels")
STEEP_DEG = 35.0
# Flat, tilted and steep fruit, of smooth and of rough outline: what errs is another thing in each.
TUBE_EDGES = (("tilt", (15 / 60, 40 / 60)), ("log_outline", (float(np.log(0.5)),)))


def tube_features(measurement: Measurement) -> dict[str, float]:
    """Give the features of `uncertainty.IntervalModel` for an M6 measurement.

    Parameters
    ----------
    measurement : Measurement
        By M6, with its fit.

    Returns
    -------
    dict of str to float
        One value for each of `TUBE_FEATURES`.

    Raises
    ------
    ValueError
        If nothing was fitted.
    """
    fit, tube = measurement.fit, measurement.tube
    if fit is None or tube is None:
        raise ValueError("there is no tube to tell features of")
    distance = float(np.median(fit.traits.axis_m[:, 2]))
    tilt = fit.traits.tilt_deg
    return {
        "log_sd": float(np.log(max(fit.centreline_sd_m / tube.centreline_m, 1e-5))),
        "log_outline": float(np.log(max(fit.outline_rms_px, 0.05))),
        "tilt": tilt / 60.0,
        "tilt_steep": max(0.0, tilt - STEEP_DEG) / 25.0,
        "hidden": fit.hidden_share,
        "unexplained": 1.0 - fit.explained,
        "end_hidden": float("end-hidden" in fit.flags),
        "end_on": float("end-on" in fit.flags),
        "poor_fit": float("poor-fit" in fit.flags),
        **raw_features(tube.centreline_m, distance, fit.fill),
    }


def raw_features(length_m: float, distance_m: float, fill: float) -> dict[str, float]:
    """Give the features of a raw length, by M1 to M5.

    Parameters
    ----------
    length_m, distance_m : float
        The length as measured, and the fruit's median depth, metres.
    fill : float
        Share of the mask's (or box's) pixels with a reading, 0 to 1.

    Examples
    --------
    >>> raw_features(0.25, 0.5, 0.98)["distance_m"]
    0.5
    """
    return {
        "distance_m": distance_m,
        "holes": 1.0 - fill,
        "log_pixels": float(np.log(max(length_m, 1e-3) / distance_m)),
    }
