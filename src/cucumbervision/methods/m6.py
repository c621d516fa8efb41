"""M6, the swept tube: this project's own method."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cucumbervision.capture.frames import valid_depth
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.masks import distances_inside, mask_window, without_specks
from cucumbervision.methods.depth_doubts import LEAST_FILL
from cucumbervision.methods.flags import Flag
from cucumbervision.methods.hidden_end import (
    DRAWN_KINDS,
    BeyondEnd,
    beyond_ends,
    depth_noise,
    edge_error,
    noise_waves,
    with_hidden_end,
)
from cucumbervision.methods.result import (
    LengthKind,
    Measurement,
    MethodName,
    Reason,
    TubeFit,
    TubeTraits,
)
from cucumbervision.methods.table import own_method
from cucumbervision.methods.traits import tube_traits
from cucumbervision.tube.evidence import (
    Evidence,
    depth_across,
    end_overhangs,
    gaps,
    outline_cracks,
    quick_median,
)
from cucumbervision.tube.fit import (
    TubeFitting,
    fit_shape,
    guess_from_midline,
    guess_from_picture,
    guess_shape,
    near_depths,
)
from cucumbervision.tube.shape import TubeShape, with_tips

_DEPTH_POINTS = 500

_OUTLINE_POINTS = 800

_GRID_POINTS = 800

_MARGIN_PX = 8

_RIM_PX = 3  # depth this near the outline mixes the fruit with what lies behind

_QUANTUM_M = 0.001

# Stereo noise and outline errors are correlated: pixels that count as one independent reading.
_POINT_AREA_PX = 100.0

_OUTLINE_RUN_PX = 6.0

_CRACKS_A_PIXEL = 4 / np.pi  # cracks per pixel of outline, averaged over directions

_NEARER_M, _NEARER_SD = 0.003, 2.0  # depth step across the outline that indicates an occluder


class TubeView:
    """The depth and outline of one fruit, for fitting a tube.

    `evidence` holds depth points away from the outline, and rays through the fruit's own outline,
    without parts at occluders and at the edge of the picture; `grid_rays` unit directions of a
    coarse grid over the fruit's window, `grid_mask` whether each belongs to the mask, and
    `grid_depth_m` its depth, 0 for no reading.
    """

    def __init__(
        self, depth_m: NDArray[np.float32], mask: NDArray[np.bool_], intrinsics: Intrinsics
    ) -> None:
        window = mask_window(mask, _MARGIN_PX) or (slice(0, 0), slice(0, 0))
        self._mask, depth_m = without_specks(mask[window]), depth_m[window]
        self._depth_m = np.where(valid_depth(depth_m), depth_m, np.float32(0))
        self._intrinsics, self._corner = intrinsics, (window[1].start, window[0].start)
        self.focal_px = intrinsics.fx_px
        self.fill = float((self._depth_m[self._mask] > 0).mean())
        self.is_sparse = self.fill < LEAST_FILL
        step = max(1, int(np.sqrt(self._mask.size / _GRID_POINTS)))
        v, u = (m.ravel() * step for m in np.indices(self._mask[::step, ::step].shape))
        self.grid_rays, self.grid_mask = self._rays(u, v), self._mask[v, u]
        self.grid_depth_m = self._depth_m[v, u].astype(np.float64)
        self.evidence = self._evidence()

    def _rays(self, u: NDArray[Any], v: NDArray[Any]) -> NDArray[np.float64]:
        x, y = self._intrinsics.rays(u + self._corner[0], v + self._corner[1])
        lengths = np.sqrt(x * x + y * y + 1)
        return np.stack([x / lengths, y / lengths, 1 / lengths], axis=1)

    def _evidence(self) -> Evidence:
        kernel = np.ones((2 * _RIM_PX + 1, 2 * _RIM_PX + 1), np.uint8)
        # The edge of the picture is not an outline: pixels there are not eroded.
        core = cv2.erode(self._mask.astype(np.uint8), kernel, borderValue=1) > 0
        core &= self._depth_m > 0
        area = int(np.count_nonzero(core))
        step = max(1, int(np.sqrt(area / _DEPTH_POINTS)))
        v, u = np.nonzero(core[::step, ::step])
        sample = np.linspace(0, len(u) - 1, min(len(u), _DEPTH_POINTS)).astype(np.intp)
        u, v = u[sample] * step, v[sample] * step
        pixels, directions = np.stack([u, v], axis=1), self._rays(u, v)
        points = directions * (self._depth_m[v, u] / directions[:, 2])[:, None]
        from_rim_px = distances_inside(np.pad(self._mask, 1, mode="edge"), pixels + 1)
        noise = np.hypot(depth_noise(points[:, 2], self.focal_px), edge_error(from_rim_px))
        outline = self._own_outline()
        long_px = len(outline) / _CRACKS_A_PIXEL
        count = min(len(outline), _OUTLINE_POINTS)
        sample = np.linspace(0, len(outline) - 1, count).astype(np.intp)
        return Evidence(
            points_m=points,
            points_sd_m=np.hypot(noise, _QUANTUM_M / np.sqrt(12)),
            rays=self._rays(*outline[sample].T),
            rays_sd_rad=_OUTLINE_SD_PX / self.focal_px,
            pixel_rad=1 / self.focal_px,
            points_share=min(1.0, area / _POINT_AREA_PX / max(len(points), 1)),
            rays_share=min(1.0, long_px / _OUTLINE_RUN_PX / max(count, 1)),
            waves_m=noise_waves(pixels, points[:, 2], self.focal_px),
        )

    def _own_outline(self) -> NDArray[np.float64]:
        points, outward = outline_cracks(self._mask)
        inside, outside = (depth_across(self._depth_m, points, s * outward) for s in (-1, 1))
        noise = depth_noise(np.nan_to_num(inside), self.focal_px)
        # Comparisons with NaN are False: without readings on both sides, no occluder is assumed.
        return np.asarray(points[~(outside < inside - _NEARER_M - _NEARER_SD * noise)])

    @property
    def surface_m(self) -> NDArray[np.float64]:
        """Initial points over the whole mask; missing depth is filled by a plane.

        Shape (K, 3), camera coordinates, metres.
        """
        bare = self.grid_rays[self.grid_mask & (self.grid_depth_m <= 0)]
        points = self.evidence.points_m
        if not len(bare):
            return points
        # A plane in space is linear in the inverse depth over the picture.
        readings = points[near_depths(points)]
        terms = np.column_stack([readings[:, :2] / readings[:, 2:], np.ones(len(readings))])
        plane = np.linalg.lstsq(terms, 1 / readings[:, 2], rcond=None)[0]
        inverse = (bare / bare[:, 2:])[:, [0, 1]] @ plane[:2] + plane[2]
        middle = 1 / float(np.median(readings[:, 2]))
        filled = bare / bare[:, 2:] / np.clip(inverse, 0.5 * middle, 2.0 * middle)[:, None]
        return np.vstack([points, filled])


_MIN_POINTS = 30
_MIN_RAYS = 20
_BALLS = 128
_RANGE_M = (0.02, 1.0)
_OUTLINE_SD_PX = 0.7
_MIN_EXPLAINED = 0.5  # minimum share of the mask that a tube must cover
_GOOD_EXPLAINED, _GOOD_OUTLINE = 0.9, 0.1
_ON_SURFACE_SD, _ON_SURFACE_M, _GOOD_ON_SURFACE = 4.0, 0.002, 0.8
_MAY_BE_FRUIT, _CLEARLY_BETTER = 0.01, 0.03  # shares of the points, and of the silhouette
# Two fruit in one outline overlap their tube by 0.72 to 0.82, 47 real fruit by 0.84 to 0.99.
_LEAST_OVERLAP = 0.83
# Outside these limits, other initial shapes are tried
_GOOD_OVERLAP, _UNSURE_M, _FITS_ALIKE = 0.9, 0.004, 4.0
_FULL_OVERLAP = 0.97  # below it, with a middle line longer than the fit, a hook may be cut short
_LEAST_SEEN = 6  # readings needed for these initial shapes
# Tolerances of misfit and silhouette where most depth is missing: there a few wrong readings
# dominate the misfit, so it counts less.
_SPARSE_ALIKE, _SPARSE_BETTER = 0.1, 0.05
_END_ON_DEG = 70.0
_STEEP, _TOO_LONG_SD = 0.87, 3.0  # beyond 60 degrees, and too long for the girth
PART_HIDDEN, _UNCERTAIN = 0.1, 0.05
# Roughness of the outline; a detector's mask that fills the hollow of a bend has 5
_SMOOTH_PX = 2.5


def measure_m6(
    depth_m: NDArray[np.float32], mask: NDArray[np.bool_] | None, intrinsics: Intrinsics
) -> Measurement:
    """Fit a swept tube to a fruit's depth and outline.

    A smooth curve with a radius along it and round ends, fitted to the mask's depth points and
    to the rays through its outline at once (`geometry.tube_fit`), each weighted by its own
    error: depth by the sensor's noise at that distance. The outline along nearer objects is
    ignored, so that a part behind a leaf is bridged; there is no depth gate.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour.
    mask : ndarray of bool, shape (H, W), optional
        The fruit's pixels.
    intrinsics : Intrinsics
        The colour stream's.

    Returns
    -------
    Measurement
        `length_m` is the centreline (kind 'centreline'); `tube` has all three lengths and `fit`
        everything else. Reason 'too-few-points' (of depth), 'outline-too-short' (hardly any of
        the outline is the fruit's own), 'not-a-tube', 'along-the-view' (it points along the view
        and is far too long for its girth), 'out-of-range'.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> from cucumbervision_lab.scenes.scene import Scene, render
    >>> from cucumbervision_lab.scenes.bodies import arc_tube, rotation
    >>> camera = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    >>> fruit = arc_tube(0.20, 0.02, 0.30).moved(rotation(tilt_deg=40), (0, 0, 0.5))
    >>> scene = render(Scene.of(fruit), camera)
    >>> result = measure_m6(scene.depth_m.astype(np.float32), scene.mask(0), camera)
    >>> round(result.tube.centreline_m, 3), round(result.tube.thread_m / fruit.thread_m, 2)
    (0.2, 1.0)
    """
    if mask is None:
        return Measurement(MethodName.M6, reason=Reason.NO_MASK)
    if not mask.any():
        return Measurement(MethodName.M6, reason=Reason.TOO_FEW_POINTS)
    view = TubeView(depth_m, mask, intrinsics)
    fitting = _fitting(view)
    if isinstance(fitting, Reason):
        return Measurement(MethodName.M6, reason=fitting)
    overhangs = end_overhangs(fitting.shape, fitting.rays, view.evidence.rays)
    traits = tube_traits(*with_tips(*fitting.shape.balls(_BALLS), overhangs))
    length = traits.lengths.centreline_m
    if not _RANGE_M[0] <= length <= _RANGE_M[1]:
        return Measurement(MethodName.M6, reason=Reason.OUT_OF_RANGE)
    fit = _fit(
        view, fitting, traits, beyond_ends(depth_m, mask, intrinsics, *fitting.shape.balls())
    )
    if fit.explained < _MIN_EXPLAINED:
        return Measurement(MethodName.M6, reason=Reason.NOT_A_TUBE)
    fit = with_hidden_end(fit, depth_m, intrinsics)
    return Measurement(MethodName.M6, length, LengthKind.CENTRELINE, path_m=traits.axis_m, fit=fit)


def fits_well(measured: Measurement) -> bool:
    """Return whether a tube fits the mask so well that no other mask is needed.

    A rough outline, or a mask that no tube covers, indicates missing or added parts.

    Parameters
    ----------
    measured : Measurement
        Result of `measure_m6`.

    Examples
    --------
    A bar with depth, and without:

    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> camera = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    >>> depth, bar = np.full((480, 640), 0.5, np.float32), np.zeros((480, 640), bool)
    >>> bar[220:260, 200:440] = True
    >>> [fits_well(measure_m6(readings, bar, camera)) for readings in (depth, 0 * depth)]
    [True, False]
    """
    fit = measured.fit
    return (
        fit is not None
        and fit.outline_rms_px <= _SMOOTH_PX
        and {Flag.POOR_FIT, Flag.UNCERTAIN}.isdisjoint(fit.flags)
    )


def _fitting(view: TubeView) -> TubeFitting | Reason:
    """Return the best-fitting tube of a view, or the reason why there is none."""
    if len(view.evidence.points_m) < _MIN_POINTS:
        return Reason.TOO_FEW_POINTS
    if len(view.evidence.rays) < _MIN_RAYS:
        return Reason.OUTLINE_TOO_SHORT
    try:
        fitting = _best_fit(view)
    except np.linalg.LinAlgError:
        return Reason.NOT_A_TUBE
    shape = fitting.shape
    if not (np.isfinite(shape.bend_m).all() and np.isfinite(shape.width_m).all()):
        return Reason.NOT_A_TUBE
    return Reason.ALONG_THE_VIEW if _runs_away(fitting) else fitting


def _best_fit(view: TubeView) -> TubeFitting:
    surface, evidence = view.surface_m, view.evidence
    level = near_depths(surface)
    fits = [fit_shape(evidence, guess_shape(surface, level))]
    # Points off the plane are background, or the far part of a hook.
    guesses = [guess_shape(surface)] if 1.0 - float(level.mean()) >= _MAY_BE_FRUIT else []
    first = fits[0]
    overlap = _coverage(view, first.shape)[2]
    is_read = view.grid_mask & (view.grid_depth_m > 0)
    unsure = np.count_nonzero(is_read) >= _LEAST_SEEN and (
        overlap < _GOOD_OVERLAP
        or first.centreline_sd_m > _UNSURE_M
        or _end_on(first.shape.balls()[0])
        or view.is_sparse
    )
    if unsure:
        guesses.append(_flat_guess(view))
        if view.is_sparse:
            guesses.append(_flat_guess(view, by_girth=True))
    if unsure or overlap < _FULL_OVERLAP:
        picture = view.grid_rays[:, :2] / view.grid_rays[:, 2:]
        bent = guess_from_midline(picture, view.grid_mask, view.grid_depth_m)
        if bent is not None and (unsure or bent.length_m > first.shape.length_m):
            guesses.append(bent)
    # A guess that extends into the background is longer than any fruit and does not converge.
    fits += [fit_shape(evidence, guess) for guess in guesses if guess.length_m <= _RANGE_M[1]]
    return _better(view, fits) if len(fits) > 1 else first


def _better(view: TubeView, fits: list[TubeFitting]) -> TubeFitting:
    # Clearly better coverage of the mask decides, then the misfit. Of two equal fits, the flatter
    # one is taken, as fruit hang; if most depth is missing, the one of more even thickness.
    overlap = [_coverage(view, fit.shape)[2] for fit in fits]
    least_overlap = max(overlap) - (_SPARSE_BETTER if view.is_sparse else _CLEARLY_BETTER)
    covering = [f for f, o in zip(fits, overlap, strict=True) if o > least_overlap]
    covering = [f for f in covering if not _runs_away(f)] or covering
    least_misfit = min(fit.misfit for fit in covering)
    alike = _SPARSE_ALIKE * least_misfit if view.is_sparse else _FITS_ALIKE
    of_these = [f for f in covering if f.misfit <= least_misfit + alike]
    return min(of_these, key=_unevenness if view.is_sparse else _depth_share)


def _unevenness(fit: TubeFitting) -> float:
    _, radii = fit.shape.balls(5)
    return abs(float(radii[3] - radii[1])) / float(radii[3] + radii[1])


def _runs_away(fit: TubeFitting) -> bool:
    # Along the view, the outline does not constrain the length, and readings of the background
    # extend the body; then only the girth shows that it is too long.
    if _depth_share(fit) < _STEEP:
        return False
    _, radii = fit.shape.balls()
    return DRAWN_KINDS.excess_sd(fit.shape.length_m, 2.0 * float(radii.max())) > _TOO_LONG_SD


def _depth_share(fit: TubeFitting) -> float:
    centres, _ = fit.shape.balls(2)
    run, middle = centres[1] - centres[0], centres.mean(axis=0)
    return abs(float(run @ middle)) / float(np.linalg.norm(run) * np.linalg.norm(middle))


def _flat_guess(view: TubeView, *, by_girth: bool = False) -> TubeShape:
    # The middle line of the outline, with the depth of a plane through most readings.
    rays = view.grid_rays[view.grid_mask]
    picture, depth = rays[:, :2] / rays[:, 2:], view.grid_depth_m[view.grid_mask]
    is_read = depth > 0
    return guess_from_picture(picture, is_read, 1.0 / depth[is_read], by_girth=by_girth)


def _fit(
    view: TubeView, fitting: TubeFitting, traits: TubeTraits, ends: tuple[BeyondEnd, BeyondEnd]
) -> TubeFit:
    explained, hidden, overlap = _coverage(view, fitting.shape)
    rays = fitting.rays
    distances_m = np.linalg.norm(rays.centres_m, axis=1)
    outline_px = 1.4826 * quick_median(np.abs(rays.gap_m) / distances_m) * view.focal_px
    depth_m = 1.4826 * quick_median(np.abs(fitting.points.gap_m))
    first, last = (s and not b.covered for s, b in zip(fitting.ends_seen, ends, strict=True))
    rough = outline_px * quick_median(distances_m) / view.focal_px / traits.diameter_max_m
    surface_m = _ON_SURFACE_SD * view.evidence.points_sd_m + _ON_SURFACE_M
    on_it = float((np.abs(fitting.points.gap_m) <= surface_m).mean())
    fits_mask = explained >= _GOOD_EXPLAINED and overlap >= _LEAST_OVERLAP
    sd = fitting.centreline_sd_m
    doubts = {
        Flag.END_HIDDEN: not (first and last),
        Flag.END_ON: _end_on(traits.axis_m) or traits.may_hide_an_end,
        Flag.PART_HIDDEN: hidden > PART_HIDDEN,
        Flag.POOR_FIT: not fits_mask or rough > _GOOD_OUTLINE or on_it < _GOOD_ON_SURFACE,
        Flag.UNCERTAIN: sd > _UNCERTAIN * traits.lengths.centreline_m,
    }
    return TubeFit(
        traits=traits,
        centreline_sd_m=sd,
        thread_sd_m=sd * traits.lengths.thread_m / traits.lengths.centreline_m,
        hidden_share=hidden,
        explained=explained,
        fill=view.fill,
        outline_rms_px=outline_px,
        depth_rms_m=depth_m,
        ends_seen=(first, last),
        ends_covariance=fitting.ends_covariance,
        ends_open=(ends[0].behind, ends[1].behind),
        flags=tuple(flag for flag, holds in doubts.items() if holds),
    )


@lru_cache(maxsize=8)
def _coverage(view: TubeView, shape: TubeShape) -> tuple[float, float, float]:
    # Intersect the rays of the window with the tube, and compare with the picture. The last value
    # is the overlap of tube and mask where no nearer object hides the tube.
    met = gaps(shape, view.grid_rays, rays=True)
    inside = met.gap_m < 0
    common = int((inside & view.grid_mask).sum())
    nearer = (view.grid_depth_m > 0) & (view.grid_depth_m < met.centres_m[:, 2])
    covered = int((inside & ~view.grid_mask & nearer).sum())
    # If most depth is missing, a ray without a reading may be covered.
    unread = view.is_sparse * int((inside & ~view.grid_mask & (view.grid_depth_m <= 0)).sum())
    either = int((inside | view.grid_mask).sum()) - covered - unread
    return (
        common / max(int(view.grid_mask.sum()), 1),
        covered / max(int(inside.sum()), 1),
        common / max(either, 1),
    )


def _end_on(axis_m: NDArray[np.float64]) -> bool:
    tips, steps = axis_m[[0, -1]], axis_m[[0, -1]] - axis_m[[1, -2]]
    most = np.linalg.norm(tips, axis=1) * np.linalg.norm(steps, axis=1)
    return bool(((steps * tips).sum(axis=1) > np.sin(np.deg2rad(_END_ON_DEG)) * most).any())


METHOD = own_method(
    MethodName.M6, lambda region: measure_m6(region.depth_m, region.mask, region.intrinsics)
)
