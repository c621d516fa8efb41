"""Lengths of fruit that lie on a plane, from points marked by hand in a colour picture.

No depth is used. The camera's pose comes from points of known place in the plane. A fruit is round,
rests on the plane and its axis runs level, one radius above it. What is marked of its outline are
rays that touch the body, so an edge is no point at the axis' height, and a rounded end seems to
reach further than it does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from scipy.interpolate import BSpline, splprep

if TYPE_CHECKING:
    from numpy.typing import NDArray

AXIS_SIGMA_CM = 0.05
TIP_SIGMA_CM = 0.005
CAP_SHARE = (
    1.7  # of the radius: how deep a rounded end is; the median of what the pairs near ends give
)
NEAR_TIP_CM = 0.4  # a middle so near to a tip says nothing of the axis


@dataclass(frozen=True, eq=False)
class PlaneCamera:
    """A camera over a plane with centimetres on it.

    Parameters
    ----------
    matrix : array (3, 3), float
        Focal lengths and centre, pixels.
    distortion : array (4,), float
        k1, k2, p1, p2.
    rotation : array (3, 3), float
        From the plane's axes to the camera's; the plane's z points towards the camera.
    centre : array (3,), float
        Where the camera is in the plane's axes, cm.
    error_px : float
        Median distance of the points from where the pose puts them.
    """

    matrix: NDArray[np.float64]
    distortion: NDArray[np.float64]
    rotation: NDArray[np.float64]
    centre: NDArray[np.float64]
    error_px: float

    def rays(self, points_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the unit directions, in the plane's axes, of pixels (N, 2)."""
        flat = cv2.undistortPoints(points_px.reshape(-1, 1, 2), self.matrix, self.distortion)
        rays = np.c_[np.asarray(flat).reshape(-1, 2), np.ones(len(points_px))] @ self.rotation
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class Marks:
    """What was marked of one fruit, pixels.

    Parameters
    ----------
    tips : array (2, 2), float
        Its two ends.
    rounded : tuple of bool
        Whether an end is the limit of a rounded body (a ray that touches it), not a point to see.
    pairs : array (N, 4), float
        Left and right edge across the axis, from the first tip to the second.
    """

    tips: NDArray[np.float64]
    rounded: tuple[bool, bool]
    pairs: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MarkedLengths:
    """The three lengths of a marked fruit, its largest radius, and its axis (N, 3), cm."""

    chord_cm: float
    centreline_cm: float
    thread_cm: float
    radius_cm: float
    axis_cm: NDArray[np.float64]


def camera_over(
    matrix: NDArray[np.float64], distortion: NDArray[np.float64], grid: NDArray[np.float64]
) -> PlaneCamera:
    """Return the camera that sees known points (N, 4: u, v in pixels, x, y in cm) of a plane."""
    pixels, places = grid[:, :2].copy(), np.c_[grid[:, 2:], np.zeros(len(grid))]
    _, turn, shift = cv2.solvePnP(places, pixels, matrix, distortion, flags=cv2.SOLVEPNP_IPPE)
    _, turn, shift = cv2.solvePnP(places, pixels, matrix, distortion, turn, shift, True)
    projected_px = np.asarray(cv2.projectPoints(places, turn, shift, matrix, distortion)[0])
    error = np.linalg.norm(projected_px.reshape(-1, 2) - pixels, axis=1)
    rotation = np.asarray(cv2.Rodrigues(turn)[0], float)
    centre = -rotation.T @ np.asarray(shift, float).ravel()
    if centre[2] < 0:  # x and y were counted so that z points away: turn the axes about x
        flip = np.diag([1.0, -1.0, -1.0])
        rotation, centre = rotation @ flip, flip @ centre
    return PlaneCamera(matrix, distortion, rotation, centre, float(np.median(error)))


