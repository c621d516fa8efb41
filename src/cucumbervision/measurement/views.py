"""One fruit seen from several places: one tube fitted to all views at once."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.geometry.tube_views import SeenFrom, fit_views
from cucumbervision.measurement.m6 import fit_view, judged_fit, view_tube
from cucumbervision.measurement.result import Measurement, Method, Reason

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from cucumbervision.capture.intrinsics import Intrinsics
    from cucumbervision.geometry.tube_fit import TubeFitting
    from cucumbervision.measurement.m6 import TubeView

_SAME_PLACE = 0.10  # of the distance: cameras nearer to each other share their errors
_ALIGNED_SD_M = 0.015  # of a shift, once the middles of two whole views were laid together


@dataclass(frozen=True, eq=False)
class FruitView:
    """One fruit in one capture.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour.
    mask : ndarray of bool, shape (H, W)
        The fruit's pixels.
    intrinsics : Intrinsics
        The colour stream's.
    pose : ndarray of float64, shape (4, 4)
        From camera coordinates to those that all views share.
    shift_sd_m, turn_sd_rad : float
        How well that is known.
    """

    depth_m: NDArray[np.float32]
    mask: NDArray[np.bool_]
    intrinsics: Intrinsics
    pose: NDArray[np.float64]
    shift_sd_m: float = 0.03
    turn_sd_rad: float = 0.02


@dataclass(frozen=True, eq=False)
class JointMeasurement:
    """What several views of one fruit say together.

    Parameters
    ----------
    measurement : Measurement
        As `measure_m6`, in the camera coordinates of the view `first`.
    first : int
        Number of the view that shows the fruit best, from 0.
    poses : mapping of int to ndarray of float64, shape (4, 4)
        From that camera's coordinates to those of each view that was used, as refined; without
        entries where nothing was measured.
    """

    measurement: Measurement
    first: int = 0
    poses: Mapping[int, NDArray[np.float64]] = field(default_factory=dict)


def measure_views(views: Sequence[FruitView]) -> JointMeasurement:
    """Fit one swept tube to a fruit's depth and outlines in all views.

    Poses are refined along. Of views from one place (nearer to each other than a tenth of the
    distance) only the best counts, since their errors are the same. An end that any view shows
    counts as seen.

    Parameters
    ----------
    views : sequence of FruitView
        All of one fruit.

    Returns
    -------
    JointMeasurement
        The reason is 'too-few-points' where no view can be measured.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> from cucumbervision_lab.synthesis.bodies import arc_tube, rotation
    >>> from cucumbervision_lab.synthesis.scene import Scene, render
    >>> camera = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    >>> fruit = arc_tube(0.20, 0.02, 0.30).moved(rotation(70, 40), (0, 0, 0.6))
    >>> def seen_from(along_m):
    ...     scene = render(Scene.of(fruit.moved(np.eye(3), (-along_m, 0, 0))), camera)
    ...     pose = np.eye(4)
    ...     pose[0, 3] = along_m
    ...     return FruitView(scene.depth_m.astype(np.float32), scene.mask(0), camera, pose)
    >>> found = measure_views([seen_from(0.0), seen_from(0.2)])
    >>> round(found.measurement.tube.centreline_m, 3), sorted(found.poses)
    (0.2, [0, 1])
    """
    found = [one for k, view in enumerate(views) if (one := _alone(k, view)) is not None]
    if not found:
        return JointMeasurement(Measurement(Method.M6, reason=Reason.TOO_FEW_POINTS))
    found.sort(key=lambda one: (not all(one.fitting.ends_seen), _relative_sd(one.fitting)))
    kept = found[:1]
    for more in found[1:]:
        if all(_apart(more, other) for other in kept):
            kept.append(more)
    first = kept[0]
    if len(kept) > 1:
        seen = [SeenFrom(first.tube.evidence, np.eye(3), np.zeros(3))]
        seen += [_relative(first, other) for other in kept[1:]]
        with suppress(np.linalg.LinAlgError):
            fit = fit_views(seen, first.fitting.shape)
            together = judged_fit(first.tube, fit.body, views=len(kept))
            numbers = [one.number for one in kept]
            return JointMeasurement(
                together, first.number, dict(zip(numbers, fit.poses, strict=True))
            )
    alone = judged_fit(first.tube, first.fitting)
    return JointMeasurement(alone, first.number, {first.number: np.eye(4)})


@dataclass(frozen=True, eq=False)
class _Alone:
    """A view with the tube that fits it alone."""

    number: int
    view: FruitView
    tube: TubeView
    fitting: TubeFitting


def _alone(number: int, view: FruitView) -> _Alone | None:
    tube = view_tube(view.depth_m, view.mask, view.intrinsics)
    fitting = None if tube is None else fit_view(tube)
    if tube is None or fitting is None or isinstance(fitting, Reason):
        return None
    return _Alone(number, view, tube, fitting)


def _relative_sd(fitting: TubeFitting) -> float:
    centres, _ = fitting.shape.balls()
    along = float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())
    return fitting.centreline_sd_m / max(along, 1e-6)


def _middle(fitting: TubeFitting) -> NDArray[np.float64]:
    return np.asarray(fitting.shape.balls(3)[0][1], dtype=np.float64)


def _apart(one: _Alone, other: _Alone) -> bool:
    away = float(np.linalg.norm(one.view.pose[:3, 3] - other.view.pose[:3, 3]))
    return away > _SAME_PLACE * float(np.linalg.norm(_middle(one.fitting)))


def _relative(first: _Alone, other: _Alone) -> SeenFrom:
    # Where the other camera sees the first one's body, laid onto its own: a stop's place is known
    # to centimetres only. Of part of a fruit the middle says nothing along the axis.
    view, fitting = other.view, other.fitting
    turn = view.pose[:3, :3].T @ first.view.pose[:3, :3]
    shift = view.pose[:3, :3].T @ (first.view.pose[:3, 3] - view.pose[:3, 3])
    off = _middle(fitting) - (turn @ _middle(first.fitting) + shift)
    sd = _ALIGNED_SD_M
    if not (all(fitting.ends_seen) and all(first.fitting.ends_seen)):
        run = np.diff(fitting.shape.balls(2)[0], axis=0)[0]
        run /= np.linalg.norm(run)
        off, sd = off - (off @ run) * run, view.shift_sd_m
    return SeenFrom(other.tube.evidence, turn, shift + off, sd, view.turn_sd_rad)
