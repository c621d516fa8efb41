"""Fit a union of balls along a smooth curve to depth points and outline rays together.

Each reading is compared with the body's own geometry: a depth point should lie on the union of
balls, min over s of |P - C(s)| - r(s) = 0, and a ray through the outline should just touch it,
min over s of dist(ray, C(s)) - r(s) = 0, which is exact in perspective, at any tilt, round the
ends as well as along the sides. Both minima are taken at the nearest ball, where the derivative
by s vanishes, so Gauss-Newton needs only that ball's centre and radius.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.geometry.bspline import differences
from cucumbervision.geometry.tube_shape import (
    BALLS,
    BEND_SEGMENTS,
    Gaps,
    TubeShape,
    bases,
    gaps,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["Evidence", "TubeFitting", "fit_shape"]

# How much larger than its own each reading's error is taken to be, step by step.
SCHEDULE = (16.0, 10.0, 6.0, 4.0, 2.5, 1.6, 1.0, 1.0, 1.0)
SETTLED = 6  # from this step on the outline's and the depth's own scatter is used
TUKEY, CAUCHY = 4.685, 2.385  # tuning constants for 95 % efficiency (Huber 1981; Holland 1977)
# What is believed of fruit before looking, in shares of the length L and the radius r.
TWIST_SD = 1.0  # the curvature's change k' over the length: k' L^2
SPEED_SD = 0.02  # a control point's distance to the next, from one to the next
WIDTH_SD = 0.05  # the radius' second difference; with heavy tails, so that shoulders may stand
WIDTH_TAIL = 2.0
# How far, in radii, an end may be from where it was guessed: one that the outline shows (where
# this must not matter), and one that a leaf or the picture's edge hides.
ANCHOR_SD, HIDDEN_ANCHOR_SD = 1.5, 0.15
TIP_COSINE, TIP_RAYS = 0.8, 3
GROUND_M = 0.0003  # what even a perfect reading may differ from a smooth body: warts, ribs
ACROSS = 0.3  # a depth reading's position across, in units of the outline's error
SCATTER_RAYS, SCATTER_POINTS = (0.5, 2.0), (0.7, 3.0)


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
    points_share, rays_share : float
        How many independent readings one of them counts for, at most 1: neighbouring pixels
        err together.
    """

    points_m: NDArray[np.float64]
    points_sd_m: NDArray[np.float64]
    rays: NDArray[np.float64]
    rays_sd_rad: float
    points_share: float
    rays_share: float


@dataclass(frozen=True, eq=False)
class TubeFitting:
    """A fitted shape, and what remains.

    Parameters
    ----------
    shape : TubeShape
        The body.
    covariance : ndarray of float64, shape (36, 36)
        Of the shape's control points row by row, then of its control radii; square metres.
    points, rays : Gaps
        What remains at the depth points and at the outline's rays.
    points_scatter, rays_scatter : float
        Their scatter in units of the errors that the evidence states.
    ends_seen : tuple of bool
        Whether the outline goes round the curve's first and last end.
    """

    shape: TubeShape
    covariance: NDArray[np.float64]
    points: Gaps
    rays: Gaps
    points_scatter: float
    rays_scatter: float
    ends_seen: tuple[bool, bool]

    @property
    def centreline_sd_m(self) -> float:
        """Standard deviation of the axis' length from pole to pole, metres."""
        bend, width = bases(BALLS)
        centres = bend @ self.shape.bend_m
        steps = np.diff(centres, axis=0)
        steps /= np.maximum(np.linalg.norm(steps, axis=1), 1e-12)[:, None]
        by_bend = np.diff(bend, axis=0).T @ steps
        slope = np.concatenate([by_bend.ravel(), width[0] + width[-1]])
        return float(np.sqrt(slope @ self.covariance @ slope))


