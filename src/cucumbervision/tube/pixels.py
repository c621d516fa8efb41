"""Pixel operations: medians of readings, a mask's outline, the depth across it, sampled colours."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_STEPS_PX = np.array([0.5, 1.5, 2.5, 3.5])  # how far across an outline its depth is read
_PADDING_GREY = 114  # outside a picture, as the padding of network inputs


def quick_median(values: NDArray[np.floating[Any]]) -> np.floating[Any]:
    """Return the median of a few numbers in a fifth of the time of `numpy.median`.

    Parameters
    ----------
    values : ndarray of float, shape (N,)
        At least one, none of them NaN.

    Returns
    -------
    float
        The dtype of `values`.

    Examples
    --------
    >>> float(quick_median(np.array([4.0, 1.0, 3.0]))), float(quick_median(np.array([4.0, 1.0])))
    (3.0, 2.5)
    """
    half = len(values) // 2
    if len(values) % 2:
        middle: np.floating[Any] = np.partition(values, half)[half]
        return middle
    low, high = np.partition(values, (half - 1, half))[half - 1 : half + 1]
    mean: np.floating[Any] = (low + high) / values.dtype.type(2)
    return mean


def valid_median(values: NDArray[Any], valid: NDArray[np.bool_], axis: int = 0) -> NDArray[Any]:
    """Return the median along an axis over the valid entries only.

    Parameters
    ----------
    values : ndarray of float
        Any shape.
    valid : ndarray of bool
        The shape of `values`; False where an entry does not count.
    axis : int
        The axis that vanishes.

    Returns
    -------
    ndarray of float
        The dtype of `values`; NaN where no entry is valid. An even count gives the mean of the
        two middle entries.

    Examples
    --------
    >>> values = np.array([[1.0, 9.0, 2.0, 4.0], [3.0, 3.0, 3.0, 3.0]])
    >>> valid = np.array([[True, False, True, True], [False] * 4])
    >>> valid_median(values, valid, axis=1)
    array([ 2., nan])
    """
    # Invalid entries sort to the end, so the middle of the valid ones is found by their count.
    ordered = np.sort(np.where(valid, values, np.inf), axis=axis)
    count = valid.sum(axis=axis, keepdims=True)
    lower = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, axis)
    upper = np.take_along_axis(ordered, np.minimum(count // 2, values.shape[axis] - 1), axis)
    with np.errstate(invalid="ignore"):  # inf - inf where nothing is valid
        middle = lower + (upper - lower) / 2
    return np.where(count > 0, middle, np.nan).squeeze(axis).astype(values.dtype)


def median_of(values: NDArray[np.float64]) -> float:
    """Return the median of some numbers as a Python float, by `quick_median`.

    Examples
    --------
    >>> median_of(np.array([3.0, 1.0, 2.0])), median_of(np.array([4.0, 1.0, 2.0, 3.0]))
    (2.0, 2.5)
    """
    return float(quick_median(values))


def outline_cracks(mask: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the points between a pixel of the mask and a neighbour outside it.

    A body's true outline runs somewhere between the two pixels' centres, so their middle is
    unbiased, which a contour through pixel centres is not (it lies half a pixel inside).

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        Beyond its border nothing is known: no point is given there.

    Returns
    -------
    points_px : ndarray of float64, shape (N, 2)
        u, v; one of them half-integer.
    outward : ndarray of float64, shape (N, 2)
        Unit step from the mask's pixel to the other.

    Examples
    --------
    >>> mask = np.zeros((3, 4), bool)
    >>> mask[1, 1:3] = True
    >>> points, outward = outline_cracks(mask)
    >>> points[:2].tolist(), outward[:2].tolist()
    ([[0.5, 1.0], [2.5, 1.0]], [[-1.0, 0.0], [1.0, 0.0]])
    """
    v, u = np.nonzero(mask[:, 1:] != mask[:, :-1])
    across = np.where(mask[v, u], 1.0, -1.0)
    y, x = np.nonzero(mask[1:] != mask[:-1])
    below = np.where(mask[y, x], 1.0, -1.0)
    points = np.concatenate([np.stack([u + 0.5, v], axis=1), np.stack([x, y + 0.5], axis=1)])
    outward = np.concatenate(
        [np.stack([across, np.zeros(len(u))], axis=1), np.stack([np.zeros(len(x)), below], axis=1)]
    )
    return points, outward


def depth_across(
    depth_m: NDArray[Any], points_px: NDArray[Any], outward: NDArray[Any]
) -> NDArray[np.float64]:
    """Return the median depth on one side of outline points.

    Parameters
    ----------
    depth_m : ndarray of float, shape (H, W)
        0 where there is no reading.
    points_px, outward : ndarray of float, shape (N, 2)
        Points and unit steps; negate the steps to look inward.

    Returns
    -------
    ndarray of float64, shape (N,)
        Median of the readings; NaN where there is none.

    Examples
    --------
    >>> depth = np.array([[0.5, 0.5, 0.9, 0.0, 0.9]])
    >>> edge, right = np.array([[1.5, 0.0]]), np.array([[1.0, 0.0]])
    >>> depth_across(depth, edge, right).tolist(), depth_across(depth, edge, -right).tolist()
    ([0.9], [0.5])
    """
    height, width = depth_m.shape
    places_px = points_px[:, None, :] + outward[:, None, :] * _STEPS_PX[:, None]
    pixel = np.rint(places_px).astype(np.intp)
    u, v = pixel[..., 0], pixel[..., 1]
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    z = depth_m[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)].astype(np.float64)
    return valid_median(z, inside & (z > 0), axis=1)


def sample_color(
    color_rgb: NDArray[np.uint8], points_px: NDArray[np.float64], step_px: float
) -> NDArray[np.uint8]:
    """Return the colours at some points, averaged over their spacing where that is wide.

    Parameters
    ----------
    color_rgb : ndarray of uint8, shape (H, W, 3)
        The picture.
    points_px : ndarray of float64, shape (h, w, 2)
        u, v of each pixel of the result; grey outside the picture.
    step_px : float
        Spacing of the points: above one pixel, the picture is shrunk to it first.

    Returns
    -------
    ndarray of uint8, shape (h, w, 3)

    Examples
    --------
    >>> picture = np.zeros((2, 4, 3), np.uint8)
    >>> picture[:, 2:] = 200
    >>> sample_color(picture, np.array([[[0.0, 0], [1.5, 0], [3, 0], [40, 0]]]), 1.0)[0, :, 0]
    array([  0, 100, 200, 114], dtype=uint8)
    """
    import cv2

    height, width = color_rgb.shape[:2]
    along = points_px[..., 0], points_px[..., 1]  # a plane each: both at once take several times
    lowest_px, highest_px = np.array([(plane.min(), plane.max()) for plane in along]).T
    first_px = np.clip(np.floor(lowest_px) - 2, 0, (width - 1, height - 1)).astype(int)
    end_px = np.clip(np.ceil(highest_px) + 3, first_px + 1, (width, height)).astype(int)
    part = color_rgb[first_px[1] : end_px[1], first_px[0] : end_px[0]]
    before = np.array([part.shape[1], part.shape[0]])
    after = before
    if step_px > 1:
        after = np.maximum(np.rint(before / step_px), 1).astype(int)
        part = np.asarray(cv2.resize(part, after.tolist(), interpolation=cv2.INTER_AREA), np.uint8)
    places = ((points_px - first_px + 0.5) * (after / before) - 0.5).astype(np.float32)
    sampled = cv2.remap(
        part,
        places[..., 0],
        places[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(_PADDING_GREY,) * 3,
    )
    return np.asarray(sampled, np.uint8)
