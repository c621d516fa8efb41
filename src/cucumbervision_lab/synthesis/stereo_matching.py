"""A stereo matcher's faults: where depth jumps, where the right imager cannot see, holes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from scipy.special import ndtri

if TYPE_CHECKING:
    from numpy.typing import NDArray

_GAP_LOST = 0.95  # of the pixels in a gap
_COARSE_SIGMA = 1.5  # px of a coarse grid: the blur that cubic enlarging still draws smoothly


@dataclass(frozen=True)
class Matcher:
    """How a stereo matcher errs where depth jumps and where it finds no texture.

    Parameters
    ----------
    ramp_px : float
        Standard deviation of the blur that the matching window lays over small steps, pixels.
    jump_px : float
        Step of disparity, pixels, up to which both sides run into each other; from twice that on
        each pixel takes one side.
    fatten_px : int
        How far at most the nearer side grows over such a jump, pixels.
    gap_px : int
        Width of the gap that such a jump leaves on its farther side, pixels.
    border_lost : float
        Share of the nearer side's border pixels lost at such a jump.
    steep : float
        Slope of the blurred disparity, pixels a pixel, above which there is no reading.
    flying_share : float
        Share of all those pixels that read something between both sides nevertheless.
    hidden_filled : float
        Share of what the right imager cannot see that is read nevertheless, as the farther side.
    thin_px : int
        What is thinner is lost by `thin_lost` of its pixels.
    thin_lost : float
        See `thin_px`.
    speckle : float
        Share of lonely pixels anywhere without a reading.
    clump_px : float
        Size of holes in clumps, pixels.
    """

    ramp_px: float = 2.5
    jump_px: float = 8.0
    fatten_px: int = 1
    gap_px: int = 5
    border_lost: float = 0.3
    steep: float = 1.3
    flying_share: float = 0.02
    hidden_filled: float = 0.06
    thin_px: int = 5
    thin_lost: float = 0.6
    speckle: float = 0.0003
    clump_px: float = 5.0


@dataclass(frozen=True, eq=False)
class Matched:
    """What stays the same in all frames of a burst.

    Parameters
    ----------
    disparity_px : ndarray of float32, shape (H, W)
        Without noise.
    valid : ndarray of bool, shape (H, W)
        Where there is a reading in most frames.
    unsure : ndarray of bool, shape (H, W)
        Where readings come and go: along the jumps.
    """

    disparity_px: NDArray[np.float32]
    valid: NDArray[np.bool_]
    unsure: NDArray[np.bool_]


def smooth_field(
    shape: tuple[int, ...], sigma_px: float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Generate normal noise, smooth over some pixels, of mean 0 and standard deviation 1.

    Parameters
    ----------
    shape : tuple of int
        (H, W).
    sigma_px : float
        Standard deviation of the Gaussian that white noise is blurred by.
    rng : numpy.random.Generator
        Random generator.

    Notes
    -----
    Wide blurs are drawn on a coarser grid and enlarged, which is many times faster.

    Examples
    --------
    >>> field = smooth_field((300, 400), 6.0, np.random.default_rng(1))
    >>> round(float(field.std()), 1), round(float(np.corrcoef(field[:-6].ravel(),
    ...     field[6:].ravel())[0, 1]), 1)  # by hand: exp(-6² / (4 · 6²)) = 0.78
    (1.0, 0.8)
    """
    height, width = shape
    scale = max(1.0, sigma_px / _COARSE_SIGMA)
    coarse = int(np.ceil(height / scale)) + 4, int(np.ceil(width / scale)) + 4
    white = rng.standard_normal(coarse, dtype=np.float32)
    field = cv2.GaussianBlur(white, (0, 0), sigma_px / scale)
    if scale > 1:
        size = round(coarse[1] * scale), round(coarse[0] * scale)
        field = cv2.resize(field, size, interpolation=cv2.INTER_CUBIC)
    field = field[:height, :width]
    # By theory, not by this draw: a wide blur's few waves must be free to differ in strength.
    strength = np.float32(2 * np.sqrt(np.pi) * sigma_px / scale)
    return np.asarray(field * strength, np.float32)


