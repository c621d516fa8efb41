"""Observations of one fruit, and their equations for a body: residuals, errors, derivatives.

The unknowns, in this order: the body's control points row by row, its control radii, the slips
of the outline, the waves of depth noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.geometry.pixels import median_of
from cucumbervision.geometry.tube import BALLS, BEND_SEGMENTS, WIDTH_SEGMENTS, TubeShape
from cucumbervision.geometry.tube_gaps import Gaps, depth_gaps, gaps

if TYPE_CHECKING:
    from numpy.typing import NDArray

SLIPS = 3  # of the whole outline: along x and y, and outward
_BENDS = 3 * (BEND_SEGMENTS + 3)
SHAPE = _BENDS + WIDTH_SEGMENTS + 3
BODY = SHAPE + SLIPS  # unknowns of body and outline
_TUKEY, _CAUCHY = 4.685, 2.385  # tuning constants for 95 % efficiency (Huber 1981; Holland 1977)
_TIP_COSINE, _TIP_RAYS, _LEAST_FORESHORTENED = 0.7, 2, 0.5
_OVERHANG_ERRORS = 3.0  # less than this many standard errors beyond an end is taken for none
_GROUND_M = 0.0003  # what even a perfect reading may differ from a smooth body: warts, ribs
_ACROSS = 0.3  # a depth reading's position across, in units of the outline's error
_MISFIT_SD = 5.0


@dataclass(frozen=True, eq=False)
class Evidence:
    """What was seen of one fruit.

    Parameters
    ----------
    points_m : ndarray of float64, shape (N, 3)
        Depth points in camera coordinates, metres.
    points_sd_m : ndarray of float64, shape (N,)
        Standard deviation of their depth, metres.
    rays : ndarray of float64, shape (M, 3)
        Unit directions through the outline.
    rays_sd_rad : float
        Their standard deviation across, radians.
    pixel_rad : float
        What a pixel spans, radians.
    points_share, rays_share : float
        How many independent readings one of them counts for, at most 1: neighbouring pixels
        err together.
    waves_m : ndarray of float64, shape (N, W), optional
        What waves of depth noise, longer than `points_share` allows for, do to each point's
        depth, metres along its ray: W unknowns of standard deviation 1 that are fitted along.
    """

    points_m: NDArray[np.float64]
    points_sd_m: NDArray[np.float64]
    rays: NDArray[np.float64]
    rays_sd_rad: float
    pixel_rad: float
    points_share: float
    rays_share: float
    waves_m: NDArray[np.float64] | None = None

    @property
    def waves(self) -> int:
        """How many waves of depth noise are fitted along."""
        return 0 if self.waves_m is None else self.waves_m.shape[1]

    @cached_property
    def directions(self) -> NDArray[np.float64]:
        """Unit directions to the depth points, shape (N, 3)."""
        return np.asarray(self.points_m / self.points_far_m[:, None], dtype=np.float64)

    @cached_property
    def points_far_m(self) -> NDArray[np.float64]:
        """Distances of the depth points from the camera, shape (N,), metres."""
        return np.asarray(np.linalg.norm(self.points_m, axis=1), dtype=np.float64)

    @cached_property
    def far_m(self) -> float:
        """Median distance of the depth points, metres."""
        return float(np.median(self.points_far_m))


@dataclass(frozen=True, eq=False)
class Readings:
    """One kind of readings against a body.

    Parameters
    ----------
    contacts : Gaps
        Their gaps, metres.
    sd_m : ndarray of float64, shape (N,)
        The gaps' standard deviations, metres.
    slope : ndarray of float64, shape (N, K)
        The gaps' derivatives by the first K unknowns: `BODY` of them for the outline, and the
        waves too for depth points.
    """

    contacts: Gaps
    sd_m: NDArray[np.float64]
    slope: NDArray[np.float64]

    def misfit(self, share: float) -> float:
        """Return the sum of squared gaps in their own errors, each up to `_MISFIT_SD`."""
        return share * float(
            (np.minimum(np.abs(self.contacts.gap_m / self.sd_m), _MISFIT_SD) ** 2).sum()
        )

    def scatter(self, limits: tuple[float, float]) -> float:
        """Return how many times their own errors the gaps scatter, robustly, within limits."""
        if not len(self.sd_m):
            return 1.0
        spread = 1.4826 * median_of(np.abs(self.contacts.gap_m / self.sd_m))
        return min(max(spread, limits[0]), limits[1])


def point_readings(evidence: Evidence, shape: TubeShape, nuisance: NDArray[np.float64]) -> Readings:
    """Return the depth points against a body.

    Depth errs along its ray, so the gap is the one along the ray, times how squarely that meets
    the surface. A gap across the surface, taken at the erring point, favours small radii.

    Parameters
    ----------
    evidence : Evidence
        What was seen.
    shape : TubeShape
        The body, camera coordinates.
    nuisance : ndarray of float64, shape (SLIPS + W,)
        The outline's slips, which do not matter here, and the strength of each wave.
    """
    contacts, facing = depth_gaps(shape, evidence.directions, evidence.points_far_m)
    across = _ACROSS * evidence.rays_sd_rad * evidence.points_m[:, 2]
    sd = np.sqrt((evidence.points_sd_m * facing) ** 2 + across**2 + _GROUND_M**2)
    slope = _slope(contacts, evidence.waves)
    slope[:, SHAPE:BODY] = 0.0
    if evidence.waves_m is None:
        return Readings(contacts, sd, slope)
    waves = np.multiply(evidence.waves_m, facing[:, None], out=slope[:, BODY:])
    return Readings(replace(contacts, gap_m=contacts.gap_m + waves @ nuisance[SLIPS:]), sd, slope)


def ray_readings(evidence: Evidence, shape: TubeShape, slip_m: NDArray[np.float64]) -> Readings:
    """Return the outline's rays against a body.

    Parameters
    ----------
    evidence : Evidence
        What was seen.
    shape : TubeShape
        The body, camera coordinates.
    slip_m : ndarray of float64, shape (SLIPS,)
        How far the whole outline lies beside the depth picture's in x and y, and how much too
        wide it is; metres at the fruit's distance.
    """
    contacts = gaps(shape, evidence.rays, rays=True)
    distance = np.sqrt(np.einsum("ij,ij->i", contacts.centres_m, contacts.centres_m))
    sd = np.hypot(evidence.rays_sd_rad * distance, _GROUND_M)
    slope = _slope(contacts, 0)
    by_far = distance / evidence.far_m
    slope[:, SHAPE : BODY - 1] = by_far[:, None] * contacts.away[:, :2]
    slope[:, BODY - 1] = -by_far
    slipped = replace(contacts, gap_m=contacts.gap_m + slope[:, SHAPE:] @ slip_m)
    return Readings(slipped, sd, slope)


def _slope(contacts: Gaps, waves: int) -> NDArray[np.float64]:
    # By the body; the rest is left to be filled in.
    slope = np.empty((len(contacts.gap_m), BODY + waves))
    for axis in range(3):
        away = contacts.away[:, axis : axis + 1]
        np.multiply(contacts.bend_basis, away, out=slope[:, axis:_BENDS:3])
    np.negative(contacts.width_basis, out=slope[:, _BENDS:SHAPE])
    return slope


def normal_equations(
    readings: tuple[Readings, Readings],
    shares: tuple[float, float],
    scatter: tuple[float, float],
    scale: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the robustly weighted normal equations of depth points and outline.

    Depth points are weighted by Tukey's biweight (Beaton and Tukey 1974), rays by Cauchy's weight
    (Holland and Welsch 1977).

    Parameters
    ----------
    readings : tuple of Readings
        Of the points, with K unknowns, and of the rays, with the first of these.
    shares : tuple of float
        How many independent readings one of either counts for.
    scatter : tuple of float
        How many times their own errors either kind scatters.
    scale : float
        How much larger than that an error may be before it counts as an outlier's.

    Returns
    -------
    normal : ndarray of float64, shape (K, K)
        1/m².
    target : ndarray of float64, shape (K,)
        1/m: `normal` times the step to take.
    """
    size = readings[0].slope.shape[1]  # the outline knows of no depth noise: it has fewer
    normal, target = np.zeros((size, size)), np.zeros(size)
    # A rough outline is rough over longer runs: it counts for fewer independent readings.
    shares = shares[0], shares[1] / max(1.0, scatter[1]) ** 2
    for kind, by, share, trust in zip(readings, scatter, shares, (_tukey, _cauchy), strict=True):
        error = kind.sd_m * by * scale
        gap = kind.contacts.gap_m / error
        root = np.sqrt(share * trust(gap))
        weighted = kind.slope * (root / error)[:, None]
        columns = slice(0, kind.slope.shape[1])
        normal[columns, columns] += weighted.T @ weighted
        target[columns] -= (root * gap) @ weighted
    return normal, target


