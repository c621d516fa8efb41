"""Convert depth pictures to metres, and detect wrong units."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.errors import DepthError, Message, joined

if TYPE_CHECKING:
    from numpy.typing import NDArray

DEPTH_MIN_M, DEPTH_MAX_M = 0.1, 5.0


def valid_depth(depth_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which depth values are valid readings, between 0.1 and 5 m.

    Parameters
    ----------
    depth_m : ndarray of float
        Depth in metres, any shape; 0, NaN and infinity are no readings.

    Returns
    -------
    ndarray of bool
        The shape of `depth_m`.

    Examples
    --------
    >>> valid_depth(np.array([0.0, 0.05, 0.5, 9.0, np.nan], np.float32))
    array([False, False,  True, False, False])
    """
    # Comparisons with NaN are False, so NaN needs no separate test.
    return (depth_m >= DEPTH_MIN_M) & (depth_m <= DEPTH_MAX_M)


_FEW, _MOST = 0.01, 0.5
_WHOLE = 0.01  # of a millimetre, to which float32 rounds whole ones
_FINEST_M, _COARSEST_M = 1e-7, 10.0
_UNIT_NAMES = {
    1.0: "metres",
    0.001: "millimetres",
    0.0001: "steps of 0.1 mm",
    0.0002: "steps of 0.2 mm",
}


