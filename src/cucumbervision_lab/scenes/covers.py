"""Lay leaves and stems over the end of a fruit in a picture, beside it and behind it.

Drawn leaves teach a network drawn leaves. Leaves that were cut out of photos have the edges, veins
and light of real ones, wherever they are laid. What covers an end hangs at nearly the depth of the
fruit or has no reading, so the picture has to tell; what lies beside or behind an end leaves it
true.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, TypeAlias

import cv2
import numpy as np
from scipy.spatial import cKDTree

from cucumbervision.tube.shape import arc_positions, points_along
from cucumbervision_lab.scenes.paste import Cutout, placement, softened

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    Plane: TypeAlias = NDArray[np.float32]
    _Laid: TypeAlias = tuple[Plane, Plane, float]

_TRIES = 10
_TIP_RADII = 1.5  # the direction of an end is that of the axis this far inside
_COVERED = (0.06, 0.7)  # of the length
_LEAF_RADII, _STEM_RADII = (3.5, 14.0), (0.2, 1.8)  # longer side; width
_BESIDE_RADII = 3.0  # from the tip to the nearest part of what lies beside it
_LEAST_VISIBLE, _LEAST_PX = 0.12, 60  # of the mask
_STEM_COLORS = np.array(
    [(90, 105, 70), (70, 90, 50), (120, 150, 80), (150, 170, 110), (160, 165, 150), (200, 200, 190)]
)
_BLURS = (0.0, 0.0, 0.5, 0.8, 1.2)  # pixels
_SHADOW_SHARE, _NO_DEPTH_SHARE = 0.6, 0.3  # shares of covers with a shadow, and without depth
_HALF_SHARE = 0.2  # of leaves


class CoverKind(StrEnum):
    """What is laid where."""

    LEAF_OVER = "leaf over"
    STEM_OVER = "stem over"
    LEAF_BESIDE = "leaf beside"
    STEM_BEYOND = "stem beyond"
    LEAF_BEHIND = "leaf behind"


_KINDS, _CHANCES = list(CoverKind), (0.27, 0.27, 0.18, 0.18, 0.10)
_OVER = (CoverKind.LEAF_OVER, CoverKind.STEM_OVER)


@dataclass(frozen=True, eq=False)
class FruitPicture:
    """The part of a picture around one fruit.

    Parameters
    ----------
    color : ndarray of uint8, shape (H, W, 3)
        RGB.
    depth_m : ndarray of float32, shape (H, W)
        Metres; 0 for no reading.
    mask : ndarray of bool, shape (H, W)
        The fruit.
    """

    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    mask: NDArray[np.bool_]


def read_pieces(folder: Path) -> tuple[Cutout, ...]:
    """Read leaves that were cut out: PNG files with transparency.

    Files without an alpha channel are left out.
    """
    pieces = []
    for file in sorted(folder.glob("*.png")):
        picture = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        if picture is not None and picture.ndim == 3 and picture.shape[2] == 4:
            color = cv2.cvtColor(picture[..., :3], cv2.COLOR_BGR2RGB)
            pieces.append(Cutout(np.asarray(color, np.uint8), picture[..., 3] > 127, None))
    return tuple(pieces)


def cover_end(
    picture: FruitPicture,
    axis_px: NDArray[np.float64],
    radius_px: float,
    pieces: Sequence[Cutout],
    rng: np.random.Generator,
    kind: CoverKind | None = None,
    *,
    surface_m: float = 0.0,
    radius_m: float = 0.0,
) -> tuple[FruitPicture, float] | None:
    """Lay a leaf or a stem over, beside or behind the first end of a fruit.

    Parameters
    ----------
    picture : FruitPicture
        Around the fruit.
    axis_px : ndarray of float64, shape (K, 2)
        u, v along the fruit, from the end in question.
    radius_px : float
        Of the fruit.
    pieces : sequence of Cutout
        Leaves, or other things that hang before fruit.
    rng : numpy.random.Generator
        Random generator.
    kind : CoverKind, optional
        At random if not given.
    surface_m, radius_m : float
        Depth of the fruit's surface near the end, and the fruit's radius; 0 for a photo.

    Returns
    -------
    picture : FruitPicture
        With the cover; the mask is the largest part of the fruit that it leaves visible.
    hidden_share : float
        Of the axis, at its first end, that the mask does not hold; 0 for a kind that covers none.
        The result is None where no place for the piece was found or too little stays visible.
    """
    kind = kind or CoverKind(rng.choice(_KINDS, p=_CHANCES))
    laid = (
        _stem(picture, axis_px, radius_px, rng, over=kind is CoverKind.STEM_OVER)
        if kind in (CoverKind.STEM_OVER, CoverKind.STEM_BEYOND)
        else _leaf(picture, axis_px, radius_px, pieces, rng, kind)
    )
    if laid is None:
        return None
    color, alpha, covered_share = laid
    if kind is CoverKind.LEAF_BEHIND:
        alpha = alpha * (1 - softened(picture.mask.astype(np.float32), 0.7))
    hidden = alpha > 0.5
    visible = picture.mask & ~hidden
    if kind is CoverKind.STEM_OVER:  # a network's mask ends at the stem
        visible &= ~_before(axis_px, covered_share, visible.shape)
    visible = _largest_part(visible)
    if np.count_nonzero(visible) < max(_LEAST_VISIBLE * np.count_nonzero(picture.mask), _LEAST_PX):
        return None
    depth_m = picture.depth_m.copy()
    if surface_m > 0:
        depth_m[hidden] = _depths(kind, surface_m, radius_m, int(hidden.sum()), rng)
    ground = _shaded(picture.color, alpha, radius_px, rng)
    mixed = ground * (1 - alpha[..., None]) + color * alpha[..., None]
    share = _first_visible(axis_px, visible) if kind in _OVER else 0.0
    return FruitPicture(np.clip(mixed, 0, 255).astype(np.uint8), depth_m, visible), share


def _leaf(
    picture: FruitPicture,
    axis_px: NDArray[np.float64],
    radius_px: float,
    pieces: Sequence[Cutout],
    rng: np.random.Generator,
    kind: CoverKind,
) -> _Laid | None:
    """Return the colours and the coverage of a leaf, and the share of the axis that it covers."""
    length_px, shape = float(arc_positions(axis_px)[-1]), picture.mask.shape
    piece = pieces[int(rng.integers(len(pieces)))]
    if rng.random() < _HALF_SHARE:  # along the midrib
        piece = replace(piece, mask=piece.mask & (np.linspace(0, 1, piece.mask.shape[1]) < 0.5))
    light, sharpness = _light_near(picture.color, axis_px[0], radius_px), rng.choice(_BLURS)
    ahead, aside = _directions(axis_px, radius_px)
    side_px = radius_px * rng.uniform(*_LEAF_RADII)
    share = float(np.exp(rng.uniform(*np.log(_COVERED))))
    if kind is CoverKind.LEAF_OVER:
        side_px = max(side_px, 1.15 * share * length_px + 1.5 * radius_px)
        middle, along, across = points_along(axis_px, [share])[0], (0.3, 0.5), (-0.4, 0.4)
    else:
        middle, along, across = axis_px[0], (0.1, 0.55), (-0.6, 0.6)
    for _ in range(_TRIES):
        centre = middle + side_px * (ahead * rng.uniform(*along) + aside * rng.uniform(*across))
        color, alpha = _turned(piece, shape, centre, side_px, light, float(sharpness), rng)
        over_axis = _sampled(alpha, axis_px) > 0.5
        if kind is CoverKind.LEAF_BEHIND and alpha.max() > 0.5:
            return color, alpha, 0.0
        if kind is CoverKind.LEAF_BESIDE and not over_axis.any():
            rows, columns = np.nonzero(alpha > 0.5)
            off = np.hypot(columns - axis_px[0, 0], rows - axis_px[0, 1])
            if off.min(initial=np.inf) < _BESIDE_RADII * radius_px:
                return color, alpha, 0.0
        first = int(np.argmin(over_axis))  # of the axis that is visible
        if kind is CoverKind.LEAF_OVER and first > 0 and not over_axis[first:].any():
            return color, alpha, first / len(axis_px)
    return None


def _stem(
    picture: FruitPicture,
    axis_px: NDArray[np.float64],
    radius_px: float,
    rng: np.random.Generator,
    *,
    over: bool,
) -> _Laid:
    """Return the colours and the coverage of a stem, and the share of the axis up to it."""
    ahead, aside = _directions(axis_px, radius_px)
    width_px = radius_px * float(np.exp(rng.uniform(*np.log(_STEM_RADII))))
    lean, half_px = rng.normal(0, 0.45), rng.uniform(8, 30) * width_px
    along = aside * np.cos(lean) + ahead * np.sin(lean)
    share = float(np.exp(rng.uniform(*np.log(_COVERED)))) if over else 0.0
    off_px = width_px / 2 if over else width_px / 2 + radius_px * rng.uniform(0, 1.5)
    middle = points_along(axis_px, [share])[0] + ahead * off_px
    steps = np.linspace(-1, 1, 40)[:, None]
    normal = np.array([-along[1], along[0]])
    bend_px = rng.normal(0, 0.12) * half_px
    line = middle + steps * half_px * along + steps**2 * bend_px * normal
    cover = np.zeros(picture.mask.shape, np.uint8)
    corners = np.rint(8 * line).astype(np.int32)
    cv2.polylines(cover, [corners], False, 255, max(int(width_px), 1), cv2.LINE_AA, 3)
    rows, columns = np.indices(cover.shape)
    across = (columns - middle[0]) * normal[0] + (rows - middle[1]) * normal[1]
    lit = 0.75 + 0.35 * np.cos(np.clip(across / width_px * 2.4 - rng.uniform(-0.5, 0.5), -1.6, 1.6))
    tone = _STEM_COLORS[int(rng.integers(len(_STEM_COLORS)))]
    light = _light_near(picture.color, axis_px[0], radius_px) * rng.uniform(0.8, 1.5)
    color = tone * light / tone.mean() * lit[..., None] + rng.normal(0, 6, (*cover.shape, 1))
    return color.astype(np.float32), softened(cover / np.float32(255), 0.6), share


def _turned(
    piece: Cutout,
    shape: tuple[int, ...],
    centre: NDArray[np.float64],
    side_px: float,
    light: float,
    blur_px: float,
    rng: np.random.Generator,
) -> tuple[Plane, Plane]:
    """Return a piece turned at random, as bright as its surroundings, and its coverage."""
    scale, turn = side_px / max(piece.mask.shape), rng.uniform(0, 2 * np.pi)
    matrix = placement(piece.mask.shape, centre, scale, turn, rng.choice([-1.0, 1.0]))
    size = shape[1], shape[0]
    smooth = softened(piece.color, 0.35 / scale) if scale < 0.7 else piece.color.astype(np.float32)
    color = cv2.warpAffine(smooth, matrix, size, borderMode=cv2.BORDER_REPLICATE)
    alpha = cv2.warpAffine(piece.mask.astype(np.float32), matrix, size)
    covered = alpha > 0.5
    mean = float(color[covered].mean()) if covered.any() else 100.0
    gain = float(np.clip(light / max(mean, 20.0) * np.exp(rng.normal(0, 0.3)), 0.3, 2.5))
    color = np.clip(color * gain * np.exp(rng.normal(0, 0.04, 3)), 0, 255)
    blurred = softened(color, blur_px) if blur_px > 0 else np.asarray(color, np.float32)
    return blurred, softened(alpha, max(blur_px, 0.6))


def _depths(
    kind: CoverKind, surface_m: float, radius_m: float, count: int, rng: np.random.Generator
) -> Plane:
    """Return depths of a cover's pixels: near the fruit's surface, well behind it, or none."""
    if rng.random() < _NO_DEPTH_SHARE:
        return np.zeros(count, np.float32)
    behind = kind in (CoverKind.LEAF_BEHIND, CoverKind.STEM_BEYOND)
    off_m = radius_m * (rng.uniform(1.2, 3.5) if behind else min(rng.normal(0, 0.6), 0.9))
    spread = rng.normal(0, 0.05 * radius_m, count)
    return np.round(surface_m + off_m + spread, 3).astype(np.float32)


def _shaded(
    color: NDArray[np.uint8], alpha: Plane, radius_px: float, rng: np.random.Generator
) -> Plane:
    if rng.random() > _SHADOW_SHARE:
        return color.astype(np.float32)
    shadow = np.clip(softened(alpha, max(0.35 * radius_px, 1.0)) - alpha, 0, 1)
    return np.asarray(color * (1 - 0.45 * rng.random() * shadow[..., None]), np.float32)


def _directions(
    axis_px: NDArray[np.float64], radius_px: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return unit vectors out of the first end, and across the fruit there."""
    length_px = float(arc_positions(axis_px)[-1])
    inner = points_along(axis_px, [min(_TIP_RADII * radius_px / length_px, 0.9)])[0]
    ahead = (axis_px[0] - inner) / max(float(np.linalg.norm(axis_px[0] - inner)), 1e-6)
    return ahead, np.array([-ahead[1], ahead[0]])