def _tukey(u: NDArray[np.float64]) -> NDArray[np.float64]:
    inside = np.maximum(1 - (u / _TUKEY) ** 2, 0.0)
    return inside * inside


def _cauchy(u: NDArray[np.float64]) -> NDArray[np.float64]:
    return 1 / (1 + (u / _CAUCHY) ** 2)


def ends_seen(shape: TubeShape, contacts: Gaps, rays: NDArray[np.float64]) -> tuple[bool, bool]:
    """Return whether the outline goes round a body's first and last end.

    There it touches the last ball on its far side, as seen from the body.

    Parameters
    ----------
    shape : TubeShape
        The body, camera coordinates.
    contacts : Gaps
        Of the outline's rays.
    rays : ndarray of float64, shape (M, 3)
        Unit directions through the outline.
    """
    first, last = (len(overhangs) >= _TIP_RAYS for overhangs in _beyond_ends(shape, contacts, rays))
    return first, last


def end_overhangs(
    shape: TubeShape, contacts: Gaps, rays: NDArray[np.float64]
) -> tuple[float, float]:
    """Return how far the outline goes beyond a body's first and last end, metres.

    A pointed end is one that balls do not enter. At most the body's median radius, and 0 where
    the outline does not go round the end or is not significantly beyond it. Parameters as those
    of `ends_seen`.
    """
    limit = median_of(shape.width_m)
    first, last = (
        min(_overhang(overhangs), limit) for overhangs in _beyond_ends(shape, contacts, rays)
    )
    return first, last


