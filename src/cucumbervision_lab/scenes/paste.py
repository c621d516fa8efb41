"""Paste real fruit, cut out of photos by their masks, into other photos.

In a photo of a canopy, foreground leaves are bright and the gaps between them are dark: fruit are
placed in the gaps, pixels above a brightness threshold keep the photo, and some fruit are occluded
by a leaf-shaped piece of the same photo or by a string. Labels are pseudo-labels, because a
network predicted the masks; they have no length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike

from cucumbervision.capture.pictures import read_color
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision.networks.yolo import BY_PLACE
from cucumbervision_lab.arrays import Array, Array32, Generator, Mask, Pixels
from cucumbervision_lab.data.labels import KEYPOINT_ORDER, DataSet, Label, LabelledPicture
from cucumbervision_lab.scenes.scene import reaches_border

_MARGIN_PX = 4
_LEAST_SIDE_PX = 40
_LEAST_PX = 60
_SOLID = 0.78
_LEAST_SEEN = 0.12


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

    color: Pixels
    mask: Mask
    keypoints: Array | None
    by_place: bool = False


def cutouts_of(dataset: DataSet) -> tuple[Cutout, ...]:
    """Cut out all complete fruit of the split train.

    Parameters
    ----------
    dataset : DataSet
        Data set with masks. Labels that are ignored, cut off, occluded or smaller than 40 px are
        skipped.

    Raises
    ------
    CaptureError
        If a picture cannot be read.
    """
    cutouts = []
    for picture in dataset.in_split("train"):
        masks = [_whole_mask(label, picture.width, picture.height) for label in picture.labels]
        if any(mask is not None for mask in masks):
            color = read_color(dataset.path(picture))
            pairs = zip(picture.labels, masks, strict=True)
            cutouts += [_cut(color, m, label) for label, m in pairs if m is not None]
    return tuple(cutouts)


def _whole_mask(label: Label, width: int, height: int) -> Mask | None:
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


def _cut(color: Pixels, mask: Mask, label: Label) -> Cutout:
    x1, y1, x2, y2 = box_of_mask(mask)
    column, top = max(int(x1) - _MARGIN_PX, 0), max(int(y1) - _MARGIN_PX, 0)
    part = np.s_[top : int(y2) + _MARGIN_PX, column : int(x2) + _MARGIN_PX]
    points = label.keypoints
    if points is not None:
        points = points - np.array([column, top, 0.0])
    # Erode, because the outermost pixels contain background.
    body = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    by_place = label.extras.get(KEYPOINT_ORDER) == BY_PLACE
    return Cutout(color[part].copy(), body[part].copy(), points, by_place)


@dataclass(frozen=True, eq=False)
class _Placed:
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

    color: Array32
    alpha: Array32
    keypoints: Array | None
    by_place: bool = False

    @property
    def amodal(self) -> Mask:
        """Mask of the fruit without occlusion."""
        return self.alpha > 0.5


def _place_cutout(
    cutout: Cutout, shape: tuple[int, int], rng: Generator, *, length_px: float, turn_deg: float
) -> _Placed | None:
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
    _Placed or None
        None if too little of the fruit is inside the picture.
    """
    height, width = shape
    h, w = cutout.mask.shape
    # Enlarging further would blur the fruit.
    scale = min(length_px / max(h, w), 1.3)
    flip = rng.choice([-1.0, 1.0])
    spot = rng.uniform(0.1, 0.9, 2) * (width, height)
    matrix = placement(cutout.mask.shape, spot, scale, np.deg2rad(turn_deg), flip)
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
        moved = points[:, :2] @ matrix[:, :2].T + matrix[:, 2]
        points = np.column_stack([moved, points[:, 2]])
    return _Placed(
        fruit.astype(np.float32), alpha.astype(np.float32), points, by_place=cutout.by_place
    )


def placement(
    shape: tuple[int, ...], middle_px: Array, scale: float, turn_rad: float, flip: float
) -> Array:
    """Return the affine map, (2, 3), that scales, mirrors, turns and moves a picture's middle."""
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    linear = scale * np.array([[cos * flip, -sin], [sin * flip, cos]])
    middle = np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2])
    return np.column_stack([linear, middle_px - linear @ middle])


