"""Paste real fruit into real photos without fruit, partly behind the foreground.

In a canopy, foreground leaves are bright and the gaps between them are dark. Fruit are placed in
the gaps: pixels above a brightness threshold keep the photo. Some fruit are occluded by a
leaf-shaped piece of the same photo or by a string. Fruit are adapted to the local brightness.
They have pseudo-labels and no length.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from cucumbervision_lab.synthesis.paste import LEAST_SEEN, Placed, label_of, less, place_cutout

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    from cucumbervision_lab.datasets.labels import Label, LabelledPicture
    from cucumbervision_lab.synthesis.paste import Cutout

_LEAST_GROUND_PX = 340
_LENGTH_SHARE = (0.07, 0.75)  # length of fruit relative to the picture's longer side
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
    ground: NDArray[np.uint8],
    size: tuple[int, int],
    cutouts: Sequence[Cutout],
    rng: np.random.Generator,
) -> tuple[NDArray[np.uint8], tuple[Label, ...]]:
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
    longest = float(np.exp(rng.uniform(*np.log(_LENGTH_SHARE)))) * max(size)
    # More fruit if they are small.
    many = 1.2 + 4.0 * (1 - longest / (_LENGTH_SHARE[1] * max(size)))
    hangs = rng.random() < _HANGING
    labels: list[Label] = []
    for _ in range(min(int(rng.poisson(many)), _MOST_FRUIT)):
        cutout = cutouts[int(rng.integers(len(cutouts)))]
        fruit = place_cutout(
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
        seen = amodal & (hidden < 0.5)
        if seen.sum() < max(LEAST_SEEN * amodal.sum(), 30):
            continue
        area = _around(amodal)
        part = Placed(fruit.color[area], fruit.alpha[area], None)
        picture[area] = _blend(picture[area], part, hidden[area], rng)
        if over is not None:
            piece, cover = over
            picture += (piece - picture) * cover[..., None]
        covered = seen if over is None else seen | (over[1] > 0.5)
        labels = [x for x in (less(label, covered) for label in labels) if x is not None]
        labels.append(label_of(seen, amodal, fruit.keypoints, by_place=fruit.by_place))
    return np.clip(picture, 0, 255).astype(np.uint8), tuple(labels)


def _part_of(
    ground: NDArray[np.uint8], size: tuple[int, int], rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Return a random crop of a photo with the aspect ratio of `size`, resized to it."""
    width, height = size
    h, w = ground.shape[:2]
    most = min(w / width, h / height)
    share = most * rng.uniform(0.55, 1.0) if most > 0.5 else most
    cut_w, cut_h = max(int(width * share), 1), max(int(height * share), 1)
    x, y = int(rng.integers(w - cut_w + 1)), int(rng.integers(h - cut_h + 1))
    part = ground[y : y + cut_h, x : x + cut_w]
    if rng.random() < 0.5:
        part = part[:, ::-1]
    way = cv2.INTER_AREA if share > 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(np.ascontiguousarray(part), size, interpolation=way), np.uint8)


def _around(amodal: NDArray[np.bool_]) -> tuple[slice, slice]:
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


def _behind(
    light: NDArray[np.float32], fruit: Placed, rng: np.random.Generator
) -> NDArray[np.float32]:
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
    return _softened(cv2.morphologyEx(opened, cv2.MORPH_CLOSE, kernel), 0.8)


def _softened(mask: ArrayLike, sigma_px: float) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(np.asarray(mask, np.float32), (0, 0), sigma_px), np.float32)


def _leaf_over(
    picture: NDArray[np.float32], fruit: Placed, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
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
    return piece.astype(np.float32), _softened(cover, 0.8)


def _string_over(
    picture: NDArray[np.float32], fruit: Placed, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
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
    return color, _softened(cover, 0.6)


def _blend(
    picture: NDArray[np.float32],
    fruit: Placed,
    hidden: NDArray[np.float32],
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """Blend a fruit into the picture with local brightness and a shadow."""
    amodal = fruit.amodal
    near = cv2.dilate(amodal.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    place, own = picture[near].mean(axis=0) + 4, fruit.color[amodal].mean(axis=0) + 4
    # Adapt brightness to the surroundings largely, colour slightly.
    level = (place.mean() / own.mean()) ** rng.uniform(0.3, 0.9)
    cast = ((place / place.mean()) / (own / own.mean())) ** rng.uniform(0.0, 0.3)
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
