"""What the picture shows of one fruit, as the tube fit takes it: depth points and outline rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.frames import valid_depth
from cucumbervision.geometry.outline import depth_across, outline_cracks
from cucumbervision.geometry.tube_guess import near_depths

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.capture.intrinsics import Intrinsics

__all__ = ["TubeView", "depth_noise", "view_tube"]

DEPTH_POINTS = 500
OUTLINE_POINTS = 200
GRID_POINTS = 800
MARGIN_PX = 8
RIM_PX = 3  # depth this near the outline mixes the fruit with what lies behind
MIN_PIECE = 0.02  # pieces of the mask below this share of it are specks
DISPARITY_RMS_PX = 0.08
DEPTH_FOCAL_RATIO = 0.69  # of a D435's depth camera to its colour camera
BASELINE_M = 0.050
QUANTUM_M = 0.001
# Stereo noise and outline errors are smooth over some pixels: how many count as one reading.
POINT_AREA_PX = 100.0
OUTLINE_RUN_PX = 6.0
CRACKS_A_PIXEL = 4 / np.pi  # of outline, averaged over its directions
NEARER_M, NEARER_SD = 0.003, 2.0  # what across the outline is an occluder, and no noise


@dataclass(frozen=True, eq=False)
class TubeView:
    """One fruit's evidence.

    Parameters
    ----------
    points_m : ndarray of float64, shape (N, 3)
        Depth points off the outline, camera coordinates, metres.
    points_sd_m : ndarray of float64, shape (N,)
        Their depth's standard deviation.
    points_share : float
        How many independent readings one of them counts for.
    rays : ndarray of float64, shape (M, 3)
        Unit directions through the fruit's own outline: not where something nearer covers it,
        not at the picture's edge.
    rays_share : float
        How many independent readings one of them counts for.
    grid_rays : ndarray of float64, shape (G, 3)
        Unit directions of a coarse grid over the fruit's window.
    grid_mask : ndarray of bool, shape (G,)
        Which of them belong to the mask.
    grid_depth_m : ndarray of float64, shape (G,)
        The depth there; 0 where there is none.
    fill : float
        Share of the mask's pixels with a depth reading.
    focal_px : float
        Focal length, pixels.
    """

    points_m: NDArray[np.float64]
    points_sd_m: NDArray[np.float64]
    points_share: float
    rays: NDArray[np.float64]
    rays_share: float
    grid_rays: NDArray[np.float64]
    grid_mask: NDArray[np.bool_]
    grid_depth_m: NDArray[np.float64]
    fill: float
    focal_px: float

    @property
    def surface_m(self) -> NDArray[np.float64]:
        """Points over the whole mask, to start from: where depth is missing, a plane's.

        Shape (K, 3), camera coordinates, metres.
        """
        bare = self.grid_rays[self.grid_mask & (self.grid_depth_m <= 0)]
        if not len(bare):
            return self.points_m
        # A plane in space is linear in the inverse depth over the picture.
        near = self.points_m[near_depths(self.points_m)]
        terms = np.column_stack([near[:, :2] / near[:, 2:], np.ones(len(near))])
        plane = np.linalg.lstsq(terms, 1 / near[:, 2], rcond=None)[0]
        inverse = (bare / bare[:, 2:])[:, [0, 1]] @ plane[:2] + plane[2]
        middle = 1 / float(np.median(near[:, 2]))
        filled = bare / bare[:, 2:] / np.clip(inverse, 0.5 * middle, 2.0 * middle)[:, None]
        return np.vstack([self.points_m, filled])


def depth_noise(far_m: NDArray[np.float64], focal_px: float) -> NDArray[np.float64]:
    """Give a D4xx's RMS depth error at a distance, metres: z² s / (f B).

    Parameters
    ----------
    far_m : ndarray of float64
        Distance along z.
    focal_px : float
        The colour camera's focal length, from which the depth camera's follows.

    Examples
    --------
    >>> bool(depth_noise(np.array(0.5), 924.0).round(5) == 0.00063)
    True
    """
    return far_m**2 * (DISPARITY_RMS_PX / (focal_px * DEPTH_FOCAL_RATIO * BASELINE_M))


def view_tube(
    depth_m: NDArray[np.float32], mask: NDArray[np.bool_], intrinsics: Intrinsics
) -> TubeView | None:
    """Gather a fruit's depth points and outline.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour.
    mask : ndarray of bool, shape (H, W)
        The fruit's pixels; pieces below 2 % of them are left out.
    intrinsics : Intrinsics
        The colour stream's.

    Returns
    -------
    TubeView or None
        None for an empty mask.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None
    top, left = max(int(rows[0]) - MARGIN_PX, 0), max(int(columns[0]) - MARGIN_PX, 0)
    window = np.s_[top : int(rows[-1]) + 1 + MARGIN_PX, left : int(columns[-1]) + 1 + MARGIN_PX]
    part, z = _without_specks(mask[window]), depth_m[window]
    z = np.where(valid_depth(z), z, np.float32(0))
    lens = _Lens(intrinsics, left, top)
    points, points_share = _points(z, part, lens)
    far = points[:, 2]
    noise = depth_noise(far, intrinsics.fx_px)
    rays, rays_share = _rays(z, part, lens)
    step = max(1, int(np.sqrt(part.size / GRID_POINTS)))
    v, u = (m.ravel() * step for m in np.indices(part[::step, ::step].shape))
    return TubeView(
        points,
        np.hypot(noise, QUANTUM_M / np.sqrt(12)),
        points_share,
        rays,
        rays_share,
        lens.rays(u, v),
        part[v, u],
        z[v, u].astype(np.float64),
        float((z[part] > 0).mean()),
        intrinsics.fx_px,
    )