def _occluded(label: Label, hidden: Mask) -> Label | None:
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
    visible = mask & ~hidden
    if not visible.any():
        return None
    amodal = label.amodal
    total = int(mask.sum() if amodal is None else amodal.sum())
    share = 1 - int(visible.sum()) / total
    fresh = Label.of_mask(visible)
    return replace(
        label,
        box=fresh.box,
        mask_code=fresh.mask_code,
        keypoints=_hidden_points(label.keypoints, hidden),
        hidden_share=round(share, 4),
        ignore=label.ignore or share > 1 - _LEAST_SEEN,
    )


def _hidden_points(points: Array | None, hidden: Mask) -> Array | None:
    if points is None:
        return None
    visible_points, (height, width) = points.copy(), hidden.shape
    for row in visible_points:
        u, v = (round(float(x)) for x in row[:2])
        inside = 0 <= u < width and 0 <= v < height
        if row[2] == 2 and inside and hidden[v, u]:
            row[2] = 1
    return visible_points


def _label_of(
    visible: Mask, amodal: Mask, points: Array | None, *, by_place: bool = False
) -> Label:
    """Create the pseudo-label of a pasted fruit.

    Parameters
    ----------
    visible, amodal : ndarray of bool, shape (H, W)
        Visible pixels, at least one, and pixels without occlusion.
    points : ndarray of float64, shape (5, 3), optional
        Keypoints.
    by_place : bool
        Whether the keypoints are ordered by position; recorded in the label.
    """
    height, width = visible.shape
    if points is not None:
        u, v = points[:, 0], points[:, 1]
        inside = (u > -0.5) & (v > -0.5) & (u < width - 0.5) & (v < height - 0.5)
        points = np.column_stack([points[:, :2], np.where(inside, points[:, 2], 0)])
        points = _hidden_points(points, amodal & ~visible)
    return Label.of_mask(
        visible,
        amodal=amodal,
        keypoints=points,
        hidden_share=round(1 - int(visible.sum()) / int(amodal.sum()), 4),
        cut_off=reaches_border(amodal),
        pseudo=True,
        extras={KEYPOINT_ORDER: BY_PLACE} if by_place else {},
    )


_LEAST_GROUND_PX = 340
_MONTAGE_SHARE = (0.07, 0.75)  # length of fruit relative to the picture's longer side
_MOST_FRUIT = 10
_HANGING = 0.6  # probability that fruit hang
_HIDDEN = 0.6  # probability that a fruit is placed behind the foreground
_MOST_HIDDEN = 0.55  # maximum share of a fruit occluded by the foreground


def fruitless(picture: LabelledPicture) -> bool:
    """Return whether a photo is large enough and has no labels.

    Photos with ignore regions are excluded, because these may contain fruit.
    """
    return not picture.labels and min(picture.width, picture.height) >= _LEAST_GROUND_PX


def montage(
    ground: Pixels, size: tuple[int, int], cutouts: Sequence[Cutout], rng: Generator
) -> tuple[Pixels, tuple[Label, ...]]:
    """Paste fruit into a random crop of a photo.

    Parameters
    ----------
    ground : ndarray of uint8, shape (H, W, 3)
        RGB photo without fruit.
    size : tuple of int
        Width and height of the result.
    cutouts : sequence of Cutout
        Fruit to choose from.
    rng : numpy.random.Generator
        Random generator.

    Returns
    -------
    color : ndarray of uint8, shape (height, width, 3)
        RGB.
    labels : tuple of Label
        Pseudo-labels of the pasted fruit.
    """
    picture = _part_of(ground, size, rng).astype(np.float32)
    light = cv2.GaussianBlur(picture.mean(axis=2), (0, 0), 0.004 * max(size))
    longest = float(np.exp(rng.uniform(*np.log(_MONTAGE_SHARE)))) * max(size)
    # More fruit if they are small.
    many = 1.2 + 4.0 * (1 - longest / (_MONTAGE_SHARE[1] * max(size)))
    hangs = rng.random() < _HANGING
    labels: list[Label] = []
    for _ in range(min(int(rng.poisson(many)), _MOST_FRUIT)):
        cutout = cutouts[int(rng.integers(len(cutouts)))]
        fruit = _place_cutout(
            cutout,
            picture.shape[:2],
            rng,
            length_px=longest * rng.uniform(0.75, 1.25),
            turn_deg=_upright(cutout) + rng.normal(0, 14) if hangs else rng.uniform(0, 360),
        )
        if fruit is None:
            continue
        hidden = _behind(light, fruit, rng)
        over = None
        if rng.random() < 0.3:
            over = _leaf_over(picture, fruit, rng)
        elif rng.random() < 0.15:
            over = _string_over(picture, fruit, rng)
        if over is not None:
            hidden = np.maximum(hidden, over[1])
        amodal = fruit.amodal
        visible = amodal & (hidden < 0.5)
        if visible.sum() < max(_LEAST_SEEN * amodal.sum(), 30):
            continue
        area = _around(amodal)
        part = _Placed(fruit.color[area], fruit.alpha[area], None)
        picture[area] = _blend(picture[area], part, hidden[area], rng)
        if over is not None:
            piece, cover = over
            picture += (piece - picture) * cover[..., None]
        covered = visible if over is None else visible | (over[1] > 0.5)
        labels = [x for x in (_occluded(label, covered) for label in labels) if x is not None]
        labels.append(_label_of(visible, amodal, fruit.keypoints, by_place=fruit.by_place))
    return np.clip(picture, 0, 255).astype(np.uint8), tuple(labels)