def enlarge_depth(depth_m: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Return depth with more pixels, each with the value of the nearest; nothing is interpolated.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (h, w)
        Metres; 0 for no reading.
    width, height : int
        New size, pixels.

    Examples
    --------
    >>> enlarge_depth(np.array([[0.5, 0.75]], np.float32), 4, 1)
    array([[0.5 , 0.5 , 0.75, 0.75]], dtype=float32)
    """
    import cv2

    size = (width, height)
    return np.asarray(cv2.resize(depth_m, size, interpolation=cv2.INTER_NEAREST_EXACT), np.float32)


def depth_to_metres(
    raw: NDArray[Any], unit_m: float | None = None, *, source: object = None
) -> NDArray[np.float32]:
    """Convert the raw values of a depth picture to metres.

    Parameters
    ----------
    raw : ndarray, shape (H, W) or (H, W, 1)
        Integers of at least 16 bits, or floats. NaN, infinity and negative values are invalid.
    unit_m : float, optional
        Metres per step; by default 0.001 for integers and 1 for floats.
    source : object, optional
        The file, for error messages.

    Returns
    -------
    ndarray of float32, shape (H, W)
        Metres; 0 for no reading. Readings outside 0.1 to 5 m are kept; see `valid_depth`.

    Raises
    ------
    DepthError
        If the picture has colour channels or 8 bits, the unit is implausible while metres or
        millimetres are plausible, or the numbers are shares of the largest.

    Examples
    --------
    >>> depth_to_metres(np.array([[0, 454]], np.uint16))
    array([[0.   , 0.454]], dtype=float32)
    >>> depth_to_metres(np.array([[np.nan, 0.454]]), source="a.npy", unit_m=0.001)
    Traceback (most recent call last):
    ...
    cucumbervision.errors.DepthError: a.npy: depth is declared in millimetres, ...
    """
    if raw.ndim == 3 and raw.shape[2] == 1:
        raw = raw[:, :, 0]
    _check_kind(raw, source)
    if unit_m is None:
        _refuse_shares(raw, source)
        unit_m = 1.0 if raw.dtype.kind == "f" else 0.001
    if not _FINEST_M <= unit_m <= _COARSEST_M:
        raise DepthError(
            "no camera's depth has steps of {unit:g} m",
            source=source,
            remedy="correct the unit",
            unit=unit_m,
        )
    _check_unit(raw, unit_m, source)
    return scale_depth(raw, unit_m)


def scale_depth(raw: NDArray[Any], unit_m: float) -> NDArray[np.float32]:
    """Scale depth to metres without plausibility checks; invalid values become 0.

    Examples
    --------
    >>> scale_depth(np.array([[-1.0, 454.0, np.nan]]), 0.001)
    array([[0.   , 0.454, 0.   ]], dtype=float32)
    """
    # Multiply in double precision, so that 454 * 0.001 is the float32 nearest to 0.454.
    depth_m: NDArray[np.float32] = np.multiply(raw, unit_m, dtype=np.float64).astype(np.float32)
    if raw.dtype.kind != "u":
        depth_m[~(np.isfinite(depth_m) & (depth_m > 0))] = 0.0
    return depth_m


def require_readings(depth_m: NDArray[np.float32], *, source: object = None) -> None:
    """Raise an error if depth has no valid reading.

    Raises
    ------
    DepthError
        If no reading is between 0.1 and 5 m.
    """
    if valid_depth(depth_m).any():
        return
    readings = depth_m[depth_m > 0]
    what = Message("every pixel is 0")
    if readings.size:
        ends = {"low": readings.min(), "high": readings.max()}
        what = Message("readings run from {low:.4g} to {high:.4g} m", **ends)
    raise DepthError(
        "depth has no reading between {low} and {high:.0f} m: {what}",
        source=source,
        remedy="check the depth stream and its unit, and capture again",
        low=DEPTH_MIN_M,
        high=DEPTH_MAX_M,
        what=what,
    )


def _check_kind(raw: NDArray[Any], source: object) -> None:
    if raw.ndim != 2 or not raw.size:
        fault = (
            "depth is {kind} {shape}, not one value a pixel; "
            "a colourised picture of depth has no distances"
        )
    elif raw.dtype.itemsize < 2 or raw.dtype.kind not in "uif":
        fault = "depth has {bits} bits ({kind}), a picture to look at and no distances"
    else:
        return
    parts = {"kind": raw.dtype, "shape": raw.shape, "bits": 8 * raw.dtype.itemsize}
    raise DepthError(fault, source=source, remedy="give the 16-bit depth itself", **parts)


def _refuse_shares(raw: NDArray[Any], source: object) -> None:
    """Refuse numbers that were divided by the largest: relative depth has no metres."""
    if raw.dtype.kind != "f":
        return
    readings = raw[np.isfinite(raw) & (raw > 0)]
    if readings.max(initial=0.0) != 1.0 or readings.min() == 1.0:
        return
    steps = 1000.0 * readings
    if (np.abs(steps - np.rint(steps)) > _WHOLE).mean() > _MOST:  # a camera's are whole millimetres
        raise DepthError(
            "depth is 1 at most, as shares of the largest distance are, which are no metres",
            source=source,
            remedy="give depth in metres; if it is, declare the depth unit 1 m",
        )


def _check_unit(raw: NDArray[Any], unit_m: float, source: object) -> None:
    inside = _share_inside(raw, unit_m)
    if inside > _FEW:
        return
    shares = {candidate_m: _share_inside(raw, candidate_m) for candidate_m in _UNIT_NAMES}
    fitting = [candidate_m for candidate_m, share in shares.items() if share > _MOST]
    if fitting:
        declared = _UNIT_NAMES.get(unit_m) or Message("steps of {unit:g} m", unit=unit_m)
        raise DepthError(
            "depth is declared in {declared}, but {outside:.0f} % of its readings then lie "
            "outside {low} to {high:.0f} m; in {unit} {inside:.0f} % lie inside",
            source=source,
            remedy="declare the depth unit {units}",
            units=joined((Message("{unit:g} m", unit=x) for x in fitting), "{first} or {second}"),
            declared=declared,
            outside=100 * (1 - inside),
            low=DEPTH_MIN_M,
            high=DEPTH_MAX_M,
            unit=_UNIT_NAMES[fitting[0]],
            inside=100 * shares[fitting[0]],
        )


def _share_inside(raw: NDArray[Any], unit_m: float) -> float:
    # Relative to all positive finite readings.
    first_step, last_step = DEPTH_MIN_M / unit_m, DEPTH_MAX_M / unit_m
    if raw.dtype.kind in "ui":  # comparing integers with integers is several times faster
        first_step, last_step = math.ceil(first_step), math.floor(last_step)
        readings = int(np.count_nonzero(raw > 0))
    else:
        readings = int(np.count_nonzero((raw > 0) & np.isfinite(raw)))
    return int(np.count_nonzero((raw >= first_step) & (raw <= last_step))) / max(readings, 1)
