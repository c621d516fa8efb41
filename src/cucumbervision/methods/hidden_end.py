"""Length of a fruit with a hidden end, and the depth noise of a D4xx.

Three facts constrain a hidden end: it lies beyond the visible part, it does not emerge on the other
side of the occluder, and girth is correlated with length. Noise is short ripples, and waves that
shift a whole small fruit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cucumbervision.arrays import Array, Array32, Ints, Mask
from cucumbervision.capture.frames import valid_depth
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.methods.depth_doubts import LEAST_FILL
from cucumbervision.methods.result import HiddenLength, TubeFit
from cucumbervision.tube.evidence import quick_median

_DISPARITY_RMS_PX = 0.08  # within windows of 26 pixels

_WAVES_RMS_PX = 0.17  # correlated over longer distances; 0.19 pixels in total

_WAVE_SIGMA_PX = 5.0  # sigma of their smoothing, in pixels of the depth camera

_MOST_WAVES = 48

_SKIN_RMS_M = 0.0005  # additional error of a glossy or dark skin at any distance

# Depth step to the background, and blur of the matching window
_EDGE_STEP_M, _EDGE_SIGMA_PX = 0.2, 3.6

_KNOT_STEP = 1.4  # distance between knots, in sigmas

_DEPTH_FOCAL_RATIO = 0.69  # focal length of the depth camera relative to the colour camera, D435

_BASELINE_M = 0.050


def depth_noise(far_m: Array, focal_px: float) -> Array:
    """Return a D4xx's RMS depth error at a distance, metres: z² s / (f B).

    Parameters
    ----------
    far_m : ndarray of float64
        Distance along z.
    focal_px : float
        The colour camera's focal length, from which the depth camera's follows.

    Examples
    --------
    >>> bool(depth_noise(np.array(0.5), 924.0).round(5) == 0.00063)
    True
    """
    return far_m**2 * (_DISPARITY_RMS_PX / (focal_px * _DEPTH_FOCAL_RATIO * _BASELINE_M))


def edge_error(inside_px: Array32) -> Array:
    """Return the possible depth error towards the background, metres, by distance from the outline.

    A matching window across a small disparity step gives a value in between.

    Parameters
    ----------
    inside_px : ndarray of float32
        Distance from the mask's outline, pixels.

    Examples
    --------
    >>> (1000 * edge_error(np.array([4.0, 8.0, 16.0], np.float32))).round(1).tolist()
    [26.7, 2.6, 0.0]
    """
    from scipy.special import ndtr

    return np.asarray(_EDGE_STEP_M * ndtr(-np.asarray(inside_px, np.float64) / _EDGE_SIGMA_PX))


def noise_waves(pixels: Ints, far_m: Array, focal_px: float) -> Array:
    """Return the effect of each wave of smooth depth noise on each point.

    Stereo matching errors are smooth over a dozen pixels, so that a small fruit is shifted and
    tilted as a whole. White noise at knots, blurred by a Gaussian, has the same covariance. On a
    large fruit, the knots are farther apart and the waves lower, so that the long waves, which
    tilt the fruit, keep their amplitude.

    Parameters
    ----------
    pixels : ndarray of int, shape (N, 2)
        Columns and rows of the points, colour pixels.
    far_m : ndarray of float64, shape (N,)
        Their distance along z, metres.
    focal_px : float
        The colour camera's focal length.

    Returns
    -------
    ndarray of float64, shape (N, W)
        Metres, for amplitudes of standard deviation 1; at most about `_MOST_WAVES` waves.

    Examples
    --------
    >>> v, u = (m.ravel() for m in np.indices((30, 60)))
    >>> waves = noise_waves(np.stack([u, v], axis=1), np.full(1800, 1.0), 924.0)
    >>> rms = np.sqrt((waves**2).sum(axis=1)).mean()
    >>> bool(abs(rms / depth_noise(np.array(1.0), 924.0) - _WAVES_RMS_PX / _DISPARITY_RMS_PX) < 0.2)
    True
    """
    if not len(pixels):
        return np.zeros((0, 0))
    first_px, last_px = pixels.min(axis=0), pixels.max(axis=0)
    step = _KNOT_STEP * _WAVE_SIGMA_PX / _DEPTH_FOCAL_RATIO
    width, tall = last_px - first_px + 2 * step
    wider = max(1.0, float(np.sqrt(width * tall / _MOST_WAVES)) / step)
    step *= wider
    sigma = step / _KNOT_STEP
    across, down = (
        np.exp(
            -0.5 * ((coordinates[:, None] - np.arange(a - step / 2, b + step, step)) / sigma) ** 2
        )
        for coordinates, a, b in zip(pixels.T, first_px, last_px, strict=True)
    )
    shape = (down[:, :, None] * across[:, None, :]).reshape(len(pixels), -1)
    shape = shape[:, shape.max(axis=0) > np.exp(-0.5 * (step / sigma) ** 2)]
    matching = _WAVES_RMS_PX / _DISPARITY_RMS_PX / wider * depth_noise(far_m, focal_px)
    strength = np.hypot(matching, _SKIN_RMS_M) * _KNOT_STEP / np.sqrt(np.pi)
    return np.asarray(shape * strength[:, None])


_STEP_M, FARTHEST_M = 0.002, 0.40
_NEARER_M = 0.005  # an object nearer than the end by more covers it
# Depth bleeds some pixels beyond a fruit's edge, and stalk and flower are as near as the fruit. An
# end is covered if most readings just beyond it are nearer than the surface of the fruit.
_RING_PX, _AHEAD = (3.0, 12.0), 0.5  # beyond the end; cosine: within 60 degrees of straight ahead
_IN_FRONT_M, _IN_FRONT_SD, _COVERED_SHARE = 0.006, 3.0, 0.5
_LEAST_READINGS = 5
# Softness of both limits: relative to the visible length, and in metres
_SEEN_SD, _REACH_SD_M = 0.03, 0.01
_LEVEL = 0.9
_GRID = 400


@dataclass(frozen=True)
class GirthRelation:
    """Relation of length and girth: log length = a + b log diameter, in metres.

    Parameters
    ----------
    log_length, slope : float
        a and b.
    spread : float
        Standard deviation of the logarithm of the length.
    """

    log_length: float
    slope: float
    spread: float

    def excess_sd(self, length_m: float, diameter_m: float) -> float:
        """Return how far a length exceeds the usual one, in standard deviations of the logarithm.

        Examples
        --------
        >>> round(DRAWN_KINDS.excess_sd(0.34, 0.024), 1)
        5.4
        """
        usual = self.log_length + self.slope * np.log(max(diameter_m, 0.005))
        return float((np.log(length_m) - usual) / self.spread)


DRAWN_KINDS = GirthRelation(5.36, 2.16, 0.30)
"""Over drawn fruit of three kinds, gherkin to long cucumber, with room for others (0.24 there)."""


@dataclass(frozen=True)
class BeyondEnd:
    """Depth beyond one end of a body, within 60 degrees of its direction.

    Parameters
    ----------
    covered : bool
        Whether most readings just beyond the end are nearer than the fruit.
    behind : float
        Share of the pixels up to a radius beyond the end whose depth is clearly behind the fruit,
        0 to 1: a fruit that continued there would be visible.
    """

    covered: bool = False
    behind: float = 0.0


def with_hidden_end(fit: TubeFit, depth_m: Array32, intrinsics: Intrinsics) -> TubeFit:
    """Return a tube with the distribution of the whole length, if it can be estimated.

    This requires that exactly one end is hidden, by an object in the picture, and that most of the
    fruit has depth. With two hidden ends, or a fruit cut by the edge of the picture, only the lower
    bound is known.

    Parameters
    ----------
    fit : TubeFit
        The fitted tube.
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour.
    intrinsics : Intrinsics
        The colour stream's.
    """
    if fit.fill < LEAST_FILL or sum(fit.ends_seen) != 1:
        return fit
    end = -1 if fit.ends_seen[0] else 0
    reach_m = covered_reach(depth_m, intrinsics, fit.traits.axis_m, end)
    if reach_m is None:
        return fit
    seen_m = fit.traits.lengths.centreline_m
    return replace(fit, hidden_length=hidden_length(seen_m, fit.traits.diameter_max_m, reach_m))


def beyond_ends(
    depth_m: Array32, mask: Mask, intrinsics: Intrinsics, centres_m: Array, radii_m: Array
) -> tuple[BeyondEnd, BeyondEnd]:
    """Return the depth beyond the first and the last end of a body.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour.
    mask : ndarray of bool, shape (H, W)
        The fruit's pixels.
    intrinsics : Intrinsics
        The colour stream's.
    centres_m, radii_m : ndarray of float64, shape (K, 3) and (K,)
        Centres and radii of the fitted body in order, camera coordinates.

    Examples
    --------
    A fruit at 0.5 m before a wall; a leaf at 0.4 m covers the columns from 320 on:

    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> camera = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    >>> depth, mask = np.full((480, 640), 1.0, np.float32), np.zeros((480, 640), bool)
    >>> mask[216:264, 200:320] = True
    >>> depth[mask], depth[:, 320:400] = 0.5, 0.4
    >>> centres = np.stack([np.linspace(-0.08, -0.02, 9), np.zeros(9), np.full(9, 0.52)], axis=1)
    >>> ends = beyond_ends(depth, mask, camera, centres, np.full(9, 0.02))
    >>> [(end.covered, round(end.behind, 1)) for end in ends]
    [(False, 1.0), (True, 0.1)]
    """
    centres_px = intrinsics.project(centres_m)
    radii_px = np.maximum(radii_m, 0.0) * intrinsics.fx_px / centres_m[:, 2]
    body_px = float(np.median(radii_px))
    far_px, inner, ends = max(body_px, _RING_PX[1]), max(1, len(centres_px) // 16), []
    for tip, before in ((0, inner), (-1, -1 - inner)):
        reach = float(radii_px[tip]) + far_px
        rows, columns = (
            np.arange(max(int(c - reach), 0), max(min(int(c + reach) + 2, size), 0))
            for c, size in zip(centres_px[tip, ::-1], depth_m.shape, strict=True)
        )
        if not (len(rows) and len(columns)):
            ends.append(BeyondEnd())
            continue
        window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        z, fruit_mask = depth_m[window], mask[window]
        x, y = columns - centres_px[tip, 0], (rows - centres_px[tip, 1])[:, None]
        away, ahead = np.sqrt(x * x + y * y), _unit(centres_px[tip] - centres_px[before])
        read = valid_depth(z)
        surface = z[fruit_mask & read & (away < radii_px[tip] + body_px)]
        gap = away - radii_px[tip]
        is_ahead = ~fruit_mask & (gap > _RING_PX[0]) & (gap < far_px)
        is_ahead &= x * ahead[0] + y * ahead[1] > _AHEAD * away
        close = is_ahead & (gap < _RING_PX[1])
        if len(surface) < _LEAST_READINGS or not close.any():
            ends.append(BeyondEnd())
            continue
        at_m = quick_median(surface)
        noise_m = float(depth_noise(np.array(at_m), intrinsics.fx_px))
        off_m = z - at_m
        clear_m = _IN_FRONT_M + _IN_FRONT_SD * noise_m
        nearer, behind = close & read & (off_m < -clear_m), is_ahead & read & (off_m > clear_m)
        covered = bool(nearer.sum() > _COVERED_SHARE * close.sum())
        ends.append(BeyondEnd(covered, float(behind.sum() / is_ahead.sum())))
    return ends[0], ends[1]


def _unit(vector: Array) -> Array:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-9))


def covered_reach(
    depth_m: Array32, intrinsics: Intrinsics, axis_m: Array, end: int
) -> float | None:
    """Return how far a fruit could continue unseen beyond an end, metres.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour.
    intrinsics : Intrinsics
        The colour stream's.
    axis_m : ndarray of float64, shape (K, 3)
        The fitted axis from pole to pole, camera coordinates.
    end : int
        0 for its first end, -1 for its last.

    Returns
    -------
    float or None
        Distance along the direction of the axis to the first reading behind the fruit; pixels
        without a reading may hide it. None if it could leave the picture unseen.

    Examples
    --------
    A leaf at 0.4 m hides the picture's columns from 380 to 479; beyond, the wall is seen:

    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> camera = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    >>> depth = np.full((480, 640), 1.0, np.float32)
    >>> depth[:, 380:480] = 0.4
    >>> axis = np.stack([np.linspace(-0.05, 0.05, 60), np.zeros(60), np.full(60, 0.5)], axis=1)
    >>> round(covered_reach(depth, camera, axis, -1), 2)  # column 480 is x = 0.133 m at 0.5 m
    0.08
    """
    tip = axis_m[end]
    inner = axis_m[len(axis_m) // 6] if end == 0 else axis_m[-1 - len(axis_m) // 6]
    ahead = (tip - inner) / max(float(np.linalg.norm(tip - inner)), 1e-9)
    steps = np.arange(_STEP_M, FARTHEST_M, _STEP_M)
    points = tip + steps[:, None] * ahead
    front = points[:, 2] > 0.05
    columns, rows = np.rint(intrinsics.project(points[front])).astype(int).T
    height, width = depth_m.shape
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    z = np.zeros(len(inside), np.float32)
    z[inside] = depth_m[rows[inside], columns[inside]]
    open_ = inside & valid_depth(z) & (z > points[front, 2] - _NEARER_M)
    first = np.flatnonzero(open_ | ~inside)
    if not len(first):
        return FARTHEST_M
    return float(steps[first[0]]) if inside[first[0]] else None


def hidden_length(seen_m: float, diameter_m: float, reach_m: float) -> HiddenLength:
    """Return the distribution of the whole length.

    Parameters
    ----------
    seen_m : float
        Visible length, metres.
    diameter_m : float
        The largest diameter.
    reach_m : float
        How far it could continue unseen at both ends together, metres (`covered_reach`).

    Examples
    --------
    >>> hidden = hidden_length(0.20, 0.045, 0.06)
    >>> 0.20 < hidden.low_m + 0.01 < hidden.median_m < hidden.high_m < 0.28
    True
    """
    from scipy.special import ndtr

    lengths = np.exp(
        np.linspace(np.log(0.9 * seen_m), np.log(seen_m + reach_m + 4 * _REACH_SD_M), _GRID)
    )
    off = DRAWN_KINDS.excess_sd(1.0, diameter_m)  # of one metre
    by_girth = np.exp(-0.5 * (np.log(lengths) / DRAWN_KINDS.spread + off) ** 2)
    longer = ndtr(np.log(lengths / seen_m) / _SEEN_SD)
    before = ndtr((seen_m + reach_m - lengths) / _REACH_SD_M)
    weight = (by_girth + 1e-6) * longer * before
    total = np.cumsum(weight * np.gradient(lengths))
    quantiles = np.interp(
        np.array([0.5 - _LEVEL / 2, 0.5, 0.5 + _LEVEL / 2]) * total[-1], total, lengths
    )
    return HiddenLength(seen_m, float(quantiles[1]), float(quantiles[0]), float(quantiles[2]))