def _part_of(ground: Pixels, size: tuple[int, int], rng: Generator) -> Pixels:
    """Return a random crop of a photo with the aspect ratio of `size`, resized to it."""
    width, height = size
    h, w = ground.shape[:2]
    scale = min(w / width, h / height)
    share = scale * rng.uniform(0.55, 1.0) if scale > 0.5 else scale
    cut_w, cut_h = max(int(width * share), 1), max(int(height * share), 1)
    x, y = int(rng.integers(w - cut_w + 1)), int(rng.integers(h - cut_h + 1))
    part = ground[y : y + cut_h, x : x + cut_w]
    if rng.random() < 0.5:
        part = part[:, ::-1]
    way = cv2.INTER_AREA if share > 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(np.ascontiguousarray(part), size, interpolation=way), np.uint8)


def _around(amodal: Mask) -> tuple[slice, slice]:
    """Return the row and column slices of a fruit and its shadow."""
    ys, xs = np.nonzero(amodal.any(axis=1))[0], np.nonzero(amodal.any(axis=0))[0]
    margin = int(0.6 * np.sqrt(np.count_nonzero(amodal))) + 8
    rows = slice(max(int(ys[0]) - margin, 0), int(ys[-1]) + margin)
    return rows, slice(max(int(xs[0]) - margin, 0), int(xs[-1]) + margin)


def _upright(cutout: Cutout) -> float:
    """Return the rotation in degrees that makes a cutout vertical."""
    pixels = np.argwhere(cutout.mask)[:, ::-1].astype(np.float64)
    _, axes = np.linalg.eigh(np.cov((pixels - pixels.mean(axis=0)).T))
    x, y = axes[:, -1]
    return 90.0 - float(np.degrees(np.arctan2(y, x)))


def _behind(light: Array32, fruit: _Placed, rng: Generator) -> Array32:
    """Return the occlusion of each pixel by the brighter foreground, 0 to 1."""
    none = np.zeros_like(light)
    if rng.random() > _HIDDEN:
        return none
    amodal = fruit.amodal
    share = rng.uniform(0.05, _MOST_HIDDEN)
    limit = float(np.quantile(light[amodal], 1 - share))
    front = (light > limit).astype(np.uint8)
    width = 2 * max(int(0.02 * np.sqrt(amodal.sum()) + 1), 1) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
    opened = cv2.morphologyEx(front, cv2.MORPH_OPEN, kernel)
    return softened(cv2.morphologyEx(opened, cv2.MORPH_CLOSE, kernel), 0.8)


def softened(mask: ArrayLike, sigma_px: float) -> Array32:
    """Return a mask or picture after a Gaussian filter."""
    return np.asarray(cv2.GaussianBlur(np.asarray(mask, np.float32), (0, 0), sigma_px), np.float32)


