"""Intervals of lengths: features, trees and models."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np
from pydantic import TypeAdapter

from cucumbervision.errors import ModelError, wrap_reader_errors
from cucumbervision.files import read_json
from cucumbervision.fruit.instance import MaskSource
from cucumbervision.methods.flags import LOWER_BOUND, NO_DEPTH, Flag
from cucumbervision.methods.hidden_end import DRAWN_KINDS
from cucumbervision.methods.result import IntervalBasis, Length, LengthDefinition, calibration_key

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from cucumbervision.arrays import Array, Ints
    from cucumbervision.fruit.crops import EndLook
    from cucumbervision.methods.result import Measurement


@dataclass(frozen=True)
class Trees:
    """Regression trees of depth two whose values are added (gradient boosting; Friedman 2001).

    Parameters
    ----------
    start : float
        What is added to: the value without any tree.
    features : tuple of (int, int, int)
        For each tree the index of the feature that it asks first, then that of the feature that it
        asks at or below the first limit, and above it.
    limits : tuple of (float, float, float)
        The limits of the three.
    leaves : tuple of (float, float, float, float)
        For each tree its values, from below both limits to above both.

    Examples
    --------
    >>> trees = Trees(-4.0, ((0, 1, 1),), ((0.5, 10.0, 20.0),), ((0.0, 0.1, 0.2, 0.4),))
    >>> [trees.value(np.array(row)) for row in ([0.3, 15.0], [0.7, 15.0], [0.7, 25.0])]
    [-3.9, -3.8, -3.6]
    """

    start: float
    features: tuple[tuple[int, int, int], ...] = ()
    limits: tuple[tuple[float, float, float], ...] = ()
    leaves: tuple[tuple[float, float, float, float], ...] = ()

    def value(self, row: Array) -> float:
        """Return the sum for one row of features, float64 of shape (F,)."""
        features, limits, leaves = self._arrays
        if not len(features):
            return self.start
        above = row[features] > limits
        second = np.where(above[:, 0], above[:, 2], above[:, 1])
        return self.start + float(leaves[np.arange(len(leaves)), 2 * above[:, 0] + second].sum())

    @cached_property
    def _arrays(self) -> tuple[Ints, Array, Array]:
        return np.array(self.features, np.intp), np.array(self.limits), np.array(self.leaves)


_LEAST_DOUBT = 0.01  # of a confidence: above 0.99 detectors do not discriminate
PERCEIVED = " perceived"
"""Behind the keys of models for the masks that networks draw."""
LOOKED = " looked"
"""Behind these, of models for fruit at whose ends a network looked."""

FLOOR = 1e-4  # of a length: what counts as nothing
LEAST_SPREAD, LARGEST_SPREAD = 0.002, 2.7
"""Limits of what trees spread an interval by to one side, as a logarithm of the length."""


@dataclass(frozen=True)
class Band:
    """Errors of the calibration fruit of one group.

    Parameters
    ----------
    low_quantile, high_quantile : float
        Conformal quantiles of -error / spread below and error / spread above, each with a miss rate
        of (1 - level) / 2, for a known depth scale; the error is a logarithm. Where no more than
        that err to one side, its quantile is 0 and the other has a miss rate of 1 - level.
    count : int
        Calibration readings behind the quantiles.
    """

    low_quantile: float
    high_quantile: float
    count: int


@dataclass(frozen=True)
class IntervalModel:
    """Uncertainty of one method's length, relative to it: conformalized quantile regression.

    Trees predict how far errors reach to either side, from the features; within groups their
    answers are scaled to the nominal coverage (Romano, Patterson and Candes, 2019).

    Parameters
    ----------
    method : str
        The method.
    level : float
        Level of the quantiles.
    features : tuple of str
        Names of the features.
    below, above : Trees
        Logarithm of the spread of errors below and above 0: of lengths measured too short, and too
        long.
    bands : dict of str to Band
        Bands by group (`feature_groups`): '' for all fruit, '1' and '1-0' for subgroups by the
        first and second of the `edges`, and so on.
    edges : tuple of (str, tuple of float)
        Features by which fruit are grouped, with the limits of the groups (Mondrian conformal
        prediction; Vovk et al. 2005): the interval has its coverage within each group.
    missing : str
        Feature with the logarithm of the expected ratio of true to measured length; empty if there
        is none.
    """

    method: str
    level: float
    features: tuple[str, ...]
    below: Trees
    above: Trees
    bands: dict[str, Band]
    edges: tuple[tuple[str, tuple[float, ...]], ...] = ()
    missing: str = ""

    def spreads(self, values: Mapping[str, float]) -> tuple[float, float]:
        """Return the spreads of errors below and above 0; missing features count as 0."""
        row = np.array([values.get(name, 0.0) for name in self.features])
        return spread(self.below, row), spread(self.above, row)

    def band(self, values: Mapping[str, float]) -> Band:
        """Return the band of the smallest group that had enough readings to have one."""
        return next(self.bands[g] for g in feature_groups(self.edges, values) if g in self.bands)

    def interval(
        self, length_m: float, values: Mapping[str, float], more_sd: float = 0.0
    ) -> tuple[float, float]:
        """Return the interval of a length.

        Parameters
        ----------
        length_m : float
            The length in metres.
        values : mapping of str to float
            The measurement's features.
        more_sd : float
            Relative standard deviation of what the fruit it was learnt from did not have.

        Returns
        -------
        low_m, high_m : float

        Examples
        --------
        >>> spread = Trees(np.log(0.01))
        >>> model = IntervalModel("M6", 0.9, (), spread, spread, {"": Band(2.0, 2.0, 500)})
        >>> [round(x, 4) for x in model.interval(0.2, {})]
        [0.196, 0.204]
        """
        (below, above), band = self.spreads(values), self.band(values)
        added = NormalDist().inv_cdf(0.5 + self.level / 2) * more_sd
        short = float(np.hypot(band.low_quantile * below, added))
        long = float(np.hypot(band.high_quantile * above, added))
        # The error, log(measured / true) + missing, lies from -short to long.
        missing = values.get(self.missing, 0.0)
        return length_m * float(np.exp(missing - long)), length_m * float(np.exp(missing + short))


def spread(trees: Trees, row: Array) -> float:
    """Return what trees of logarithms spread an interval by to their side, within its limits."""
    return float(min(max(np.exp(trees.value(row)), LEAST_SPREAD), LARGEST_SPREAD))


def feature_groups(
    edges: Sequence[tuple[str, Sequence[float]]], values: Mapping[str, float]
) -> list[str]:
    """Return the groups that a measurement's features fall into, from the smallest to all.

    Examples
    --------
    >>> feature_groups((("tilt", (0.25, 0.5)), ("hidden", (0.1,))), {"tilt": 0.3})
    ['1-0', '1', '']
    """
    places = [str(int(np.searchsorted(limits, values.get(name, 0.0)))) for name, limits in edges]
    return ["-".join(places[:count]) for count in range(len(places), -1, -1)]


_MOST_DIAMETERS = 9.0  # of slender fruit: real ones have 5 to 8.3, a piece shows less of the girth
_STEEP_DEG = 35.0
_LEAST_MEASURED = 0.1  # minimum measured share of a fruit's length, by the evaluation of its ends


@lru_cache(maxsize=4)  # each definition of one tube's length asks, before and after the look
def tube_features(measurement: Measurement) -> dict[str, float]:
    """Return the features of an `IntervalModel` for an M6 measurement.

    Parameters
    ----------
    measurement : Measurement
        Measurement of M6, with its fit.

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
        raise ValueError("there is no tube for features")
    distance = float(np.median(fit.traits.axis_m[:, 2]))
    tilt, widest = fit.traits.tilt_deg, fit.traits.diameter_max_m
    return {
        "log_sd": float(np.log(max(fit.centreline_sd_m / tube.centreline_m, 1e-5))),
        "log_outline": float(np.log(max(fit.outline_rms_px, 0.05))),
        "tilt": tilt / 60.0,
        "tilt_steep": max(0.0, tilt - _STEEP_DEG) / 25.0,
        "hidden": fit.hidden_share,
        "unexplained": 1.0 - fit.explained,
        "end_hidden": float(Flag.END_HIDDEN in fit.flags),
        "end_on": float(Flag.END_ON in fit.flags),
        "poor_fit": float(Flag.POOR_FIT in fit.flags),
        # Signs of a fruit that continues behind an object which depth does not show.
        "closed": 1.0 - min(fit.ends_open),
        "flare": float(np.log(widest / np.median(fit.traits.diameter_m))),
        "girth": DRAWN_KINDS.excess_sd(tube.centreline_m, widest),
        "diameter_m": widest,
        **raw_features(tube.centreline_m, distance, fit.fill),
        **({} if fit.looks is None else look_features(fit.looks)),
    }