def fit_shape(evidence: Evidence, guess: TubeShape) -> TubeFitting:
    """Fit the shape by robust Gauss-Newton steps, from coarse to fine.

    Depth points are weighted by Tukey's biweight (flying pixels must have no say), outline rays
    by Cauchy's weight (a stalk or a shoulder must keep some). Towards the end both kinds are
    rescaled by their own scatter, so that a rough outline trusts depth more, and the reverse.

    Parameters
    ----------
    evidence : Evidence
        What was seen.
    guess : TubeShape
        Where to start; its ends rather short of the fruit's than beyond.

    Returns
    -------
    TubeFitting
        The shape with its covariance, and what remains.

    Examples
    --------
    A straight body seen from the side: surface points of its front, and no outline.

    >>> from cucumbervision.geometry.tube_shape import shape_from_curve
    >>> x, a = (m.ravel() for m in np.meshgrid(np.linspace(0, 0.2, 60), np.linspace(0.3, 2.8, 9)))
    >>> cloud = np.stack([x, 0.02 * np.cos(a), 0.5 - 0.02 * np.sin(a)], axis=1)
    >>> curve = np.stack([np.linspace(0.02, 0.18, 9), np.zeros(9), np.full(9, 0.505)], axis=1)
    >>> evidence = Evidence(cloud, np.full(540, 1e-3), np.empty((0, 3)), 1e-3, 1.0, 1.0)
    >>> centres, radii = fit_shape(evidence, shape_from_curve(curve, 0.015)).shape.balls(5)
    >>> centres[2, 2].round(3).tolist(), radii[2].round(3).tolist()
    (0.5, 0.02)
    """
    shape, scatter, ends_seen = guess, (1.0, 1.0), (True, True)
    anchors = guess.balls(2)[0]
    directions = evidence.points_m / np.linalg.norm(evidence.points_m, axis=1)[:, None]
    for step, scale in enumerate(SCHEDULE):
        seen = _look(evidence, shape, directions)
        if step >= SETTLED:
            scatter = _scatter(seen[0], SCATTER_POINTS), _scatter(seen[1], SCATTER_RAYS)
            ends_seen = _ends_seen(shape, seen[1][0], evidence.rays)
        hold_m = [ANCHOR_SD if end else HIDDEN_ANCHOR_SD for end in ends_seen]
        normal, target = _normal(evidence, shape, (anchors, np.array(hold_m)), seen, scatter, scale)
        shape = _moved(shape, np.linalg.solve(normal, target))
    points, rays = _look(evidence, shape, directions)
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    return TubeFitting(shape, covariance, points[0], rays[0], *scatter, ends_seen)


_Seen = tuple[Gaps, "NDArray[np.float64]"]
_Anchors = tuple["NDArray[np.float64]", "NDArray[np.float64]"]  # where, and sd in radii


def _ends_seen(shape: TubeShape, found: Gaps, rays: NDArray[np.float64]) -> tuple[bool, bool]:
    # Round an end the outline touches the last ball on its far side, as seen from the body.
    seen = []
    centres, _ = shape.balls()
    for share, tip, inner in ((0.0, 0, 1), (1.0, -1, -2)):
        at_end = np.abs(found.share - share) < 0.5 / BALLS
        tangent = centres[tip] - centres[inner]
        ray = rays[at_end]
        ahead = tangent - (ray @ tangent)[:, None] * ray
        ahead /= np.maximum(np.linalg.norm(ahead, axis=1), 1e-12)[:, None]
        touching = -np.einsum("ij,ij->i", ahead, found.away[at_end]) > TIP_COSINE
        seen.append(int(np.count_nonzero(touching)) >= TIP_RAYS)
    return seen[0], seen[1]


def _look(
    evidence: Evidence, shape: TubeShape, directions: NDArray[np.float64]
) -> tuple[_Seen, _Seen]:
    points = gaps(shape, evidence.points_m, rays=False)
    # Depth errs along the ray, and only the part across the surface changes the gap.
    facing = np.einsum("ij,ij->i", directions, points.away)
    across = ACROSS * evidence.rays_sd_rad * evidence.points_m[:, 2]
    points_sd = np.sqrt((evidence.points_sd_m * facing) ** 2 + across**2 + GROUND_M**2)
    rays = gaps(shape, evidence.rays, rays=True)
    far = np.sqrt(np.einsum("ij,ij->i", rays.centres_m, rays.centres_m))
    rays_sd = np.hypot(evidence.rays_sd_rad * far, GROUND_M)
    return (points, points_sd), (rays, rays_sd)