@dataclass(frozen=True)
class _Lens:
    """The camera as seen from a window's corner."""

    intrinsics: Intrinsics
    left: int
    top: int

    def rays(self, u: NDArray[Any], v: NDArray[Any]) -> NDArray[np.float64]:
        x, y = self.intrinsics.rays(u + self.left, v + self.top)
        long = np.sqrt(x * x + y * y + 1)
        return np.stack([x / long, y / long, 1 / long], axis=1)


def _without_specks(part: NDArray[np.bool_]) -> NDArray[np.bool_]:
    import cv2

    count, labels, stats, _ = cv2.connectedComponentsWithStats(part.view(np.uint8), connectivity=8)
    if count <= 2:
        return part
    areas = np.asarray(stats)[:, cv2.CC_STAT_AREA]
    kept = areas >= min(MIN_PIECE * areas[1:].sum(), areas[1:].max())
    kept[0] = False
    return np.asarray(kept[np.asarray(labels)])


def _points(
    z: NDArray[np.float32], part: NDArray[np.bool_], lens: _Lens
) -> tuple[NDArray[np.float64], float]:
    import cv2

    size = 2 * RIM_PX + 1
    # The picture's edge is no outline: pixels there are as good as any.
    kernel = np.ones((size, size), np.uint8)
    core = (cv2.erode(part.astype(np.uint8), kernel, borderValue=1) > 0) & (z > 0)
    area = int(np.count_nonzero(core))
    step = max(1, int(np.sqrt(area / DEPTH_POINTS)))
    v, u = np.nonzero(core[::step, ::step])
    some = np.linspace(0, len(u) - 1, min(len(u), DEPTH_POINTS)).astype(np.intp)
    u, v = u[some] * step, v[some] * step
    rays = lens.rays(u, v)
    points = rays * (z[v, u] / rays[:, 2])[:, None]
    return points, min(1.0, area / POINT_AREA_PX / max(len(points), 1))


def _rays(
    z: NDArray[np.float32], part: NDArray[np.bool_], lens: _Lens
) -> tuple[NDArray[np.float64], float]:
    points, outward = outline_cracks(part)
    inside, outside = depth_across(z, points, -outward), depth_across(z, points, outward)
    noise = depth_noise(np.nan_to_num(inside), lens.intrinsics.fx_px)
    # Comparisons with NaN are False: without a reading on both sides nothing is known to cover.
    kept = points[~(outside < inside - NEARER_M - NEARER_SD * noise)]
    long_px = len(kept) / CRACKS_A_PIXEL
    some = np.linspace(0, len(kept) - 1, min(len(kept), OUTLINE_POINTS)).astype(np.intp)
    rays = lens.rays(kept[some, 0], kept[some, 1])
    return rays, min(1.0, long_px / OUTLINE_RUN_PX / max(len(rays), 1))
