"""A stereo depth camera of the D400 family, from exact scenes to the frames that it gives."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.capture.intrinsics import Intrinsics, Stream
from cucumbervision.geometry.camera import distort
from cucumbervision_lab.synthesis.raycast import ray_grid
from cucumbervision_lab.synthesis.scene import Kind, render
from cucumbervision_lab.synthesis.stereo_matching import Matched, Matcher, match, smooth_field

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision_lab.synthesis.scene import Scene, View

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
    registration_px : tuple of float
        By how much (u, v) depth stands off colour, colour pixels: the rig's own error, or motion
        between both exposures.
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
    registration_px: tuple[float, float] = (0.0, 0.0)
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

    def drawn(self, rng: np.random.Generator, scale_sd: float = 0.01) -> D4xx:
        """Sample one camera of the series, with a scale error of its own.

        The data sheet allows 2 % at 2 m, taken as two standard deviations.
        """
        return replace(self, scale_error=float(rng.normal(0.0, scale_sd)))


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
    px = px * np.float32(color.fx_px) + np.float32(color.cx_px + camera.registration_px[0] + 0.5)
    py = py * np.float32(color.fy_px) + np.float32(color.cy_px + camera.registration_px[1] + 0.5)
    return px.astype(np.int32), py.astype(np.int32)
