"""Paste real fruit, cut out of photos by their masks, into synthetic frames.

A pasted fruit has a depth: nearer parts of the frame occlude it, and it occludes farther parts.
Its label is a pseudo-label, because a network predicted the mask. It has no length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from cucumbervision.capture.pictures import read_color
from cucumbervision.perception.masks import box_of_mask
from cucumbervision.perception.yolo import BY_PLACE
from cucumbervision_lab.datasets.labels import KEYPOINT_ORDER, Label
from cucumbervision_lab.synthesis.scene import reaches_border

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cucumbervision_lab.datasets.labels import DataSet

_MARGIN_PX = 4
_LEAST_SIDE_PX = 40
_LEAST_PX = 60
_SOLID = 0.78
_LENGTH_SHARE = (0.10, 0.55)  # length of fruit relative to the frame's longer side
LEAST_SEEN = 0.12


@dataclass(frozen=True, eq=False)
class Cutout:
    """A fruit cut out of a photo.

    Parameters
    ----------
    color : ndarray of uint8, shape (h, w, 3)
        RGB.
    mask : ndarray of bool, shape (h, w)
        Mask of the fruit.
    keypoints : ndarray of float64, shape (5, 3), optional
        Keypoints in pixels of the cutout.
    by_place : bool
        Whether the keypoints are ordered by position because the stem end is unknown.
    """

    color: NDArray[np.uint8]
    mask: NDArray[np.bool_]
    keypoints: NDArray[np.float64] | None
    by_place: bool = False


def cutouts_of(dataset: DataSet, split: str = "train") -> tuple[Cutout, ...]:
    """Cut out all complete fruit of a split.

    Parameters
    ----------
    dataset : DataSet
        Data set with masks. Labels that are ignored, cut off, occluded or smaller than 40 px are
        skipped.
    split : str
        Split to use; do not use the test split.

    Raises
    ------
    CaptureError
        If a picture cannot be read.
    """
    found = []
    for picture in dataset.in_split(split):
        masks = [_whole_mask(label, picture.width, picture.height) for label in picture.labels]
        if any(mask is not None for mask in masks):
            color = read_color(dataset.path(picture))
            pairs = zip(picture.labels, masks, strict=True)
            found += [_cut(color, m, label) for label, m in pairs if m is not None]
    return tuple(found)


def _whole_mask(label: Label, width: int, height: int) -> NDArray[np.bool_] | None:
    """Return the mask of a complete, convex fruit, or None; a hand would cause concavities."""
    x1, y1, x2, y2 = label.box
    inside = x1 > 1 and y1 > 1 and x2 < width - 2 and y2 < height - 2
    hidden = label.ignore or label.cut_off or (label.hidden_share or 0) > 0.05
    if hidden or not inside or max(x2 - x1, y2 - y1) < _LEAST_SIDE_PX:
        return None
    mask = label.mask
    if mask is None:
        return None
    hull = cv2.convexHull(np.argwhere(mask).astype(np.int32))
    share = np.count_nonzero(mask) / max(cv2.contourArea(hull), 1.0)
    return mask if share >= _SOLID else None


def _cut(color: NDArray[np.uint8], mask: NDArray[np.bool_], label: Label) -> Cutout:
    x1, y1, x2, y2 = box_of_mask(mask)
    left, top = max(int(x1) - _MARGIN_PX, 0), max(int(y1) - _MARGIN_PX, 0)
    part = np.s_[top : int(y2) + _MARGIN_PX, left : int(x2) + _MARGIN_PX]
    points = label.keypoints
    if points is not None:
        points = points - np.array([left, top, 0.0])
    # Erode, because the outermost pixels contain background.
    body = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    by_place = label.extras.get(KEYPOINT_ORDER) == BY_PLACE
    return Cutout(color[part].copy(), body[part].copy(), points, by_place)


def paste(
    color: NDArray[np.uint8],
    depth_m: NDArray[np.float64],
    labels: Sequence[Label],
    cutouts: Sequence[Cutout],
    count: int,
    rng: np.random.Generator,
) -> tuple[NDArray[np.uint8], tuple[Label, ...]]:
    """Paste fruit into a frame.

    Parameters
    ----------
    color : ndarray of uint8, shape (H, W, 3)
        RGB; not modified.
    depth_m : ndarray of float64, shape (H, W)
        Exact depth, metres; 0 for no object.
    labels : sequence of Label
        Labels of the frame.
    cutouts : sequence of Cutout
        Fruit to choose from.
    count : int
        Number of fruit to paste.
    rng : numpy.random.Generator
        Random generator.

    Returns
    -------
    color : ndarray of uint8, shape (H, W, 3)
        RGB.
    labels : tuple of Label
        Labels of the frame without newly occluded parts, and pseudo-labels of the pasted fruit.
    """
    picture, depth = color.copy(), np.where(depth_m > 0, depth_m, np.inf)
    kept = list(labels)
    for _ in range(count if cutouts else 0):
        fruit = place_cutout(
            cutouts[int(rng.integers(len(cutouts)))],
            picture.shape[:2],
            rng,
            length_px=rng.uniform(*_LENGTH_SHARE) * max(picture.shape[:2]),
            turn_deg=rng.uniform(0, 360),
        )
        if fruit is None:
            continue
        amodal = fruit.amodal
        near, far = np.percentile(depth[amodal], [10, 60])
        stand = float(np.clip(rng.uniform(near, max(far, near)) - 0.03, 0.2, 3.0))
        seen = amodal & (depth > stand)
        if seen.sum() < LEAST_SEEN * amodal.sum():
            continue
        blend = (fruit.alpha * (depth > stand))[..., None]
        picture = (picture * (1 - blend) + fruit.color * blend).astype(np.uint8)
        depth = np.where(seen, stand, depth)
        kept = [x for x in (less(label, seen) for label in kept) if x is not None]
        kept.append(label_of(seen, amodal, fruit.keypoints, by_place=fruit.by_place))
    return picture, tuple(kept)


@dataclass(frozen=True, eq=False)
class Placed:
    """A transformed cutout.

    Parameters
    ----------
    color : ndarray of float32, shape (H, W, 3)
        RGB, 0 to 255; black outside the fruit.
    alpha : ndarray of float32, shape (H, W)
        Coverage of each pixel, 0 to 1.
    keypoints : ndarray of float64, shape (5, 3), optional
        Keypoints in pixels of the picture.
    by_place : bool
        See `Cutout`.
    """

    color: NDArray[np.float32]
    alpha: NDArray[np.float32]
    keypoints: NDArray[np.float64] | None
    by_place: bool = False

    @property
    def amodal(self) -> NDArray[np.bool_]:
        """Mask of the fruit without occlusion."""
        return self.alpha > 0.5


def place_cutout(
    cutout: Cutout,
    shape: tuple[int, int],
    rng: np.random.Generator,
    *,
    length_px: float,
    turn_deg: float,
) -> Placed | None:
    """Transform a cutout to a random position with a random brightness.

    Parameters
    ----------
    cutout : Cutout
        The fruit.
    shape : tuple of int
        Height and width of the picture.
    rng : numpy.random.Generator
        Random generator.
    length_px : float
        Longer side of the box before rotation; the scale is limited to 1.3.
    turn_deg : float
        Rotation, degrees.

    Returns
    -------
    Placed or None
        None if too little of the fruit is inside the picture.
    """
    height, width = shape
    h, w = cutout.mask.shape
    # Enlarging further would blur the fruit.
    scale = min(length_px / max(h, w), 1.3)
    turn = np.deg2rad(turn_deg)
    flip = rng.choice([-1.0, 1.0])
    linear = scale * np.array(
        [[np.cos(turn) * flip, -np.sin(turn)], [np.sin(turn) * flip, np.cos(turn)]]
    )
    spot = rng.uniform(0.1, 0.9, 2) * (width, height)
    shift = spot - linear @ np.array([(w - 1) / 2, (h - 1) / 2])
    matrix = np.column_stack([linear, shift])
    tone = rng.uniform(0.6, 1.25) * rng.uniform(0.94, 1.06, 3)
    toned = np.clip(cutout.color * tone, 0, 255).astype(np.float32)
    if scale < 0.7:
        # Low-pass filter against aliasing.
        toned = cv2.GaussianBlur(toned, (0, 0), 0.35 / scale).astype(np.float32)
    fruit = cv2.warpAffine(toned, matrix, (width, height), flags=cv2.INTER_LINEAR)
    soft = cv2.GaussianBlur(cutout.mask.astype(np.float32), (0, 0), max(0.6, 0.4 / scale))
    alpha = cv2.warpAffine(soft, matrix, (width, height), flags=cv2.INTER_LINEAR)
    if (alpha > 0.5).sum() < _LEAST_PX:
        return None
    points = cutout.keypoints
    if points is not None:
        points = np.column_stack([points[:, :2] @ linear.T + shift, points[:, 2]])
    return Placed(
        fruit.astype(np.float32), alpha.astype(np.float32), points, by_place=cutout.by_place
    )


def less(label: Label, hidden: NDArray[np.bool_]) -> Label | None:
    """Remove newly occluded pixels from a label; return None if nothing is left.

    Parameters
    ----------
    label : Label
        Label with a mask.
    hidden : ndarray of bool, shape (H, W)
        Newly occluded pixels.
    """
    mask = label.mask
    if mask is None or not (mask & hidden).any():
        return label
    left = mask & ~hidden
    if not left.any():
        return None
    whole = label.amodal
    total = int(mask.sum() if whole is None else whole.sum())
    share = 1 - int(left.sum()) / total
    fresh = Label.of_mask(left)
    return replace(
        label,
        box=fresh.box,
        mask_code=fresh.mask_code,
        keypoints=_hidden_points(label.keypoints, hidden),
        hidden_share=round(share, 4),
        ignore=label.ignore or share > 1 - LEAST_SEEN,
    )


def _hidden_points(
    points: NDArray[np.float64] | None, hidden: NDArray[np.bool_]
) -> NDArray[np.float64] | None:
    if points is None:
        return None
    found, (height, width) = points.copy(), hidden.shape
    for row in found:
        u, v = (round(float(x)) for x in row[:2])
        inside = 0 <= u < width and 0 <= v < height
        if row[2] == 2 and inside and hidden[v, u]:
            row[2] = 1
    return found


def label_of(
    seen: NDArray[np.bool_],
    amodal: NDArray[np.bool_],
    points: NDArray[np.float64] | None,
    *,
    by_place: bool = False,
) -> Label:
    """Create the pseudo-label of a pasted fruit.

    Parameters
    ----------
    seen, amodal : ndarray of bool, shape (H, W)
        Visible pixels, at least one, and pixels without occlusion.
    points : ndarray of float64, shape (5, 3), optional
        Keypoints.
    by_place : bool
        Whether the keypoints are ordered by position; recorded in the label.
    """
    height, width = seen.shape
    if points is not None:
        u, v = points[:, 0], points[:, 1]
        inside = (u > -0.5) & (v > -0.5) & (u < width - 0.5) & (v < height - 0.5)
        points = np.column_stack([points[:, :2], np.where(inside, points[:, 2], 0)])
        points = _hidden_points(points, amodal & ~seen)
    return Label.of_mask(
        seen,
        amodal=amodal,
        keypoints=points,
        hidden_share=round(1 - int(seen.sum()) / int(amodal.sum()), 4),
        cut_off=reaches_border(amodal),
        pseudo=True,
        extras={KEYPOINT_ORDER: BY_PLACE} if by_place else {},
    )