def _hidden_from_right(disparity_px: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which pixels of the left imager the right one cannot see.

    The point at column x is seen at x - d by the right imager; it is hidden when something
    further right in the row is seen there or left of it. The band stands to the left of what is
    near, and is as wide as the jump of disparity.

    Parameters
    ----------
    disparity_px : ndarray of float32, shape (H, W)
        The left imager's.

    Examples
    --------
    >>> row = np.array([[2, 2, 2, 2, 2, 5, 5, 2, 2]], np.float32)
    >>> _hidden_from_right(row)[0].astype(int).tolist()
    [0, 0, 1, 1, 1, 0, 0, 0, 0]
    """
    at = np.arange(disparity_px.shape[1], dtype=np.float32) - disparity_px
    least = np.minimum.accumulate(at[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(at.shape, np.bool_)
    # A quarter pixel of slack: the far side's last pixel must not fall by rounding.
    hidden[:, :-1] = least[:, 1:] < at[:, :-1] + 0.25
    return hidden


def match(disparity_px: NDArray[np.float32], matcher: Matcher, rng: np.random.Generator) -> Matched:
    """Simulate a stereo matcher on exact disparity, before noise.

    Parameters
    ----------
    disparity_px : ndarray of float32, shape (H, W)
        Exact; 0 where nothing is.
    matcher : Matcher
        How it errs.
    rng : numpy.random.Generator
        Random generator.

    Returns
    -------
    Matched
        The part that a burst shares.
    """
    blurred = cv2.GaussianBlur(disparity_px, (0, 0), matcher.ramp_px)
    soft = np.asarray(blurred, np.float32)
    reach = 2 * int(np.ceil(2.0 * matcher.ramp_px)) + 1
    steps = _steps(disparity_px, reach) / np.float32(matcher.jump_px)
    apart = np.asarray(np.clip(steps - np.float32(1), 0, 1), np.float32)
    sharp = _fattened(disparity_px, matcher, rng)
    read = np.asarray(soft + apart * (sharp - soft), np.float32)

    clump = smooth_field(read.shape, matcher.clump_px / 2, rng)
    # Small steps leave holes where the ramp is steep, great ones a gap on the farther side.
    slope = (1 - apart) * _steps(soft, 3) / np.float32(2)
    lost = slope > np.float32(matcher.steep) * (np.float32(1) + np.float32(0.25) * clump)
    gap = cv2.dilate(sharp, _disc(matcher.gap_px)) - sharp > np.float32(matcher.jump_px)
    lost |= gap & (clump < _quantile(_GAP_LOST))
    border = sharp - cv2.erode(sharp, _disc(1)) > np.float32(matcher.jump_px)
    lost |= border & (clump < _quantile(matcher.border_lost))
    flying = lost & (rng.random(read.shape, dtype=np.float32) < matcher.flying_share)
    read[flying] = soft[flying]
    hidden = _hidden_from_right(read)
    lost = (lost & ~flying) | (hidden & (clump < _quantile(1 - matcher.hidden_filled)))
    lost |= _thin(disparity_px, matcher) & (clump < _quantile(matcher.thin_lost))
    lost |= rng.random(read.shape, dtype=np.float32) < matcher.speckle
    unsure = np.abs(slope - np.float32(matcher.steep)) < np.float32(0.25 * matcher.steep)
    unsure |= border
    return Matched(read, ~lost & (disparity_px > 0) & (read > 0), unsure)


def _disc(radius_px: int) -> NDArray[np.uint8]:
    side = 2 * radius_px + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)


def _steps(disparity_px: NDArray[np.float32], window_px: int) -> NDArray[np.float32]:
    window = np.ones((window_px, window_px), np.uint8)
    return cv2.dilate(disparity_px, window) - cv2.erode(disparity_px, window)


def _fattened(
    disparity_px: NDArray[np.float32], matcher: Matcher, rng: np.random.Generator
) -> NDArray[np.float32]:
    # The matching window sees the nearer side's edge before its middle is there; how much before
    # depends on the texture, so the border is ragged.
    texture = smooth_field(disparity_px.shape, 3.0, rng)
    fat = disparity_px.copy()
    for k in range(1, matcher.fatten_px + 1):
        grown = cv2.dilate(disparity_px, _disc(k))
        wide = texture > _quantile(1 - (matcher.fatten_px + 1 - k) / (matcher.fatten_px + 1))
        np.copyto(fat, grown, where=wide)
    return fat


def _thin(disparity_px: NDArray[np.float32], matcher: Matcher) -> NDArray[np.bool_]:
    window = np.ones((matcher.thin_px, matcher.thin_px), np.uint8)
    opened = cv2.morphologyEx(disparity_px, cv2.MORPH_OPEN, window)
    return np.asarray(disparity_px - opened > matcher.jump_px)


def _quantile(share: float) -> float:
    return float(ndtri(share))
