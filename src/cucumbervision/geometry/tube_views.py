"""Fit one body to what several cameras saw of it, their poses refined along.

Each camera has its own noise waves and its own slip of the outline, as in `tube_fit`; the body is
shared. A pose is known as well as its standard deviations say, and moves about the body's middle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.geometry.tube import BEND_SEGMENTS, TubeShape
from cucumbervision.geometry.tube_evidence import (
    BODY,
    SHAPE,
    SLIPS,
    Evidence,
    ends_seen,
    normal_equations,
    point_readings,
    ray_readings,
)
from cucumbervision.geometry.tube_fit import (
    SCATTER_POINTS,
    SCATTER_RAYS,
    TubeFitting,
    add_nuisance_prior,
    add_shape_prior,
    end_hold,
    solve_held,
    stepped,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

_SCHEDULE = (4.0, 2.5, 1.6, 1.0, 1.0, 1.0, 1.0, 1.0)
_SETTLED = 3  # from this step on each view's own scatter is used
_TURNS = 6  # unknowns of a pose: a shift and a turn


@dataclass(frozen=True, eq=False)
class SeenFrom:
    """One camera's evidence, and where that camera was.

    Parameters
    ----------
    evidence : Evidence
        In the camera's own coordinates.
    turn : ndarray of float64, shape (3, 3)
        From the coordinates of the first camera to this one's.
    shift_m : ndarray of float64, shape (3,)
        What is added after that.
    shift_sd_m, turn_sd_rad : float
        How well both are known; the first camera's do not matter.
    """

    evidence: Evidence
    turn: NDArray[np.float64]
    shift_m: NDArray[np.float64]
    shift_sd_m: float = 0.03
    turn_sd_rad: float = 0.02


@dataclass(frozen=True, eq=False)
class ViewsFitting:
    """A body fitted to several views.

    Parameters
    ----------
    body : TubeFitting
        In the first camera's coordinates; `points` and `rays` are the first view's, and an end
        counts as seen if any view shows it.
    poses : tuple of ndarray of float64, each of shape (4, 4)
        From the first camera's coordinates to each one's, as refined; the first is the identity.
    """

    body: TubeFitting
    poses: tuple[NDArray[np.float64], ...]


@dataclass
class _Camera:
    """A view while it is fitted: its present pose, and what it has beside the body."""

    view: SeenFrom
    turn: NDArray[np.float64]
    shift_m: NDArray[np.float64]
    nuisance: NDArray[np.float64]
    moved: NDArray[np.float64]

    @classmethod
    def of(cls, view: SeenFrom) -> _Camera:
        nuisance = np.zeros(SLIPS + view.evidence.waves)
        return cls(view, view.turn, view.shift_m, nuisance, np.zeros(_TURNS))

    def body(self, shape: TubeShape) -> TubeShape:
        return TubeShape(shape.bend_m @ self.turn.T + self.shift_m, shape.width_m)

    @property
    def pose(self) -> NDArray[np.float64]:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.turn, self.shift_m
        return pose

    def move(self, by: NDArray[np.float64], middle_m: NDArray[np.float64]) -> None:
        """Shift the body, then turn it about its middle, both in this camera's coordinates."""
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_rotvec(by[3:]).as_matrix()
        self.shift_m = turn @ (self.shift_m - middle_m) + middle_m + by[:3]
        self.turn = turn @ self.turn
        self.moved = self.moved + by


