"""Simulate a stereo depth camera of the D400 series."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from scipy.special import ndtri

from cucumbervision.capture.intrinsics import Intrinsics, Stream, color_sources
from cucumbervision_lab.arrays import Array32, Generator, Mask, Pixels
from cucumbervision_lab.scenes.scene import Kind, Scene, View, ray_grid, render

_COARSE_SIGMA = 1.5  # least blur on a coarse grid, px, for smooth cubic upsampling


# Error model of the stereo matcher. Within its window, disparities of one surface are averaged,
# which blends small steps and flattens narrow bodies.
_WINDOW_PX, _RANGE_PX = 7.0, 2.0  # standard deviations, of the image and of disparity
_HOLE_PX = 3.5  # step from which the nearer side loses readings, the farther side at twice that
_GAP_PX, _GAP_LOST = 2, 0.7  # width of the gap on the farther side, and its share of lost readings
_BORDER_PX, _BORDER_LOST = 5, 0.16  # on the nearer side; twice that share in the outer half
_HIDDEN_FILLED = 0.06  # share of what the right imager does not see that reads the farther side
_THIN_PX, _THIN_LOST = 5, 0.6  # width below which objects are thin, and their lost readings
_SPECKLE = 0.0003  # share of isolated lost readings
_CLUMP_PX = 5.0  # size of clustered holes

_BASELINE_M = 0.050  # between the imagers of a D435
_COLOR_OFF_M = (0.015, 0.0, 0.0)  # position of the depth camera as the colour camera sees it
_CORRELATION_PX = 5.0  # standard deviation of the Gaussian filter of the noise
_MIN_Z_M = 0.28


def smooth_field(shape: tuple[int, ...], sigma_px: float, rng: Generator) -> Array32:
    """Generate smooth Gaussian noise with mean 0 and standard deviation 1.

    Parameters
    ----------
    shape : tuple of int
        (H, W).
    sigma_px : float
        Standard deviation of the Gaussian filter applied to white noise, pixels.
    rng : numpy.random.Generator
        Random generator.

    Notes
    -----
    Wide filters are applied on a coarser grid and upsampled, which is much faster.

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
    # Normalise by the expected variance, not the sample variance, which varies for wide filters.
    strength = np.float32(2 * np.sqrt(np.pi) * sigma_px / scale)
    return np.asarray(field * strength, np.float32)