def look_features(looks: Sequence[EndLook]) -> dict[str, float]:
    """Return the features of the evaluation of both ends of a fruit.

    Examples
    --------
    >>> from cucumbervision.fruit.crops import EndLook
    >>> true_end = EndLook(0.98, 0.01, 0.01, (-0.01, -0.005, 0.0, 0.005, 0.02), 0.9)
    >>> covered = EndLook(0.1, 0.9, 0.0, (0.0, 0.1, 0.2, 0.3, 0.5), 0.1)
    >>> features = look_features((true_end, covered))
    >>> features["covered"], round(features["log_missing"], 2), round(features["log_above"], 2)
    (0.9, 0.22, -0.67)
    """
    low_share, median, high_share = (sum(look.missing[k] for look in looks) for k in (0, 2, -1))
    # The true length is the measured one divided by the share of it that was measured.
    steps = -np.log(np.clip(1.0 - np.array([low_share, median, high_share]), _LEAST_MEASURED, None))
    return {
        "looked": 1.0,
        "covered": max(look.covered for look in looks),
        "running_on": max(look.running_on for look in looks),
        "log_missing": float(steps[1]),
        "log_above": float(np.log(max(steps[2] - steps[1], FLOOR))),
        "log_below": float(np.log(max(steps[1] - steps[0], FLOOR))),
    }