def fit_views(views: Sequence[SeenFrom], guess: TubeShape) -> ViewsFitting:
    """Fit one body to several views.

    Parameters
    ----------
    views : sequence of SeenFrom
        At least one.
    guess : TubeShape
        In the first camera's coordinates; a fit to one of the views serves.

    Returns
    -------
    ViewsFitting
        The body, and where the cameras were.

    Examples
    --------
    >>> from cucumbervision.geometry.tube import shape_from_curve
    >>> x, a = (m.ravel() for m in np.meshgrid(np.linspace(0, 0.2, 60), np.linspace(0.3, 2.8, 9)))
    >>> cloud = np.stack([x, 0.02 * np.cos(a), 0.5 - 0.02 * np.sin(a)], axis=1)
    >>> curve = np.stack([np.linspace(0.02, 0.18, 9), np.zeros(9), np.full(9, 0.505)], axis=1)
    >>> none, still = np.empty((0, 3)), np.eye(3)
    >>> evidence = Evidence(cloud, np.full(540, 1e-3), none, 1e-3, 1e-3, 1.0, 1.0)
    >>> off = replace(evidence, points_m=cloud + [0.0, 0.01, 0.0])
    >>> views = [SeenFrom(evidence, still, np.zeros(3)), SeenFrom(off, still, np.zeros(3))]
    >>> fitted = fit_views(views, shape_from_curve(curve, 0.019))
    >>> centres, radii = fitted.body.shape.balls(5)
    >>> centres[2, 2].round(3).tolist(), radii[2].round(3).tolist()
    (0.5, 0.02)
    >>> (fitted.poses[1][:3, 3].round(3) + 0.0).tolist()
    [0.0, 0.01, 0.0]
    """
    cameras = [_Camera.of(view) for view in views]
    shape, anchors = guess, guess.balls(2)[0]
    for step, scale in enumerate(_SCHEDULE):
        visible = _seen_by_any(cameras, shape)
        hold = end_hold(visible)
        sizes = [len(c.nuisance) + (_TURNS if k else 0) for k, c in enumerate(cameras)]
        starts = SHAPE + np.concatenate([[0], np.cumsum(sizes)])
        normal, target = np.zeros((starts[-1], starts[-1])), np.zeros(starts[-1])
        for k, camera in enumerate(cameras):
            columns = np.concatenate([np.arange(SHAPE), np.arange(starts[k], starts[k + 1])])
            part, pull = _view_equations(camera, shape, scale, step >= _SETTLED, moves=k > 0)
            normal[np.ix_(columns, columns)] += part
            target[columns] += pull
        add_shape_prior(normal, target, shape, anchors, hold)
        shape = _moved(shape, cameras, solve_held(normal, target, SHAPE), starts)
    covariance = np.zeros((BODY, BODY))
    covariance[:SHAPE, :SHAPE] = np.linalg.inv(normal)[:SHAPE, :SHAPE]
    first = cameras[0]
    points = point_readings(first.view.evidence, shape, np.zeros(len(first.nuisance)))
    rays = ray_readings(first.view.evidence, shape, first.nuisance[:SLIPS])
    body = TubeFitting(
        shape,
        covariance,
        points.contacts,
        rays.contacts,
        _seen_by_any(cameras, shape),
        _misfit(cameras, shape),
    )
    return ViewsFitting(body, tuple(camera.pose for camera in cameras))


def _view_equations(
    camera: _Camera, shape: TubeShape, scale: float, settled: bool, *, moves: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    # One camera's equations: of the body in the first camera's coordinates, of what the view has
    # beside it, and of its pose.
    evidence, body = camera.view.evidence, camera.body(shape)
    points = point_readings(evidence, body, camera.nuisance)
    rays = ray_readings(evidence, body, camera.nuisance[:SLIPS])
    scatter = (1.0, 1.0)
    if settled:
        scatter = points.scatter(SCATTER_POINTS), rays.scatter(SCATTER_RAYS)
    middle = body.bend_m.mean(axis=0)
    width = BODY + evidence.waves
    kinds = []
    for read in (points, rays):
        slope = np.zeros((len(read.sd_m), width + (_TURNS if moves else 0)))
        slope[:, : read.slope.shape[1]] = read.slope
        bends = slope[:, : SHAPE - shape.width_m.size].reshape(len(slope), BEND_SEGMENTS + 3, 3)
        slope[:, : SHAPE - shape.width_m.size] = (bends @ camera.turn).reshape(
            len(slope), SHAPE - shape.width_m.size
        )
        if moves:
            arm = read.contacts.centres_m - middle
            slope[:, width:] = np.hstack([read.contacts.away, np.cross(arm, read.contacts.away)])
        kinds.append(replace(read, slope=slope))
    shares = evidence.points_share, evidence.rays_share
    normal, target = normal_equations((kinds[0], kinds[1]), shares, scatter, scale)
    alone, pull = np.zeros((width, width)), np.zeros(width)
    add_nuisance_prior(alone, pull, camera.nuisance, evidence)
    normal[:width, :width] += alone
    target[:width] += pull
    if moves:
        sd = np.repeat([camera.view.shift_sd_m, camera.view.turn_sd_rad], 3)
        last = np.arange(width, width + _TURNS)
        normal[last, last] += 1 / sd**2
        target[last] -= camera.moved / sd**2
    return normal, target


def _moved(
    shape: TubeShape, cameras: list[_Camera], move: NDArray[np.float64], starts: NDArray[np.intp]
) -> TubeShape:
    after, move = stepped(shape, move, SHAPE)
    for k, camera in enumerate(cameras):
        step = move[starts[k] : starts[k + 1]]
        camera.nuisance = camera.nuisance + step[: len(camera.nuisance)]
        if k:
            camera.move(step[len(camera.nuisance) :], camera.body(shape).bend_m.mean(axis=0))
    return after


def _seen_by_any(cameras: list[_Camera], shape: TubeShape) -> tuple[bool, bool]:
    visible = []
    for camera in cameras:
        evidence, body = camera.view.evidence, camera.body(shape)
        rays = ray_readings(evidence, body, camera.nuisance[:SLIPS])
        visible.append(ends_seen(body, rays.contacts, evidence.rays))
    return any(ends[0] for ends in visible), any(ends[1] for ends in visible)


def _misfit(cameras: list[_Camera], shape: TubeShape) -> float:
    total = 0.0
    for camera in cameras:
        evidence, body = camera.view.evidence, camera.body(shape)
        total += point_readings(evidence, body, camera.nuisance).misfit(evidence.points_share)
        rays = ray_readings(evidence, body, camera.nuisance[:SLIPS])
        total += rays.misfit(evidence.rays_share)
    return total
