"""Fit a site's correction to manual lengths, and estimate the remaining error."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Hashable, Sequence

    from numpy.typing import ArrayLike, NDArray

LEVEL = 0.90

_HUBER = 1.345

_LEAST_GAIN_POINTS = 0.01

_MOST_ITERATIONS = 50

_TOLERANCE = 1e-9


class Form(StrEnum):
    """Form of a correction: none, scale, or scale and offset."""

    NONE = "none"
    SCALE = "scale"
    SCALE_OFFSET = "scale+offset"


_MIN_FRUIT = {Form.SCALE: 6, Form.SCALE_OFFSET: 10}


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Fitted correction of one method: true length = scale x reading + offset.

    Parameters
    ----------
    form : Form
        Form of the correction.
    scale : float
        Scale factor.
    offset_m : float
        Offset, metres.
    reason : str
        Why no form with more parameters was chosen.
    fruit, captures : int
        Number of physical fruit, and of their readings.
    error_before_percent, error_after_percent : float
        Mean absolute relative error without correction, and with leave-one-fruit-out correction;
        every fruit has the same weight.
    residual_sd_percent : float
        Standard deviation of the remaining relative error with the same weights.
    half_width : float, optional
        Half width of the interval relative to the corrected length; None with too few fruit for
        the level.
    raw_range_m : tuple of float
        Shortest and longest reading, metres; outside, the correction is an extrapolation.
    """

    form: Form
    scale: float
    offset_m: float
    reason: str
    fruit: int
    captures: int
    error_before_percent: float
    error_after_percent: float
    residual_sd_percent: float
    half_width: float | None
    raw_range_m: tuple[float, float]


def corrected(raw_m: ArrayLike, scale: float, offset_m: float) -> NDArray[np.float64]:
    """Apply a correction.

    Examples
    --------
    >>> corrected([0.20, 0.30], 1.1, -0.01).round(6).tolist()
    [0.21, 0.32]
    """
    return np.asarray(scale * np.asarray(raw_m, float) + offset_m, float)


def fit_correction(raw_m: ArrayLike, truth_m: ArrayLike, fruit: Sequence[Hashable]) -> Fit:
    """Choose and fit a correction by leave-one-fruit-out cross-validation.

    Relative errors are fitted by Huber's estimator with the same weight for every fruit. A form
    with more parameters is chosen only if there are enough fruit (`_MIN_FRUIT`) and it reduces the
    cross-validated error by more than the standard error of the gain.

    Parameters
    ----------
    raw_m, truth_m : array_like of float, shape (N,)
        Readings and true lengths, metres, all positive and finite.
    fruit : sequence of hashable, length N
        Physical fruit of each reading; all readings of a fruit are left out together.

    Returns
    -------
    Fit
        The chosen correction.

    Raises
    ------
    ValueError
        If there are no readings, or a length is not positive.

    Examples
    --------
    >>> truth = np.array([0.12, 0.15, 0.18, 0.21, 0.25, 0.30])
    >>> fit = fit_correction(truth / 1.05, truth, list("abcdef"))
    >>> str(fit.form), round(fit.scale, 4), round(fit.error_before_percent, 2)
    ('scale', 1.05, 4.76)
    """
    raw, truth = np.asarray(raw_m, float), np.asarray(truth_m, float)
    if not raw.size or not ((raw > 0) & (truth > 0)).all():
        raise ValueError("readings and true lengths must be positive, and at least one")
    names, member = np.unique([str(name) for name in fruit], return_inverse=True)
    held_out = {Form.NONE: raw}
    chosen, reasons = Form.NONE, []
    for form, least_fruit in _MIN_FRUIT.items():
        if len(names) < least_fruit:
            reasons.append(f"{form} needs {least_fruit} fruit, there are {len(names)}")
            continue
        held_out[form] = _leave_one_out(form, raw, truth, member)
        gain, error = _gain(held_out[chosen], held_out[form], truth, member)
        verdict = f"{form} gains {gain:.2f} points, standard error {error:.2f}"
        if gain > max(error, _LEAST_GAIN_POINTS):
            chosen, reasons = form, [verdict]
        else:
            reasons.append(f"{verdict}: no help")
    scale, offset = _fit(chosen, raw, truth, _weights(member))
    if scale <= 0:
        reasons.append("it reads shorter, the longer the fruit is: no correction")
        chosen, scale, offset = Form.NONE, 1.0, 0.0
    predicted = held_out[chosen]
    relative, weights = predicted / truth - 1, _weights(member) / len(names)
    centred = relative - float(weights @ relative)
    # Scores are relative to the corrected length, because only that is known at run time.
    scores = np.where(predicted > 0, np.abs(truth / np.maximum(predicted, 1e-12) - 1), np.inf)
    return Fit(
        form=chosen,
        scale=scale,
        offset_m=offset,
        reason="; ".join(reasons),
        fruit=len(names),
        captures=raw.size,
        error_before_percent=100 * float(weights @ np.abs(raw / truth - 1)),
        error_after_percent=100 * float(weights @ np.abs(relative)),
        residual_sd_percent=100 * float(np.sqrt(weights @ centred**2)),
        half_width=conformal_half_width(scores, member),
        raw_range_m=(float(raw.min()), float(raw.max())),
    )