def _leaf_over(picture: Array32, fruit: _Placed, rng: Generator) -> tuple[Array32, Array32]:
    """Return a shifted copy of the photo, and the mask of a leaf over part of a fruit."""
    height, width = picture.shape[:2]
    ys, xs = np.nonzero(fruit.amodal)
    k = int(rng.integers(len(xs)))
    radius = float(np.sqrt(len(xs))) * rng.uniform(0.4, 1.1)
    turn = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    lobes = 1 + 0.14 * np.cos(5 * turn) + 0.05 * np.cos(11 * turn + rng.uniform(0, 6))
    slim, lean = rng.uniform(0.5, 1.0), rng.uniform(0, np.pi)
    outline = radius * lobes * np.stack([np.cos(turn), slim * np.sin(turn)])
    wheel = np.array([[np.cos(lean), -np.sin(lean)], [np.sin(lean), np.cos(lean)]])
    # Shift the centre, so that the leaf covers only a part of the fruit.
    middle = np.array([xs[k], ys[k]]) + rng.normal(0, 0.6 * radius, 2)
    points = (wheel @ outline).T + middle
    cover = np.zeros((height, width), np.uint8)
    cv2.fillPoly(cover, [np.rint(points).astype(np.int32)], 1)
    moved = rng.integers(-height // 3, height // 3), rng.integers(-width // 3, width // 3)
    piece = np.roll(picture, moved, axis=(0, 1)) * rng.uniform(0.85, 1.25)
    return piece.astype(np.float32), softened(cover, 0.8)


def _string_over(picture: Array32, fruit: _Placed, rng: Generator) -> tuple[Array32, Array32]:
    """Return the colour of a string or thin stem across a fruit, and its mask."""
    height, width = picture.shape[:2]
    ys, xs = np.nonzero(fruit.amodal)
    k = int(rng.integers(len(xs)))
    lean = float(rng.normal(0, 0.15))
    ends = [(int(xs[k] + lean * (y - ys[k])), y) for y in (0, height - 1)]
    cover = np.zeros((height, width), np.uint8)
    thick = max(1, int(np.sqrt(len(xs)) * rng.uniform(0.02, 0.09)))
    cv2.line(cover, ends[0], ends[1], 1, thick, cv2.LINE_AA)
    base = (225, 225, 215) if rng.random() < 0.5 else (120, 150, 80)
    tone = np.array(base) * rng.uniform(0.5, 1.1)
    color = np.broadcast_to(tone.astype(np.float32), picture.shape)
    return color, softened(cover, 0.6)


def _blend(picture: Array32, fruit: _Placed, hidden: Array32, rng: Generator) -> Array32:
    """Blend a fruit into the picture with local brightness and a shadow."""
    amodal = fruit.amodal
    surround = cv2.dilate(amodal.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    place, fruit_color = picture[surround].mean(axis=0) + 4, fruit.color[amodal].mean(axis=0) + 4
    # Adapt brightness to the surroundings largely, colour slightly.
    level = (place.mean() / fruit_color.mean()) ** rng.uniform(0.3, 0.9)
    cast = ((place / place.mean()) / (fruit_color / fruit_color.mean())) ** rng.uniform(0.0, 0.3)
    gain = np.clip(level * rng.uniform(0.8, 1.4), 0.35, 2.2) * cast
    ys, xs = np.nonzero(amodal)
    rows, columns = np.mgrid[: picture.shape[0], : picture.shape[1]].astype(np.float32)
    turn = rng.uniform(0, 2 * np.pi)
    ramp = (columns - xs.mean()) * np.cos(turn) + (rows - ys.mean()) * np.sin(turn)
    shade = 1 + rng.uniform(0, 0.3) * np.clip(ramp / (np.sqrt(len(xs)) + 1), -1, 1)
    lit = fruit.color * gain.astype(np.float32) * shade[..., None]
    soft = float(rng.uniform(0.0, 0.9))
    if soft > 0.3:
        lit = cv2.GaussianBlur(lit, (0, 0), soft)
    dark = picture
    if rng.random() < 0.6:
        # Darken the background next to the fruit.
        reach = 0.12 * np.sqrt(len(xs)) + 1
        shadow = cv2.GaussianBlur(fruit.alpha, (0, 0), float(reach))
        shift = np.array([[1, 0, rng.normal(0, reach)], [0, 1, rng.uniform(0, reach)]], np.float32)
        shadow = cv2.warpAffine(shadow, shift, (picture.shape[1], picture.shape[0]))
        dark = picture * (1 - rng.uniform(0.15, 0.55) * (shadow * (1 - hidden))[..., None])
    alpha = (fruit.alpha * (1 - hidden))[..., None]
    return np.asarray(dark * (1 - alpha) + lit * alpha, np.float32)