def _before(
    axis_px: NDArray[np.float64], share: float, shape: tuple[int, ...]
) -> NDArray[np.bool_]:
    """Return which pixels are nearest to the first part of an axis."""
    rows, columns = np.indices(shape)
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    fine = points_along(axis_px, np.linspace(0, 1, 201))
    nearest = cKDTree(fine).query(pixels)[1].reshape(shape)
    return np.asarray(nearest < 200 * share)


def _first_visible(axis_px: NDArray[np.float64], visible: NDArray[np.bool_]) -> float:
    fine = points_along(axis_px, np.linspace(0, 1, 201))
    inside = _sampled(visible.astype(np.float32), fine) > 0.5
    return float(inside.argmax() / 200) if inside.any() else 1.0


def _sampled(plane: Plane, points_px: NDArray[np.float64]) -> Plane:
    height, width = plane.shape
    columns, rows = np.rint(points_px).astype(np.intp).T
    return np.asarray(plane[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)])


def _light_near(color: NDArray[np.uint8], point_px: NDArray[np.float64], radius_px: float) -> float:
    (x, y), reach = np.rint(point_px).astype(int), int(6 * radius_px) + 4
    part = color[max(y - reach, 0) : y + reach, max(x - reach, 0) : x + reach]
    return float(part.mean()) if part.size else 90.0


def _largest_part(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    return (
        mask if count < 2 else np.asarray(labels == 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax()))
    )