def conformal_half_width(
    scores: ArrayLike, fruit: Sequence[Hashable] | NDArray[np.int64]
) -> float | None:
    """Return the score that a reading of a new fruit does not exceed with probability `LEVEL`.

    Hierarchical conformal prediction (Lee, Barber and Willett, 2023): each of K fruit has the
    weight 1/(K + 1), shared by its readings, and the new fruit has 1/(K + 1) at infinity, because
    captures of one fruit are not independent. With one reading per fruit, this is the k-th smallest
    score, k = ceil(LEVEL (K + 1)).

    Parameters
    ----------
    scores : array_like of float, shape (N,)
        Positive errors of fruit left out of the fit.
    fruit : sequence of hashable, length N
        Physical fruit of each score.

    Returns
    -------
    float or None
        None if K is too small for the level (below 9 fruit at 0.9), or the score is NaN.

    Examples
    --------
    >>> conformal_half_width([1, 2, 3, 4, 5, 6, 7, 8, 9], list("abcdefghi"))
    9.0
    >>> conformal_half_width([1, 2, 3, 4, 5, 6, 7, 8], list("abcdefgh")) is None
    True
    """
    values = np.asarray(scores, float)
    names, member = np.unique([str(name) for name in fruit], return_inverse=True)
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(_weights(member)[order]) >= LEVEL * (len(names) + 1) - 1e-9
    if not reached.any():
        return None
    width = float(values[order][int(np.argmax(reached))])
    return width if np.isfinite(width) else None


def _weights(member: NDArray[np.intp]) -> NDArray[np.float64]:
    return np.asarray(1.0 / np.bincount(member)[member])


def _fit(
    form: Form, raw: NDArray[np.float64], truth: NDArray[np.float64], weights: NDArray[np.float64]
) -> tuple[float, float]:
    if form is Form.NONE:
        return 1.0, 0.0
    columns = [raw / truth] if form is Form.SCALE else [raw / truth, 1 / truth]
    design = np.stack(columns, axis=1)
    trust = np.ones_like(raw)
    solution: NDArray[np.float64] = np.zeros(len(columns))
    for _ in range(_MOST_ITERATIONS):
        root = np.sqrt(weights * trust)
        before = solution
        solution = np.asarray(np.linalg.lstsq(design * root[:, None], root, rcond=None)[0], float)
        residual = np.abs(design @ solution - 1)
        # The floor avoids dividing by rounding errors if readings have no noise.
        bound = _HUBER * max(1.4826 * float(np.median(residual)), 1e-9)
        trust = np.minimum(1.0, bound / np.maximum(residual, 1e-12))
        if np.abs(solution - before).max() < _TOLERANCE:
            break
    return float(solution[0]), float(solution[1]) if form is Form.SCALE_OFFSET else 0.0


def _leave_one_out(
    form: Form, raw: NDArray[np.float64], truth: NDArray[np.float64], member: NDArray[np.intp]
) -> NDArray[np.float64]:
    weights, predicted = _weights(member), np.empty_like(raw)
    for k in range(int(member.max()) + 1):
        out = member == k
        predicted[out] = corrected(raw[out], *_fit(form, raw[~out], truth[~out], weights[~out]))
    return predicted


def _by_fruit(values: NDArray[np.float64], member: NDArray[np.intp]) -> NDArray[np.float64]:
    return np.asarray(np.bincount(member, values) / np.bincount(member))


def _gain(
    simpler_m: NDArray[np.float64],
    richer_m: NDArray[np.float64],
    truth_m: NDArray[np.float64],
    member: NDArray[np.intp],
) -> tuple[float, float]:
    worse = np.abs(simpler_m / truth_m - 1) - np.abs(richer_m / truth_m - 1)
    gains = 100 * _by_fruit(worse, member)
    return float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(len(gains)))