def _overhang(beyond_m: NDArray[np.float64]) -> float:
    if len(beyond_m) <= _TIP_RAYS:
        return 0.0
    median = median_of(beyond_m)
    scatter = 1.4826 * median_of(np.abs(beyond_m - median))
    error = 1.2533 * scatter / np.sqrt(len(beyond_m))  # of a median of normal errors
    return median if median > _OVERHANG_ERRORS * error else 0.0


def _beyond_ends(
    shape: TubeShape, contacts: Gaps, rays: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    # Of the rays that touch each end's ball on its far side: how far along the axis they lie.
    overhangs = []
    centres, _ = shape.balls()
    for share, tip, inner in ((0.0, 0, 1), (1.0, -1, -2)):
        at_end = np.abs(contacts.share - share) < 0.5 / BALLS
        tangent = centres[tip] - centres[inner]
        ray = rays[at_end]
        ahead = tangent - (ray @ tangent)[:, None] * ray
        norm = np.maximum(np.linalg.norm(ahead, axis=1), 1e-12)
        cosine = -np.einsum("ij,ij->i", ahead, contacts.away[at_end]) / norm
        foreshortened = np.maximum(norm / np.linalg.norm(tangent), _LEAST_FORESHORTENED)
        overhang = contacts.gap_m[at_end] * cosine / foreshortened
        overhangs.append(overhang[cosine > _TIP_COSINE])
    return overhangs