def _scatter(seen: _Seen, limits: tuple[float, float]) -> float:
    found, sd = seen
    if not len(sd):
        return 1.0
    spread = 1.4826 * float(np.median(np.abs(found.gap_m / sd)))
    return min(max(spread, limits[0]), limits[1])


def _normal(
    evidence: Evidence,
    shape: TubeShape,
    anchors: _Anchors,
    seen: tuple[_Seen, _Seen],
    scatter: tuple[float, float],
    scale: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    normal, target = _prior(shape, anchors)
    # A rough outline is rough over longer runs: it counts for fewer independent readings.
    shares = evidence.points_share, evidence.rays_share / max(1.0, scatter[1])
    trusts, split = (_tukey, _cauchy), shape.bend_m.size
    for (found, sd), by, share, trust in zip(seen, scatter, shares, trusts, strict=True):
        error = sd * by * scale
        weight = share * trust(found.gap_m / error) / error**2
        slope = np.concatenate(
            [
                (found.bend_basis[:, :, None] * found.away[:, None, :]).reshape(len(sd), split),
                -found.width_basis,
            ],
            axis=1,
        )
        weighted = slope * weight[:, None]
        normal += weighted.T @ slope
        target -= weighted.T @ found.gap_m
    normal[np.diag_indices(len(normal))] += 1e-9 * np.trace(normal) / len(normal)
    return normal, target


def _moved(shape: TubeShape, move: NDArray[Any]) -> TubeShape:
    # A step beyond the body's own width would leave the readings that led it.
    limit = 0.6 * float(np.abs(shape.width_m).max()) + 0.002
    move = move * min(1.0, limit / max(float(np.abs(move).max()), 1e-12))
    return replace(
        shape,
        bend_m=shape.bend_m + move[: shape.bend_m.size].reshape(-1, 3),
        width_m=shape.width_m + move[shape.bend_m.size :],
    )


@lru_cache(maxsize=4)
def _differences(count: int, order: int) -> NDArray[np.float64]:
    return differences(count, order)


def _prior(shape: TubeShape, anchors: _Anchors) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    bend, width = shape.bend_m, shape.width_m
    count, split = len(bend), bend.size
    steps = bend[1:] - bend[:-1]
    step = float(np.sqrt(np.einsum("ij,ij->i", steps, steps)).mean())
    radius = max(float(np.median(width)), 0.002)
    third = _differences(count, 3) * (BEND_SEGMENTS**2 / (TWIST_SD * step))
    hold = shape.ends_basis / (anchors[1] * radius)[:, None]
    same = third.T @ third + hold.T @ hold  # for each coordinate alike
    # Control points keep their distances: nothing else tells where along the curve they sit.
    second = _differences(count, 2)
    tangent = bend[2:] - bend[:-2]
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1), 1e-9)[:, None]
    even = (second[:, :, None] * tangent[:, None, :]).reshape(count - 2, -1) / (SPEED_SD * step)
    normal, target = np.zeros((split + len(width),) * 2), np.zeros(split + len(width))
    normal[:split, :split] = even.T @ even
    for axis in range(3):
        normal[axis:split:3, axis:split:3] += same
    pull = same @ bend - hold.T @ (anchors[0] / (anchors[1] * radius)[:, None])
    target[:split] = -pull.ravel() - even.T @ (even @ bend.ravel())
    rough = _differences(len(width), 2) / (WIDTH_SD * radius)
    rough = rough / np.sqrt(1 + (rough @ width / WIDTH_TAIL) ** 2)[:, None]
    normal[split:, split:] = rough.T @ rough
    target[split:] = -rough.T @ (rough @ width)
    return normal, target


def _tukey(u: NDArray[np.float64]) -> NDArray[np.float64]:
    inside = np.maximum(1 - (u / TUKEY) ** 2, 0.0)
    return inside * inside


def _cauchy(u: NDArray[np.float64]) -> NDArray[np.float64]:
    return 1 / (1 + (u / CAUCHY) ** 2)