def level_hits(
    camera: PlaneCamera, rays: NDArray[np.float64], height_cm: float
) -> NDArray[np.float64]:
    """Return where rays (N, 3) meet the level at a height over the plane, cm."""
    range_cm = (camera.centre[2] - height_cm) / -rays[:, 2]
    return np.asarray(camera.centre + range_cm[:, None] * rays)


def rounded_end_excess(radius_cm: float, angle: float) -> float:
    """Return by how much a rounded end seems too long, seen at an angle to its axis, cm.

    The end is half an ellipsoid about the axis, `CAP_SHARE` of the radius deep. The ray that
    touches it meets the axis beyond the tip.
    """
    depth = CAP_SHARE * radius_cm
    return float(np.hypot(depth, radius_cm / np.tan(angle)) - depth)


def marked_lengths(camera: PlaneCamera, marks: Marks, height_share: float = 1.0) -> MarkedLengths:
    """Return the lengths of a marked fruit.

    `height_share` lowers or raises the axis against the largest radius, to see what that changes.
    """
    left, right = camera.rays(marks.pairs[:, :2]), camera.rays(marks.pairs[:, 2:])
    middles = left + right
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    half_sine = np.sin(np.arccos(np.clip((left * right).sum(1), -1, 1)) / 2)
    resting = camera.centre[2] / (half_sine - middles[:, 2]) * half_sine
    height = 0.0
    for _ in range(20):  # a thinner place hangs at the height that the thickest ones give
        radii = (
            np.maximum((camera.centre[2] - height) / -middles[:, 2] * half_sine, 0.0)
            if height
            else resting
        )
        height = height_share * float(np.sort(radii)[-2:].mean())
    axis = level_hits(camera, middles, height)
    tips_px = marks.tips.copy()
    middles_px = (marks.pairs[:, :2] + marks.pairs[:, 2:]) / 2
    inner_ends = ((0, 1), (-1, -2))
    for end, (near, inner) in enumerate(inner_ends):
        if marks.rounded[end]:  # its furthest point in the picture: onto the axis' image
            along = middles_px[near] - middles_px[inner]
            along /= np.linalg.norm(along)
            tips_px[end] = middles_px[near] + along * ((tips_px[end] - middles_px[near]) @ along)
    tips = level_hits(camera, camera.rays(tips_px), height)
    for end, (near, inner) in enumerate(inner_ends):
        if marks.rounded[end]:
            outwards = axis[near] - axis[inner]
            outwards /= np.linalg.norm(outwards)
            ray = tips[end] - camera.centre
            angle = float(np.arccos(abs(outwards @ ray) / np.linalg.norm(ray)))
            tips[end] -= outwards * rounded_end_excess(radii[inner], angle)
    clear = np.linalg.norm(axis[:, None] - tips[None], axis=2).min(1) > NEAR_TIP_CM
    points = np.vstack([tips[:1], axis[clear], tips[1:]])
    thick = np.r_[radii[0], radii[clear], radii[-1]]
    weights = np.full(len(points), 1 / AXIS_SIGMA_CM)
    weights[[0, -1]] = 1 / TIP_SIGMA_CM
    (knots, shape, _), at = splprep(points[:, :2].T, w=weights, s=len(points), k=3)
    spline = BSpline(np.asarray(knots), np.asarray(shape).T, 3)
    steps = np.linspace(0, 1, 801)
    path, first, second = (np.asarray(spline(steps, nu=order)).T for order in (0, 1, 2))
    speed = np.hypot(*first)
    turning = (first[0] * second[1] - first[1] * second[0]) / speed**2
    centreline = float(np.trapezoid(speed, steps))
    outer = abs(float(np.trapezoid(turning * np.interp(steps, at, thick), steps)))
    return MarkedLengths(
        chord_cm=float(np.linalg.norm(tips[1] - tips[0])),
        centreline_cm=centreline,
        thread_cm=centreline + outer,
        radius_cm=float(np.sort(radii)[-2:].mean()),
        axis_cm=np.c_[path.T, np.full(len(steps), height)],
    )