def _hidden_from_right(disparity_px: Array32) -> Mask:
    """Return the pixels of the left imager that are occluded in the right imager.

    A point at column x appears at x - d in the right imager. It is occluded if a point further
    right in the row appears at the same column or further left. The occluded band is left of the
    nearer object and as wide as the disparity step.

    Parameters
    ----------
    disparity_px : ndarray of float32, shape (H, W)
        Array32 in the left imager.

    Examples
    --------
    >>> row = np.array([[2, 2, 2, 2, 2, 5, 5, 2, 2]], np.float32)
    >>> _hidden_from_right(row)[0].astype(int).tolist()
    [0, 0, 1, 1, 1, 0, 0, 0, 0]
    """
    column_px = np.arange(disparity_px.shape[1], dtype=np.float32) - disparity_px
    leftmost = np.minimum.accumulate(column_px[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(column_px.shape, np.bool_)
    # Tolerance of a quarter pixel against rounding at the last pixel of the far side.
    hidden[:, :-1] = leftmost[:, 1:] < column_px[:, :-1] + 0.25
    return hidden


def match(disparity_px: Array32, rng: Generator) -> tuple[Array32, Mask, Mask]:
    """Simulate a stereo matcher on exact disparity, without noise, as all frames of a burst share.

    Parameters
    ----------
    disparity_px : ndarray of float32, shape (H, W)
        Exact disparity; 0 for no object.
    rng : numpy.random.Generator
        Random generator.

    Returns
    -------
    disparity_px : ndarray of float32, shape (H, W)
        Array32 without noise.
    valid, unsure : ndarray of bool, shape (H, W)
        Pixels with a reading in most frames, and pixels near discontinuities whose readings
        flicker.
    """
    side = 2 * round(1.5 * _WINDOW_PX) + 1
    smooth = cv2.bilateralFilter(disparity_px, side, _RANGE_PX, _WINDOW_PX)
    read = np.asarray(smooth, np.float32)
    clump = smooth_field(read.shape, _CLUMP_PX / 2, rng)
    step = np.float32(_HOLE_PX)
    gap = cv2.dilate(read, _disc(_GAP_PX)) - read > 2 * step
    lost = gap & (clump < _quantile(_GAP_LOST))
    outer, border = (
        read - cv2.erode(read, _disc(width)) > step for width in (_BORDER_PX // 2, _BORDER_PX)
    )
    lost |= border & (clump < _quantile(_BORDER_LOST))
    lost |= outer & (clump < _quantile(2 * _BORDER_LOST))
    hidden = _hidden_from_right(read)
    lost |= hidden & (clump < _quantile(1 - _HIDDEN_FILLED))
    lost |= _thin(disparity_px) & (clump < _quantile(_THIN_LOST))
    lost |= rng.random(read.shape, dtype=np.float32) < _SPECKLE
    return read, ~lost & (disparity_px > 0) & (read > 0), border


def _disc(radius_px: int) -> Pixels:
    side = 2 * radius_px + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)


def _thin(disparity_px: Array32) -> Mask:
    window = np.ones((_THIN_PX, _THIN_PX), np.uint8)
    opened = cv2.morphologyEx(disparity_px, cv2.MORPH_OPEN, window)
    return np.asarray(disparity_px - opened > 2 * _HOLE_PX)


def _quantile(share: float) -> float:
    return float(ndtri(share))


VGA = (640, 480)
"""Size of depth frames in the real captures of cucumbers."""

_MARGIN_PX = 24

_FLICKER = 0.1  # share of missing readings per frame near discontinuities


@dataclass(frozen=True)
class D4xx:
    """Parameters of a depth camera, 15 mm beside its colour camera.

    Parameters
    ----------
    color, depth : Intrinsics
        Intrinsics of the colour camera and of the depth camera (the left imager).
    disparity_rms_px : float
        RMS noise of disparity, pixels of the depth camera.
    fixed_share : float
        Share of the noise variance that is constant over time.
    subpixel_step_px : float
        Quantisation of disparity.
    registration_px : tuple of float
        Standard deviation of the error of the alignment to colour, right and down, colour pixels.
    foliage_holes, glare_holes : float
        Share of invalid pixels on leaves, and on the glossy side of fruit (0 for dry fruit in
        shade).
    unit_m : float
        Quantisation of depth, metres.
    min_z_m : float
        Minimum depth, metres.

    Examples
    --------
    >>> camera = D4xx.like(Intrinsics(1280, 720, 924.0, 924.0, 640.0, 360.0))
    >>> camera.depth.fx_px, camera.min_z_m
    (640.0, 0.28)
    """

    color: Intrinsics
    depth: Intrinsics
    disparity_rms_px: float = 0.19
    fixed_share: float = 0.7
    subpixel_step_px: float = 1 / 32
    registration_px: tuple[float, float] = (2.2, 0.7)
    foliage_holes: float = 0.02
    glare_holes: float = 0.0
    unit_m: float = 0.001
    min_z_m: float = _MIN_Z_M

    @classmethod
    def like(cls, color: Intrinsics, depth_size: tuple[int, int] | None = None) -> D4xx:
        """Create a D435 from colour intrinsics, with depth frames of the same size or of `VGA`.

        The focal length of a D435's imagers is half the width at 16:9; 640x480 shows less of the
        sensor, and readings from nearer.
        """
        width, height = depth_size or color.size
        focal = height * (0.8 if depth_size == VGA else 640.0 / 720.0)
        depth = Intrinsics(width, height, focal, focal, width / 2, height / 2, Stream.DEPTH)
        return cls(color, depth, min_z_m=_MIN_Z_M * focal / 640 if depth_size else _MIN_Z_M)


def sense(scene: Scene, camera: D4xx, rng: Generator, frames: int = 5) -> list[Array32]:
    """Simulate a burst of depth frames, aligned to colour.

    Parameters
    ----------
    scene : Scene
        Scene in the coordinates of the colour camera.
    camera : D4xx
        The camera.
    rng : numpy.random.Generator
        Random generator.
    frames : int
        Number of frames. They share the temporally constant part of the noise and most holes.

    Returns
    -------
    list of ndarray of float32, shape (color height, color width)
        Depth in metres, multiples of `unit_m`; 0 for no reading.

    Raises
    ------
    ValueError
        If a body extends behind a camera.

    Notes
    -----
    Array32 noise of RMS s corresponds to depth noise of z² s / (f B). The alignment to colour
    is computed once per burst, because temporal noise shifts it by less than a tenth of a pixel.

    Examples
    --------
    >>> from cucumbervision_lab.scenes.scene import Plane
    >>> from cucumbervision_lab.scenes.scene import Scene
    >>> camera = D4xx.like(Intrinsics(320, 180, 231.0, 231.0, 160.0, 90.0))
    >>> wall = Scene((), planes=(Plane.facing(0.5),))
    >>> burst = sense(wall, camera, np.random.default_rng(1), frames=3)
    >>> len(burst), bool(abs(np.median(burst) - 0.5) < 0.005)
    (3, True)
    """
    seen_by = _visible_part(camera)
    view = render(scene.moved(np.eye(3), -np.asarray(_COLOR_OFF_M)), seen_by)
    focal_baseline = seen_by.fx_px * _BASELINE_M
    depth = view.depth_m.astype(np.float32)
    exact = np.divide(focal_baseline, depth, out=np.zeros_like(depth), where=depth > 0)
    disparity, valid, unsure = match(exact, rng)
    valid &= ~_surface_holes(view, seen_by, camera, rng)
    waves = smooth_field(exact.shape, _CORRELATION_PX, rng)
    waves *= np.float32(camera.disparity_rms_px * np.sqrt(camera.fixed_share))
    settled = np.maximum(disparity + waves, np.float32(camera.subpixel_step_px))
    base = np.where(valid, focal_baseline / settled, 0).astype(np.float32)
    # An error of the alignment moves all readings, as if the principal point lay elsewhere.
    color, (off_x, off_y) = camera.color, rng.normal(0, camera.registration_px).tolist()
    aligned = replace(color, cx_px=color.cx_px + off_x, cy_px=color.cy_px + off_y)
    sources = color_sources(base, seen_by, aligned, np.eye(3), _COLOR_OFF_M)
    hit = sources >= 0
    burst = []
    for _ in range(frames):
        reading = _frame(settled, valid, unsure, focal_baseline, camera, rng)
        burst.append(np.where(hit, reading.ravel()[sources], np.float32(0)))
    return burst


def _frame(
    settled_px: Array32,
    valid: Mask,
    unsure: Mask,
    focal_baseline: float,
    camera: D4xx,
    rng: Generator,
) -> Array32:
    fresh = smooth_field(settled_px.shape, _CORRELATION_PX, rng)
    fresh *= np.float32(camera.disparity_rms_px * np.sqrt(1 - camera.fixed_share))
    fresh += settled_px
    step = np.float32(camera.subpixel_step_px)
    disparity = np.maximum(np.rint(fresh / step), 1) * step
    depth = np.float32(focal_baseline) / disparity
    units = np.rint(depth / np.float32(camera.unit_m))
    reading = np.asarray(units * np.float32(camera.unit_m), np.float32)
    reading[~valid | (reading < camera.min_z_m)] = 0.0
    v, u = np.nonzero(unsure)
    gone = rng.random(len(v)) < _FLICKER
    reading[v[gone], u[gone]] = 0.0
    return reading


def _surface_holes(view: View, seen_by: Intrinsics, camera: D4xx, rng: Generator) -> Mask:
    lost = np.zeros(view.depth_m.shape, np.bool_)
    if camera.foliage_holes > 0 and (view.kind == Kind.LEAF).any():
        clump = smooth_field(lost.shape, 2 * _CLUMP_PX, rng)
        lost |= (view.kind == Kind.LEAF) & (clump < np.quantile(clump, camera.foliage_holes))
    if camera.glare_holes > 0 and (view.kind == Kind.FRUIT).any():
        grid = ray_grid(seen_by)
        v, u = np.nonzero(view.kind == Kind.FRUIT)
        light = rng.normal([0.0, -0.7, -0.5], 0.4)
        towards = -np.stack([grid.x[v, u], grid.y[v, u], np.ones(len(v))], axis=1)
        half = towards / np.linalg.norm(towards, axis=1)[:, None] + light / np.linalg.norm(light)
        shine = (view.normal[v, u] * half).sum(axis=1) / np.linalg.norm(half, axis=1)
        wobble = 0.03 * smooth_field(lost.shape, _CLUMP_PX, rng)[v, u]
        shining = shine + wobble
        gone = shining > np.quantile(shining, 1 - camera.glare_holes)
        lost[v[gone], u[gone]] = True
    return lost


@lru_cache(maxsize=8)
def _visible_part(camera: D4xx) -> Intrinsics:
    """Return the intrinsics of the part of the depth picture that the colour camera can see."""
    color, depth = camera.color, camera.depth
    u = np.array([0, color.width / 2, color.width - 1, 0, color.width - 1] * 2, dtype=float)
    v = np.array([0, 0, 0, color.height - 1, color.height - 1] * 2, dtype=float)
    v[5:] = color.height - 1 - v[5:]
    x, y = color.rays(u, v)
    rays = np.stack([x, y, np.ones_like(x)])
    spans = []
    for z in (camera.min_z_m, 20.0):
        point_m = z * rays - np.reshape(_COLOR_OFF_M, (3, 1))
        spans.append(
            [
                point_m[0] / point_m[2] * depth.fx_px + depth.cx_px,
                point_m[1] / point_m[2] * depth.fy_px + depth.cy_px,
            ]
        )
    lower = np.min(spans, axis=(0, 2)) - _MARGIN_PX
    upper = np.max(spans, axis=(0, 2)) + _MARGIN_PX
    # Objects up to the largest disparity further right can occlude a pixel in the right imager.
    upper[0] += depth.fx_px * _BASELINE_M / camera.min_z_m
    first_column, top = np.maximum(np.floor(lower), 0).astype(int).tolist()
    right, bottom = np.minimum(np.ceil(upper), [depth.width, depth.height]).astype(int).tolist()
    return replace(
        depth,
        width=right - first_column,
        height=bottom - top,
        cx_px=depth.cx_px - first_column,
        cy_px=depth.cy_px - top,
    )
