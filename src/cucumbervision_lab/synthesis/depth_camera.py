"""A stereo depth camera of the D400 family, from exact scenes to the frames that it gives."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np
from scipy.special import ndtri

from cucumbervision.capture.intrinsics import Intrinsics, Stream
from cucumbervision.geometry.camera import distort
from cucumbervision_lab.synthesis.raycast import ray_grid
from cucumbervision_lab.synthesis.scene import Kind, render

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision_lab.synthesis.scene import Scene, View

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


_NO_TURN = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

_MARGIN_PX = 24

_FLICKER = 0.1  # of the readings beside a jump, gone in one frame and back in the next


@dataclass(frozen=True)
class D4xx:
    """One camera.

    Parameters
    ----------
    color, depth : Intrinsics
        Of the colour camera and of the depth camera (the left imager).
    rotation : tuple
        R of x_color = R x_depth + t, rows first.
    translation_m : tuple of float
        t; on a D435 the colour camera stands 15 mm beside the left imager.
    baseline_m : float
        Between the imagers; 50 mm on a D435.
    disparity_rms_px : float
        Noise of disparity, pixels of the depth camera, all waves together.
    fixed_share : float
        Share of its variance that stays from frame to frame.
    correlation_px : float
        Standard deviation of the Gaussian that makes the noise smooth, depth pixels.
    subpixel_step_px : float
        Disparity comes in such steps.
    scale_error : float
        This camera's own: it reads depth times 1 + scale_error.
    matcher : Matcher
        How the matching errs at edges.
    foliage_holes, glare_holes : float
        Share of leaves' pixels lost in clumps, and share of a fruit's shining side lost: 0 for
        dry fruit in shade.
    unit_m : float
        Depth comes in such units, metres.
    min_z_m : float
        Nothing nearer is read, metres.

    Examples
    --------
    >>> camera = D4xx.like(Intrinsics(1280, 720, 924.0, 924.0, 640.0, 360.0))
    >>> camera.depth.fx_px, camera.scale_error
    (640.0, 0.0)
    """

    color: Intrinsics
    depth: Intrinsics
    rotation: tuple[tuple[float, float, float], ...] = _NO_TURN
    translation_m: tuple[float, float, float] = (0.015, 0.0, 0.0)
    baseline_m: float = 0.050
    disparity_rms_px: float = 0.19
    fixed_share: float = 0.7
    correlation_px: float = 5.0
    subpixel_step_px: float = 1 / 32
    scale_error: float = 0.0
    matcher: Matcher = field(default_factory=Matcher)
    foliage_holes: float = 0.02
    glare_holes: float = 0.0
    unit_m: float = 0.001
    min_z_m: float = 0.28

    @classmethod
    def like(cls, color: Intrinsics) -> D4xx:
        """Make a D435 for a colour calibration, its depth mode of the same size.

        A D435's imagers have a focal length of half the width at 16:9; at 4:3 the sides are cut.
        """
        focal = color.height * 640.0 / 720.0
        centre = (color.width / 2, color.height / 2)
        return cls(
            color, Intrinsics(color.width, color.height, focal, focal, *centre, Stream.DEPTH)
        )


def sense(
    scene: Scene, camera: D4xx, rng: np.random.Generator, frames: int = 5
) -> list[NDArray[np.float32]]:
    """Simulate a burst of depth frames, aligned to colour.

    Parameters
    ----------
    scene : Scene
        In the colour camera's coordinates.
    camera : D4xx
        The camera.
    rng : numpy.random.Generator
        The random generator; the same seed gives the same frames.
    frames : int
        Size of the burst. Its frames share the part of the noise that is fixed in space, and
        most holes.

    Returns
    -------
    list of ndarray of float32, shape (color height, color width)
        Metres, multiples of `unit_m`; 0 where there is no reading.

    Raises
    ------
    ValueError
        If a body reaches behind a camera.

    Notes
    -----
    Disparity noise of RMS s is depth noise of z² s / (f B). Which depth pixel a colour pixel
    takes is found once for the burst: the noise in time moves it by less than a tenth of a pixel.

    Examples
    --------
    >>> from cucumbervision_lab.synthesis.raycast import Plane
    >>> from cucumbervision_lab.synthesis.scene import Scene
    >>> camera = D4xx.like(Intrinsics(320, 180, 231.0, 231.0, 160.0, 90.0))
    >>> wall = Scene((), planes=(Plane.facing(0.5),))
    >>> burst = sense(wall, camera, np.random.default_rng(1), frames=3)
    >>> len(burst), bool(abs(np.median(burst) - 0.5) < 0.005)
    (3, True)
    """
    seen_by = _in_sight(camera)
    back = np.asarray(camera.rotation).T
    view = render(scene.moved(back, -back @ np.asarray(camera.translation_m)), seen_by)
    focal_baseline = seen_by.fx_px * camera.baseline_m
    depth = view.depth_m.astype(np.float32)
    exact = np.divide(focal_baseline, depth, out=np.zeros_like(depth), where=depth > 0)
    matched = match(exact, camera.matcher, rng)
    valid = matched.valid & ~_lost_on_surfaces(view, seen_by, camera, rng)
    waves = smooth_field(exact.shape, camera.correlation_px, rng)
    waves *= np.float32(camera.disparity_rms_px * np.sqrt(camera.fixed_share))
    settled = np.maximum(matched.disparity_px + waves, np.float32(camera.subpixel_step_px))
    base = np.where(valid, focal_baseline / settled, 0).astype(np.float32)
    sources = color_sources(base, seen_by, camera)
    found = sources >= 0
    burst = []
    for _ in range(frames):
        reading = _frame(settled, valid, matched, focal_baseline, camera, rng)
        burst.append(np.where(found, reading.ravel()[sources], np.float32(0)))
    return burst


def _frame(
    settled_px: NDArray[np.float32],
    valid: NDArray[np.bool_],
    matched: Matched,
    focal_baseline: float,
    camera: D4xx,
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    fresh = smooth_field(settled_px.shape, camera.correlation_px, rng)
    fresh *= np.float32(camera.disparity_rms_px * np.sqrt(1 - camera.fixed_share))
    fresh += settled_px
    step = np.float32(camera.subpixel_step_px)
    disparity = np.maximum(np.rint(fresh / step), 1) * step
    depth = np.float32(focal_baseline * (1 + camera.scale_error)) / disparity
    units = np.rint(depth / np.float32(camera.unit_m))
    reading = np.asarray(units * np.float32(camera.unit_m), np.float32)
    reading[~valid | (reading < camera.min_z_m)] = 0.0
    v, u = np.nonzero(matched.unsure)
    gone = rng.random(len(v)) < _FLICKER
    reading[v[gone], u[gone]] = 0.0
    return reading


def _lost_on_surfaces(
    view: View, seen_by: Intrinsics, camera: D4xx, rng: np.random.Generator
) -> NDArray[np.bool_]:
    lost = np.zeros(view.depth_m.shape, np.bool_)
    if camera.foliage_holes > 0 and (view.kind == Kind.LEAF).any():
        clump = smooth_field(lost.shape, 2 * camera.matcher.clump_px, rng)
        lost |= (view.kind == Kind.LEAF) & (clump < np.quantile(clump, camera.foliage_holes))
    if camera.glare_holes > 0 and (view.kind == Kind.FRUIT).any():
        grid = ray_grid(seen_by)
        v, u = np.nonzero(view.kind == Kind.FRUIT)
        light = rng.normal([0.0, -0.7, -0.5], 0.4)
        towards = -np.stack([grid.x[v, u], grid.y[v, u], np.ones(len(v))], axis=1)
        half = towards / np.linalg.norm(towards, axis=1)[:, None] + light / np.linalg.norm(light)
        shine = (view.normal[v, u] * half).sum(axis=1) / np.linalg.norm(half, axis=1)
        wobble = 0.03 * smooth_field(lost.shape, camera.matcher.clump_px, rng)[v, u]
        shining = shine + wobble
        gone = shining > np.quantile(shining, 1 - camera.glare_holes)
        lost[v[gone], u[gone]] = True
    return lost


@lru_cache(maxsize=8)
def _in_sight(camera: D4xx) -> Intrinsics:
    """Return the part of the depth camera's picture that the colour camera can see into."""
    color, depth = camera.color, camera.depth
    u = np.array([0, color.width / 2, color.width - 1, 0, color.width - 1] * 2, dtype=float)
    v = np.array([0, 0, 0, color.height - 1, color.height - 1] * 2, dtype=float)
    v[5:] = color.height - 1 - v[5:]
    x, y = color.rays(u, v)
    rays = np.stack([x, y, np.ones_like(x)])
    spans = []
    for z in (camera.min_z_m, 20.0):
        at = np.asarray(camera.rotation).T @ (z * rays - np.reshape(camera.translation_m, (3, 1)))
        spans.append(
            [at[0] / at[2] * depth.fx_px + depth.cx_px, at[1] / at[2] * depth.fy_px + depth.cy_px]
        )
    low = np.min(spans, axis=(0, 2)) - _MARGIN_PX
    high = np.max(spans, axis=(0, 2)) + _MARGIN_PX
    # What hides a pixel from the right imager stands up to the largest disparity to its right.
    high[0] += depth.fx_px * camera.baseline_m / camera.min_z_m
    left, top = np.maximum(np.floor(low), 0).astype(int).tolist()
    right, bottom = np.minimum(np.ceil(high), [depth.width, depth.height]).astype(int).tolist()
    return replace(
        depth,
        width=right - left,
        height=bottom - top,
        cx_px=depth.cx_px - left,
        cy_px=depth.cy_px - top,
    )