def raw_features(length_m: float, distance_m: float, fill: float) -> dict[str, float]:
    """Return the features of a raw length, by M1 to M5.

    Parameters
    ----------
    length_m, distance_m : float
        Measured length, and median depth of the fruit, metres.
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


def mask_features(
    source: MaskSource | None, flags: Sequence[Flag], confidence: float = 1.0
) -> dict[str, float]:
    """Return the features of the measured mask: its source, and what is missing.

    Parameters
    ----------
    source : MaskSource, optional
        Source of the mask; None without a mask.
    flags : sequence of Flag
        Flags of the fruit.
    confidence : float
        Confidence of the detection; it is low for parts of fruit and merged fruit.

    Examples
    --------
    >>> set(mask_features(MaskSource.DATASET, [Flag.ENDS_DISAGREE]).values())
    {0.0}
    >>> [name for name, value in mask_features(MaskSource.SAM, [Flag.END_HIDDEN]).items() if value]
    ['perceived', 'certainty', 'goes_on']
    """
    # Keypoints of a data set are true, unlike those of a network: they must not matter here.
    is_labelled = source is MaskSource.DATASET
    goes_on = not is_labelled and not LOWER_BOUND.isdisjoint(flags)
    return {
        "perceived": float(not is_labelled),
        "certainty": 0.0 if is_labelled else -float(np.log(max(1.0 - confidence, _LEAST_DOUBT))),
        "own_mask": float(source is MaskSource.DETECTOR),
        "cut": float(not {Flag.CUT_BY_FRAME, Flag.OUTLINE_SHORT}.isdisjoint(flags)),
        "no_depth": float(not NO_DEPTH.isdisjoint(flags)),
        "goes_on": float(goes_on),
        # The end keypoints of a fruit that continues out of sight are guesses.
        "ends_disagree": float(not (is_labelled or goes_on) and Flag.ENDS_DISAGREE in flags),
    }


def has_no_interval(features: Mapping[str, float]) -> bool:
    """Return whether the models do not apply: the picture cuts the fruit, or depth is wrong.

    Examples
    --------
    >>> has_no_interval(mask_features(MaskSource.SAM, [Flag.DEPTH_SPARSE]))
    True
    """
    return bool(features.get("cut") or features.get("no_depth"))


WIDEST = 4.0  # an interval from half to twice a length is useless

SCALE_SD = 0.01  # of an uncalibrated D4xx: the data sheet allows 2 % at 2 m
# Additional error of real fruit over simulated ones: `benchmarks/real_cucumbers.py`
REAL_SD = 0.010

_SHIPPED = Path(__file__).with_name("interval_models.json")


@dataclass(frozen=True)
class IntervalModels:
    """The interval models of all methods.

    Parameters
    ----------
    level : float
        Level of all intervals.
    models : dict of str to IntervalModel
        Keys 'M1' … 'M6' (all about the centreline), 'M6 thread', 'M6 chord', for masks of a data
        set. With the suffix ' perceived': for masks of networks, which have other errors; with
        ' perceived looked': for fruit whose ends a network evaluated.
    fruit : int
        Number of simulated calibration fruit.
    """

    level: float
    models: dict[str, IntervalModel]
    fruit: int

    def interval(
        self, key: str, length_m: float, features: Mapping[str, float], more_sd: float = 0.0
    ) -> tuple[float, float] | None:
        """Return the interval of a length; None without a model for the key.

        Parameters
        ----------
        key : str
            A key of `models`.
        length_m : float
            The length in metres.
        features : mapping of str to float
            From `measurement.interval_features`.
        more_sd : float
            As in `IntervalModel.interval`.

        Examples
        --------
        What goes on out of sight may be a piece of a fruit of nine diameters:

        >>> spread = Trees(np.log(0.01))
        >>> model = IntervalModel("M6", 0.9, (), spread, spread, {"": Band(2.0, 2.0, 500)})
        >>> models = IntervalModels(0.9, {"M6": model}, 500)
        >>> piece = {"goes_on": 1.0, "diameter_m": 0.025}
        >>> [round(x, 3) for x in models.interval("M6", 0.08, piece)]
        [0.078, 0.225]
        """
        perceived = key + PERCEIVED if features.get("perceived") else key
        looked = self.models.get(perceived + LOOKED) if features.get("looked") else None
        model = looked or self.models.get(perceived) or self.models.get(key)
        if model is None:
            return None
        low_m, high_m = model.interval(length_m, features, more_sd)
        # A piece of a fruit says little about the rest of it.
        whole_m = _MOST_DIAMETERS * features.get("goes_on", 0.0) * features.get("diameter_m", 0.0)
        return low_m, max(high_m, whole_m)


def read_interval_models(path: Path) -> IntervalModels:
    """Read interval models.

    Raises
    ------
    ModelError
        If the file is missing or invalid.
    """
    content = read_json(path, ModelError, "reinstall the package")
    with wrap_reader_errors(path, ModelError, "reinstall the package"):
        models = TypeAdapter(list[IntervalModel]).validate_python(content["models"])
        by_method = {model.method: model for model in models}
        return IntervalModels(float(content["level"]), by_method, int(content["fruit"]))


@lru_cache(maxsize=1)
def shipped_interval_models() -> IntervalModels:
    """Return the models that come with the package."""
    return read_interval_models(_SHIPPED)


def with_interval(
    length: Length,
    measurement: Measurement,
    distance_m: float,
    fill: float,
    mask: Mapping[str, float],
    *,
    scale_known: bool,
) -> tuple[Length, bool]:
    """Compute the interval of a measured length.

    Parameters
    ----------
    length : Length
        Length of the fitted tube, or raw length of M1 to M5. The interval of a raw length is that
        of the centreline, since a chord or an arc of the visible surface is not the fruit's length.
    measurement : Measurement
        The measurement of the length.
    distance_m, fill : float
        Median depth, and share of pixels with a reading, of the mask or box.
    mask : mapping of str to float
        Features of the mask (`mask_features`).
    scale_known : bool
        Whether the camera's depth scale was measured with a bar of known length.

    Returns
    -------
    length : Length
        The length with its interval, if there is a model for it. A fruit cut by the edge of the
        picture has none, because only a lower bound is known; nor has one with wrong depth.
    narrow : bool
        False if the interval would span more than a factor of four and is therefore omitted.
    """
    if has_no_interval(mask):
        return length, True
    if measurement.fit is not None:
        interval_kind, features = LengthDefinition(length.kind), tube_features(measurement)
    else:
        interval_kind = LengthDefinition.CENTRELINE
        features = raw_features(length.value_m, distance_m, fill)
    key = calibration_key(measurement.source, length.kind)
    more_sd = REAL_SD if scale_known else float(np.hypot(REAL_SD, SCALE_SD))
    bounds = shipped_interval_models().interval(key, length.value_m, {**features, **mask}, more_sd)
    if bounds is None:
        return length, True
    # For a method that reads short, both ends may exceed the length: extend the interval to it.
    low_m, high_m = min(bounds[0], length.value_m), max(bounds[1], length.value_m)
    if high_m > WIDEST * low_m:
        return length, False
    basis = IntervalBasis.SIMULATED
    return replace(length, low_m=low_m, high_m=high_m, interval_of=interval_kind, basis=basis), True
