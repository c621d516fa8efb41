"""One fruit seen from several places: one tube fitted to all views at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.geometry.tube_views import SeenFrom, fit_views
from cucumbervision.measurement.m6 import fit_view, judged_fit, view_tube
from cucumbervision.measurement.result import Measurement, Method, Reason

if TYPE_CHECKING:
    from collections.abc import Sequence

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


def measure_views(views: Sequence[FruitView]) -> Measurement:
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
    Measurement
        As `measure_m6`, in the coordinates of the view that shows the fruit best. Its reason is
        'too-few-points' where no view can be measured.

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
    >>> round(measure_views([seen_from(0.0), seen_from(0.2)]).tube.centreline_m, 3)
    0.2
    """
    found = [(view, *one) for view in views if (one := _alone(view)) is not None]
    if not found:
        return Measurement(Method.M6, reason=Reason.TOO_FEW_POINTS)
    found.sort(key=lambda one: (not all(one[2].ends_seen), _relative_sd(one[2])))
    kept = found[:1]
    for more in found[1:]:
        if all(_apart(more[0], other[0], more[2]) for other in kept):
            kept.append(more)
    first = kept[0]
    if len(kept) == 1:
        return judged_fit(first[1], first[2])
    seen = [SeenFrom(first[1].evidence, np.eye(3), np.zeros(3))]
    seen += [_relative(first, other) for other in kept[1:]]
    try:
        fitting = fit_views(seen, first[2].shape)
    except np.linalg.LinAlgError:
        return judged_fit(first[1], first[2])
    return judged_fit(first[1], fitting, views=len(kept))


def _alone(view: FruitView) -> tuple[TubeView, TubeFitting] | None:
    tube = view_tube(view.depth_m, view.mask, view.intrinsics)
    fitting = None if tube is None else fit_view(tube)
    if tube is None or fitting is None or isinstance(fitting, Reason):
        return None
    return tube, fitting


def _relative_sd(fitting: TubeFitting) -> float:
    centres, _ = fitting.shape.balls()
    along = float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())
    return fitting.centreline_sd_m / max(along, 1e-6)


def _middle(fitting: TubeFitting) -> NDArray[np.float64]:
    return np.asarray(fitting.shape.balls(3)[0][1], dtype=np.float64)


def _apart(view: FruitView, other: FruitView, fitting: TubeFitting) -> bool:
    away = float(np.linalg.norm(view.pose[:3, 3] - other.pose[:3, 3]))
    return away > _SAME_PLACE * float(np.linalg.norm(_middle(fitting)))


def _relative(
    first: tuple[FruitView, TubeView, TubeFitting], other: tuple[FruitView, TubeView, TubeFitting]
) -> SeenFrom:
    # Where the other camera sees the first one's body, laid onto its own: a stop's place is known
    # to centimetres only. Of part of a fruit the middle says nothing along the axis.
    view, _, fitting = other
    turn = view.pose[:3, :3].T @ first[0].pose[:3, :3]
    shift = view.pose[:3, :3].T @ (first[0].pose[:3, 3] - view.pose[:3, 3])
    off = _middle(fitting) - (turn @ _middle(first[2]) + shift)
    sd = _ALIGNED_SD_M
    if not (all(fitting.ends_seen) and all(first[2].ends_seen)):
        run = np.diff(fitting.shape.balls(2)[0], axis=0)[0]
        run /= np.linalg.norm(run)
        off, sd = off - (off @ run) * run, view.shift_sd_m
    return SeenFrom(other[1].evidence, turn, shift + off, sd, view.turn_sd_rad)
