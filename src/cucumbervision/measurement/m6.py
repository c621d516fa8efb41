"""M6, the swept tube: our own method."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.geometry.tube_fit import Evidence, TubeFitting, fit_shape
from cucumbervision.geometry.tube_guess import guess_shape, near_depths
from cucumbervision.geometry.tube_shape import TubeShape, gaps
from cucumbervision.measurement.results import LengthKind, Measurement, Method, Reason
from cucumbervision.measurement.traits import tube_traits
from cucumbervision.measurement.tube_types import TubeFit, TubeTraits
from cucumbervision.measurement.tube_view import TubeView, view_tube

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.capture.intrinsics import Intrinsics

__all__ = ["measure_m6"]

MIN_POINTS = 30
MIN_RAYS = 20
BALLS = 128
RANGE_M = (0.02, 1.0)
OUTLINE_SD_PX = 0.7
MIN_EXPLAINED = 0.5  # share of the mask that a tube must cover to be the fruit's
GOOD_EXPLAINED, GOOD_OUTLINE = 0.9, 0.1
ON_SURFACE_SD, ON_SURFACE_M, GOOD_ON_SURFACE = 4.0, 0.002, 0.8
MAY_BE_FRUIT, CLEARLY_BETTER = 0.01, 0.03  # shares of the points, and of the silhouette
END_ON_DEG = 70.0
BEYOND, BEYOND_PX = 1.2, 8.0  # how far beyond an end to look for what covers it: radii, pixels
PART_HIDDEN, UNCERTAIN = 0.1, 0.05


def measure_m6(
    depth_m: NDArray[np.float32], mask: NDArray[np.bool_], intrinsics: Intrinsics
) -> Measurement:
    """Fit a swept tube to a fruit's depth and outline.

    A smooth curve with a radius along it and round ends, fitted to the mask's depth points and
    to the rays through its outline at once (`geometry.tube_fit`), each weighted by its own
    error: depth by the sensor's noise at that distance. Outline that borders something nearer
    is left out, so a stretch behind a leaf is bridged; there is no depth gate.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour.
    mask : ndarray of bool, shape (H, W)
        The fruit's pixels.
    intrinsics : Intrinsics
        The colour stream's.

    Returns
    -------
    Measurement
        `length_m` is the centreline (kind 'centreline'); `tube` has all three lengths and `fit`
        everything else. Reason 'too-few-points' (of depth), 'outline-too-short' (hardly any of
        the outline is the fruit's own), 'not-a-tube', 'out-of-range'.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> from cucumbervision.synthesis.render import render
    >>> from cucumbervision.synthesis.tube import arc_tube, rotation
    >>> camera = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    >>> fruit = arc_tube(0.20, 0.02, 0.30).moved(rotation(tilt_deg=40), (0, 0, 0.5))
    >>> scene = render([fruit], camera)
    >>> result = measure_m6(scene.depth_m.astype(np.float32), scene.mask(0), camera)
    >>> round(result.tube.centreline_m, 3), round(result.tube.thread_m / fruit.thread_m, 2)
    (0.2, 1.0)
    """
    view = view_tube(depth_m, mask, intrinsics)
    if view is None or len(view.points_m) < MIN_POINTS:
        return Measurement(Method.M6, reason=Reason.TOO_FEW_POINTS)
    if len(view.rays) < MIN_RAYS:
        return Measurement(Method.M6, reason=Reason.OUTLINE_TOO_SHORT)
    evidence = Evidence(
        view.points_m,
        view.points_sd_m,
        view.rays,
        OUTLINE_SD_PX / intrinsics.fx_px,
        1 / intrinsics.fx_px,
        view.points_share,
        view.rays_share,
    )
    try:
        fitting = _best_fit(view, evidence)
    except np.linalg.LinAlgError:
        return Measurement(Method.M6, reason=Reason.NOT_A_TUBE)
    return _judged(view, fitting)


def _best_fit(view: TubeView, evidence: Evidence) -> TubeFitting:
    surface = view.surface_m
    fitting = fit_shape(evidence, guess_shape(surface))
    left_out = 1.0 - float(near_depths(surface).mean())
    if left_out < MAY_BE_FRUIT:
        return fitting
    # What lies off the plane is background, or the far part of a hook: only a mask that is
    # clearly better covered speaks for the latter.
    other = fit_shape(evidence, guess_shape(surface, gated=False))
    gain = _coverage(view, other.shape)[2] - _coverage(view, fitting.shape)[2]
    return other if gain > CLEARLY_BETTER else fitting


def _judged(view: TubeView, fitting: TubeFitting) -> Measurement:
    shape = fitting.shape
    if not (np.isfinite(shape.bend_m).all() and np.isfinite(shape.width_m).all()):
        return Measurement(Method.M6, reason=Reason.NOT_A_TUBE)
    traits = tube_traits(*shape.balls(BALLS))
    length = traits.lengths.centreline_m
    if not RANGE_M[0] <= length <= RANGE_M[1]:
        return Measurement(Method.M6, reason=Reason.OUT_OF_RANGE)
    fit = _fit(view, fitting, traits)
    if fit.explained < MIN_EXPLAINED:
        return Measurement(Method.M6, reason=Reason.NOT_A_TUBE)
    return Measurement(
        Method.M6,
        length,
        LengthKind.CENTRELINE,
        path_m=traits.axis_m,
        tube=traits.lengths,
        fit=fit,
    )


def _fit(view: TubeView, fitting: TubeFitting, traits: TubeTraits) -> TubeFit:
    explained, hidden, _ = _coverage(view, fitting.shape)
    rays = fitting.rays
    far = np.linalg.norm(rays.centres_m, axis=1)
    outline_px = 1.4826 * float(np.median(np.abs(rays.gap_m) / far)) * view.focal_px
    depth_m = 1.4826 * float(np.median(np.abs(fitting.points.gap_m)))
    covered = _covered_ends(view, fitting.shape)
    first, last = (s and not c for s, c in zip(fitting.ends_seen, covered, strict=True))
    flags = []
    if not (first and last):
        flags.append("end-hidden")
    if _end_on(traits.axis_m):
        flags.append("end-on")
    if hidden > PART_HIDDEN:
        flags.append("part-hidden")
    rough = outline_px * float(np.median(far)) / view.focal_px / traits.diameter_max_m
    on_it = _on_surface(view, fitting)
    if explained < GOOD_EXPLAINED or rough > GOOD_OUTLINE or on_it < GOOD_ON_SURFACE:
        flags.append("poor-fit")
    sd = fitting.centreline_sd_m
    if sd > UNCERTAIN * traits.lengths.centreline_m:
        flags.append("uncertain")
    return TubeFit(
        traits,
        sd,
        sd * traits.lengths.thread_m / traits.lengths.centreline_m,
        hidden,
        explained,
        view.fill,
        outline_px,
        depth_m,
        (first, last),
        tuple(flags),
    )


def _coverage(view: TubeView, shape: TubeShape) -> tuple[float, float, float]:
    # The window's own rays: which of them meet the tube, and what the picture shows there. The
    # last figure is the overlap of tube and mask where nothing nearer hides the tube.
    met = gaps(shape, view.grid_rays, rays=True)
    inside = met.gap_m < 0
    own = view.grid_mask
    both = int((inside & own).sum())
    nearer = (view.grid_depth_m > 0) & (view.grid_depth_m < met.centres_m[:, 2])
    covered = int((inside & ~own & nearer).sum())
    either = int((inside | own).sum()) - covered
    return both / max(int(own.sum()), 1), covered / max(int(inside.sum()), 1), both / max(either, 1)


def _covered_ends(view: TubeView, shape: TubeShape) -> tuple[bool, bool]:
    # Whether what lies beyond an end in the picture is nearer than the end: then it covers it.
    centres, radii = shape.balls()
    beside = view.grid_rays[~view.grid_mask & (view.grid_depth_m > 0)]
    depth = view.grid_depth_m[~view.grid_mask & (view.grid_depth_m > 0)]
    covered = []
    for tip, inner in ((0, 1), (-1, -2)):
        far = float(np.linalg.norm(centres[tip]))
        ray = centres[tip] / far
        ahead = centres[tip] - centres[inner]
        ahead -= (ahead @ ray) * ray
        ahead /= max(float(np.linalg.norm(ahead)), 1e-12)
        off = beside * far - centres[tip]
        reach = BEYOND * max(float(radii[tip]), 0.0) + BEYOND_PX * far / view.focal_px
        beyond = (off @ ahead > 0) & (np.linalg.norm(off, axis=1) < reach)
        z = depth[beyond]
        covered.append(len(z) > 1 and float(np.median(z)) < centres[tip, 2])
    return covered[0], covered[1]


def _on_surface(view: TubeView, fitting: TubeFitting) -> float:
    # Share of the depth points that lie on the tube, within what the sensor may err.
    within = np.abs(fitting.points.gap_m) <= ON_SURFACE_SD * view.points_sd_m + ON_SURFACE_M
    return float(within.mean())


def _end_on(axis_m: NDArray[np.float64]) -> bool:
    for tip, inner in ((0, 1), (-1, -2)):
        step = axis_m[tip] - axis_m[inner]
        view = axis_m[tip] / np.linalg.norm(axis_m[tip])
        if float(step @ view) > np.sin(np.deg2rad(END_ON_DEG)) * float(np.linalg.norm(step)):
            return True
    return False
