"""The principal axis of a point cloud, and positions along it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class AlignedCloud:
    """A cloud with its principal axis.

    Parameters
    ----------
    points_m : ndarray of float64, shape (N, 3)
        Camera coordinates in metres.
    centroid_m, axis : ndarray of float64, shape (3,)
        From `principal_axis`; not a number below two points.
    along_m : ndarray of float64, shape (N,)
        Each point's position along the axis, metres from the centroid.
    """

    points_m: NDArray[np.float64]
    centroid_m: NDArray[np.float64]
    axis: NDArray[np.float64]
    along_m: NDArray[np.float64]


def align_near(points_m: NDArray[Any], half_width_m: float) -> AlignedCloud:
    """Gate a cloud by depth and find its principal axis: what M2, M3 and M5 begin with.

    Parameters
    ----------
    points_m : ndarray of float, shape (N, 3)
        Camera coordinates in metres.
    half_width_m : float
        As `depth_gate` takes it.

    Examples
    --------
    >>> cloud = align_near(np.array([[0.0, 0, 0.5], [0.2, 0, 0.5], [0.4, 0, 0.9]]), 0.035)
    >>> cloud.along_m.tolist()
    [-0.1, 0.1]
    """
    gated = depth_gate(points_m, half_width_m)
    if len(gated) < 2:
        nowhere = np.full(3, np.nan)
        return AlignedCloud(gated, nowhere, nowhere, np.full(len(gated), np.nan))
    centroid, axis = principal_axis(gated)
    along = np.asarray(gated @ axis - centroid @ axis, dtype=np.float64)
    return AlignedCloud(gated, centroid, axis, along)


def depth_gate(points_m: NDArray[Any], half_width_m: float) -> NDArray[Any]:
    """Keep the points whose depth is within `half_width_m` of the median depth.

    Parameters
    ----------
    points_m : ndarray of float, shape (N, 3)
        Camera coordinates in metres, z forward.
    half_width_m : float
        Half the gate's width in metres.

    Returns
    -------
    ndarray of float, shape (M, 3)
        The points kept, in their order; empty for an empty cloud.

    Examples
    --------
    >>> points = np.array([[0.0, 0.0, 0.50], [0.0, 0.0, 0.51], [0.0, 0.0, 0.90]])
    >>> depth_gate(points, 0.035)[:, 2].tolist()
    [0.5, 0.51]
    """
    if not len(points_m):
        return points_m
    z = points_m[:, 2]
    inside: NDArray[np.bool_] = np.abs(z - np.median(z)) <= half_width_m
    return points_m[inside]


def principal_axis(points_m: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the centroid and the direction of largest spread.

    The first right singular vector of the centred cloud (the paper's Eq. 2), found as the first
    eigenvector of its scatter matrix: the same vector, without an SVD of N rows.

    Parameters
    ----------
    points_m : ndarray of float, shape (N, 3)
        At least two points; pixels (N, 2) give those of a mask, in pixels.

    Returns
    -------
    centroid_m, axis : ndarray of float64, shape (3,), or (2,) of pixels
        `axis` has length 1; its largest component is positive.

    Raises
    ------
    ValueError
        For fewer than two points.

    Examples
    --------
    >>> centroid, axis = principal_axis(np.array([[0.0, 0, 1], [2.0, 0, 1], [4.0, 0, 1]]))
    >>> centroid.tolist(), axis.round(6).tolist()
    ([2.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    """
    if len(points_m) < 2:
        raise ValueError(f"{len(points_m)} points have no axis")
    centroid = points_m.mean(axis=0, dtype=np.float64)
    centred = points_m - centroid
    axis = np.linalg.eigh(centred.T @ centred)[1][:, -1]
    return centroid, axis if axis[np.argmax(np.abs(axis))] > 0 else -axis


def bin_centroids(
    points_m: NDArray[Any], along_m: NDArray[Any], bins: int, at_least: int
) -> NDArray[np.float64]:
    """Cut a cloud into equal bins along an axis and give the centroids of the filled ones.

    Parameters
    ----------
    points_m : ndarray of float, shape (N, 3)
        The cloud.
    along_m : ndarray of float, shape (N,)
        Each point's position along the axis, as `project` gives it.
    bins : int
        Number of bins from the smallest to the largest position.
    at_least : int
        Bins with fewer points are skipped.

    Returns
    -------
    ndarray of float64, shape (B, 3)
        B <= `bins` centroids, in order along the axis.

    Examples
    --------
    >>> points = np.array([[0.0, 0, 0], [1.0, 0, 0], [9.0, 0, 0], [10.0, 2.0, 0]])
    >>> bin_centroids(points, points[:, 0], bins=2, at_least=2).tolist()
    [[0.5, 0.0, 0.0], [9.5, 1.0, 0.0]]
    """
    start, stop = float(along_m.min()), float(along_m.max())
    if stop <= start:
        return np.empty((0, 3))
    index = np.minimum(((along_m - start) * (bins / (stop - start))).astype(np.intp), bins - 1)
    count = np.bincount(index, minlength=bins)
    sums = [np.bincount(index, points_m[:, k], minlength=bins) for k in range(3)]
    filled = count >= at_least
    return np.stack([s[filled] / count[filled] for s in sums], axis=1)
