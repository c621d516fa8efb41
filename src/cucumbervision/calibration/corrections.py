"""Fit a site's correction to hand-measured fruit, and say honestly what is left of the error."""

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

_ROUNDS = 50

_TOLERANCE = 1e-9


class Form(StrEnum):
    """How a reading is corrected: not at all, times a factor, or with an offset besides."""

    NONE = "none"
    SCALE = "scale"
    SCALE_OFFSET = "scale+offset"


_MIN_FRUIT = {Form.SCALE: 6, Form.SCALE_OFFSET: 10}


@dataclass(frozen=True)
class Fit:
    """One method's correction: true length = scale x reading + offset.

    Parameters
    ----------
    form : Form
        Which correction.
    scale : float
        The factor; 1 where there is none.
    offset_m : float
        Metres; 0 where there is none.
    reason : str
        Why this form and not a richer one.
    fruit, captures : int
        Physical fruit and readings of them.
    error_before_percent, error_after_percent : float
        Mean absolute relative error without any correction, and with this one fitted without the
        fruit it is tried on; every fruit counts once, however often it was captured.
    residual_sd_percent : float
        Standard deviation of the relative error that is left, weighted in the same way.
    half_width : float, optional
        The interval reaches this share of the corrected length to both sides; None where there
        are too few fruit for the level.
    raw_range_m : tuple of float
        Shortest and longest reading, metres; beyond them the correction is a guess.
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


def fit_correction(
    raw_m: ArrayLike, truth_m: ArrayLike, fruit: Sequence[Hashable], level: float = LEVEL
) -> Fit:
    """Fit the correction that helps, by leaving one fruit out at a time.

    Relative errors are fitted, by Huber's estimator, each fruit with the same weight however
    often it was captured. A richer form is taken only where there are enough fruit for it
    (`_MIN_FRUIT`) and where it lowers the error of the fruit left out by more than the standard
    error of that gain.

    Parameters
    ----------
    raw_m, truth_m : array_like of float, shape (N,)
        Readings and true lengths, metres, all positive and finite.
    fruit : sequence of hashable, length N
        The physical fruit of each reading; all readings of one are left out together.
    level : float
        Level of the interval.

    Returns
    -------
    Fit

    Raises
    ------
    ValueError
        If there is nothing to fit, or a length is not positive.

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
    for form, least in _MIN_FRUIT.items():
        if len(names) < least:
            reasons.append(f"{form} needs {least} fruit, there are {len(names)}")
            continue
        held_out[form] = _leave_one_out(form, raw, truth, member)
        gain, error = _gain(held_out[chosen], held_out[form], truth, member)
        verdict = f"{form} gains {gain:.2f} points, standard error {error:.2f}"
        if gain > max(error, _LEAST_GAIN_POINTS):
            chosen, reasons = form, [verdict]
        else:
            reasons.append(f"{verdict}: no help")
    scale, offset = _fit(chosen, raw, truth, _weights(member))
    left = held_out[chosen]
    relative, weights = left / truth - 1, _weights(member) / len(names)
    centred = relative - float(weights @ relative)
    # Scores are shares of the corrected length, which is what is known when it is applied.
    scores = np.where(left > 0, np.abs(truth / np.maximum(left, 1e-12) - 1), np.inf)
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
        half_width=conformal_half_width(scores, member, level),
        raw_range_m=(float(raw.min()), float(raw.max())),
    )


def conformal_half_width(
    scores: ArrayLike, fruit: Sequence[Hashable] | NDArray[np.int64], level: float = LEVEL
) -> float | None:
    """Compute the score that a reading of a new fruit stays below with probability `level`.

    Hierarchical conformal prediction (Lee, Barber and Willett, 2023): each of K fruit carries the
    weight 1/(K + 1), shared by its readings, and the new fruit 1/(K + 1) at infinity, so that
    captures of one fruit do not pass for independent ones. With one reading a fruit this is the
    k-th smallest score, k = ceil(level (K + 1)).

    Parameters
    ----------
    scores : array_like of float, shape (N,)
        Errors of fruit left out of the fit, positive.
    fruit : sequence of hashable, length N
        The physical fruit of each.
    level : float
        Wanted probability.

    Returns
    -------
    float or None
        None where K is too small for the level (below 9 fruit at 0.9), or where the score that
        it takes is no number.

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
    reached = np.cumsum(_weights(member)[order]) >= level * (len(names) + 1) - 1e-9
    if not reached.any():
        return None
    width = float(values[order][int(np.argmax(reached))])
    return width if np.isfinite(width) else None


def _weights(member: NDArray[np.intp]) -> NDArray[np.float64]:
    return np.asarray(1.0 / np.bincount(member)[member])


def _fit(
    form: Form,
    raw: NDArray[np.float64],
    truth: NDArray[np.float64],
    weights: NDArray[np.float64],
) -> tuple[float, float]:
    if form is Form.NONE:
        return 1.0, 0.0
    columns = [raw / truth] if form is Form.SCALE else [raw / truth, 1 / truth]
    design = np.stack(columns, axis=1)
    trust = np.ones_like(raw)
    solution: NDArray[np.float64] = np.zeros(len(columns))
    for _ in range(_ROUNDS):
        root = np.sqrt(weights * trust)
        before = solution
        solution = np.asarray(np.linalg.lstsq(design * root[:, None], root, rcond=None)[0], float)
        residual = np.abs(design @ solution - 1)
        # The floor keeps readings without any noise from being torn apart by rounding.
        bound = _HUBER * max(1.4826 * float(np.median(residual)), 1e-9)
        trust = np.minimum(1.0, bound / np.maximum(residual, 1e-12))
        if np.abs(solution - before).max() < _TOLERANCE:
            break
    return float(solution[0]), float(solution[1]) if form is Form.SCALE_OFFSET else 0.0


def _leave_one_out(
    form: Form,
    raw: NDArray[np.float64],
    truth: NDArray[np.float64],
    member: NDArray[np.intp],
) -> NDArray[np.float64]:
    weights, found = _weights(member), np.empty_like(raw)
    for k in range(int(member.max()) + 1):
        out = member == k
        found[out] = corrected(raw[out], *_fit(form, raw[~out], truth[~out], weights[~out]))
    return found


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