def color_sources(
    depth_m: NDArray[np.float32], seen_by: Intrinsics, camera: D4xx
) -> NDArray[np.int32]:
    """Return which depth pixel each colour pixel takes its reading from.

    The rule is `align_depth_to_color`'s, as indices, so that a burst needs it once.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (h, w)
        Metres; 0 where there is no reading.
    seen_by : Intrinsics
        Of that picture: the depth camera's, or of a part of it.
    camera : D4xx
        The colour camera, and where it stands.

    Returns
    -------
    ndarray of int32, shape (color height, color width)
        Flat index into `depth_m`; -1 where no reading falls. Of several the nearest.
    """
    width, height = camera.color.size
    flat = np.flatnonzero(depth_m > 0)
    z = depth_m.ravel()[flat]
    # Far before near: the last one written stays. 0.1 mm is finer than any depth unit in use.
    order = np.argsort(np.minimum(z * 1e4, 65535).astype(np.uint16), kind="stable")[::-1]
    flat, z = flat[order].astype(np.int32), z[order]
    v, u = np.divmod(flat, np.int32(seen_by.width))
    x0, y0 = _corner(u, v, -0.5, z, seen_by, camera)
    x1, y1 = _corner(u, v, 0.5, z, seen_by, camera)
    best = np.full(height * width, -1, np.int32)
    nearest = np.full(height * width, np.inf, np.float32)
    for dy in range(int((y1 - y0).max(initial=-1)) + 1):
        for dx in range(int((x1 - x0).max(initial=-1)) + 1):
            x, y = x0 + dx, y0 + dy
            part = (x <= x1) & (y <= y1) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
            at = y[part] * width + x[part]
            mine = np.full(height * width, -1, np.int32)
            mine[at] = flat[part]
            reach = np.where(mine >= 0, depth_m.ravel()[mine], np.float32(np.inf))
            closer = reach < nearest
            np.copyto(best, mine, where=closer)
            np.copyto(nearest, reach, where=closer)
    return best.reshape(height, width)


def _corner(
    u: NDArray[np.int32],
    v: NDArray[np.int32],
    by: float,
    z: NDArray[np.float32],
    seen_by: Intrinsics,
    camera: D4xx,
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    color = camera.color
    x, y = seen_by.rays(
        (u + np.float32(by)).astype(np.float32), (v + np.float32(by)).astype(np.float32)
    )
    turn = np.asarray(camera.rotation, np.float32)
    move = np.asarray(camera.translation_m, np.float32)
    if (turn == np.eye(3)).all():
        points = [x * z + move[0], y * z + move[1], z + move[2]]
    else:
        points = [(r[0] * x + r[1] * y + r[2]) * z + m for r, m in zip(turn, move, strict=True)]
    px, py = distort(
        points[0] / points[2], points[1] / points[2], color.distortion, color.coefficients
    )
    px = px * np.float32(color.fx_px) + np.float32(color.cx_px + 0.5)
    py = py * np.float32(color.fy_px) + np.float32(color.cy_px + 0.5)
    return px.astype(np.int32), py.astype(np.int32)
