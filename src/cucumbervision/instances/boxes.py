"""Boxes x1, y1, x2, y2: areas, overlaps, suppression."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def box_areas(boxes: NDArray[Any]) -> NDArray[np.float64]:
    """Compute the areas of boxes, shape (N, 4); 0 where one has no extent."""
    return np.asarray(np.clip(boxes[:, 2:] - boxes[:, :2], 0, None).prod(axis=1), np.float64)


def _box_intersections(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.float64]:
    """Compute the intersection area of every pair of boxes.

    Parameters
    ----------
    a, b : ndarray, shape (N, 4) and (M, 4)
        Boxes x1, y1, x2, y2.

    Returns
    -------
    ndarray of float64, shape (N, M)
    """
    lower = np.maximum(a[:, None, :2], b[None, :, :2])
    upper = np.minimum(a[:, None, 2:], b[None, :, 2:])
    return np.asarray(np.clip(upper - lower, 0, None).prod(axis=2), np.float64)


def box_ious(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.float64]:
    """Compute the intersection over union of every pair; 0 where neither has an area.

    Parameters
    ----------
    a, b : ndarray, shape (N, 4) and (M, 4)
        Boxes x1, y1, x2, y2.

    Returns
    -------
    ndarray of float64, shape (N, M)

    Examples
    --------
    >>> box_ious(np.array([[0.0, 0, 2, 1]]), np.array([[1.0, 0, 3, 1], [5, 5, 6, 6]])).round(3)
    array([[0.333, 0.   ]])
    """
    shared = _box_intersections(a, b)
    union = box_areas(a)[:, None] + box_areas(b)[None] - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)


def box_iou(a: NDArray[Any], b: NDArray[Any]) -> float:
    """Compute the intersection over union of two boxes.

    Examples
    --------
    >>> box_iou(np.array([0.0, 0, 2, 1]), np.array([1.0, 0, 3, 1])) == 1 / 3
    True
    """
    return float(box_ious(np.asarray(a)[None], np.asarray(b)[None])[0, 0])


def share_inside(boxes: NDArray[Any], regions: NDArray[Any]) -> NDArray[np.float64]:
    """Compute the largest share of each box's area that lies within one of the regions.

    Parameters
    ----------
    boxes, regions : ndarray, shape (N, 4) and (M, 4)
        Boxes x1, y1, x2, y2.

    Returns
    -------
    ndarray of float64, shape (N,)

    Examples
    --------
    >>> share_inside(np.array([[0.0, 0, 4, 1]]), np.array([[1.0, 0, 9, 9]]))
    array([0.75])
    """
    shared = _box_intersections(boxes, regions).max(axis=1, initial=0.0)
    return np.asarray(shared / np.maximum(box_areas(boxes), 1e-12))


def suppress(
    boxes: NDArray[Any], scores: NDArray[Any], classes: NDArray[Any], iou: float
) -> NDArray[np.intp]:
    """Return the boxes kept by non-maximum suppression within each class.

    Parameters
    ----------
    boxes : ndarray, shape (N, 4)
        x1, y1, x2, y2.
    scores : ndarray, shape (N,)
        Above 0, at most 1.
    classes : ndarray of int, shape (N,)
    iou : float
        Overlap above which the lower score is dropped.

    Returns
    -------
    ndarray of int
        Indices of the boxes kept, best first.

    Examples
    --------
    >>> boxes = np.array([[2.0, 0, 6, 4], [0, 0, 4, 3.9], [0, 0, 4, 4], [0, 0, 4, 4]])
    >>> suppress(boxes, np.array([0.7, 0.8, 0.9, 0.6]), np.array([0, 0, 0, 1]), 0.7).tolist()
    [2, 0, 3]
    """
    import cv2

    # OpenCV separates classes by shifting their boxes, which must begin at 0.
    corners, opposite = np.split(boxes.astype(np.float64), 2, axis=1)
    rectangles = np.concatenate(
        [corners - corners.min(axis=0, initial=0.0), opposite - corners], axis=1
    )
    chosen = cv2.dnn.NMSBoxesBatched(
        rectangles.tolist(), scores.tolist(), classes.tolist(), score_threshold=0, nms_threshold=iou
    )
    return np.array(chosen, np.intp)
