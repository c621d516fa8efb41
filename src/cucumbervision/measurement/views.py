"""One fruit seen from several places: one tube fitted to all views at once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.geometry.tube_views import SeenFrom, fit_views
from cucumbervision.measurement.flags import LOWER_BOUND, Flag
from cucumbervision.measurement.hidden_end import BeyondEnd, beyond_ends
from cucumbervision.measurement.m6 import PART_HIDDEN, fit_view, judged_fit, view_tube
from cucumbervision.measurement.pose import fruit_pose, stem_first
from cucumbervision.measurement.result import (
    Choice,
    Fruit,
    LengthDefinition,
    Measurement,
    MethodName,
    Reason,
)
from cucumbervision.measurement.selector import (
    cut_by_frame,
    hidden_ends,
    measure_fruit,
    with_length,
)
from cucumbervision.threads import OneThread

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from cucumbervision.capture.frames import Capture
    from cucumbervision.geometry.tube import TubeShape
    from cucumbervision.geometry.tube_fit import TubeFitting
    from cucumbervision.instances.instance import Instance
    from cucumbervision.measurement.intervals import IntervalModels
    from cucumbervision.measurement.m6 import TubeView

_SAME_PLACE = 0.10  # of the distance: cameras closer to each other share their errors
_ALIGNED_SD_M = 0.015  # of a shift, after the middles of two whole views are aligned

# Flags of a single view, which are determined again from several views.
_BY_VIEW = LOWER_BOUND | {
    *(Flag.END_ON, Flag.PART_HIDDEN, Flag.POOR_FIT, Flag.UNCERTAIN, Flag.INTERVAL_TOO_WIDE)
}


@dataclass(frozen=True, eq=False)
class FruitView:
    """One fruit in one capture.

    Parameters
    ----------
    capture : Capture
        The frame.
    instance : Instance
        The fruit in it, with its mask.
    pose : ndarray of float64, shape (4, 4)
        Transform from camera coordinates to the common coordinates of all views.
    shift_sd_m, turn_sd_rad : float
        Standard deviations of the pose.
    """

    capture: Capture
    instance: Instance
    pose: NDArray[np.float64]
    shift_sd_m: float = 0.03
    turn_sd_rad: float = 0.02


@dataclass(frozen=True, eq=False)
class JointFruit:
    """The joint result of several views of one fruit.

    Parameters
    ----------
    fruit : Fruit
        Measurement of M6 in the camera coordinates of the view `first`, with the instance and mask
        of that view; flags apply to all views together.
    first : int
        Index of the view that shows the fruit best.
    poses : mapping of int to ndarray of float64, shape (4, 4)
        Refined transforms from the coordinates of that camera to those of each fitted view.
    """

    fruit: Fruit
    first: int
    poses: Mapping[int, NDArray[np.float64]]


@OneThread()
def measure_views(
    views: Sequence[FruitView],
    definition: LengthDefinition = LengthDefinition.CENTRELINE,
    *,
    scale_known: bool = False,
    models: IntervalModels | None = None,
) -> JointFruit | None:
    """Fit one swept tube to a fruit's depth and outlines in all views.

    Poses are refined simultaneously. Of views from one place (closer together than a tenth of the
    distance), only the best is used, since they share their errors. Views with hardly any depth are
    left out if there are others. An end that is visible in any view counts as visible.

    Parameters
    ----------
    views : sequence of FruitView
        Views of one fruit.
    definition : LengthDefinition
        Definition of length.
    scale_known : bool
        As in `measure_fruit`.
    models : IntervalModels, optional
        Interval models; by default those of the package.

    Returns
    -------
    JointFruit or None
        None if M6 cannot measure the fruit in any single view.

    Examples
    --------
    >>> from cucumbervision.capture.frames import Capture
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> from cucumbervision.instances.instance import Instance
    >>> from cucumbervision.instances.masks import box_of_mask
    >>> from cucumbervision_lab.synthesis.bodies import arc_tube, rotation
    >>> from cucumbervision_lab.synthesis.scene import Scene, render
    >>> camera = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    >>> body = arc_tube(0.20, 0.02, 0.30).moved(rotation(70, 40), (0, 0, 0.6))
    >>> def seen_from(along_m):
    ...     scene = render(Scene.of(body.moved(np.eye(3), (-along_m, 0, 0))), camera)
    ...     mask, pose = scene.mask(0), np.eye(4)
    ...     pose[0, 3] = along_m
    ...     blank = np.zeros((480, 640, 3), np.uint8)
    ...     capture = Capture(blank, scene.depth_m.astype(np.float32), camera, "drawn")
    ...     return FruitView(capture, Instance(box_of_mask(mask), mask=mask), pose)
    >>> joint = measure_views([seen_from(0.0), seen_from(0.2)])
    >>> round(joint.fruit.traits.lengths.centreline_m, 3), sorted(joint.poses)
    (0.2, [0, 1])
    """
    fitted_views = [
        fitted for k, view in enumerate(views) if (fitted := _fitted_view(k, view)) is not None
    ]
    if not fitted_views:
        return None
    fitted_views.sort(
        key=lambda fitted: (
            fitted.tube.sparse,
            not all(fitted.fitting.ends_seen),
            _relative_sd(fitted.fitting),
        )
    )
    chosen = fitted_views[:1]
    for candidate in fitted_views[1:]:
        if not candidate.tube.sparse and all(_is_elsewhere(candidate, member) for member in chosen):
            chosen.append(candidate)
    first = chosen[0]
    joint = _joint(chosen) if len(chosen) > 1 else None
    if joint is None:
        alone = measure_fruit(
            *(first.view.capture, first.view.instance, (MethodName.M6,)),
            definition=definition,
            scale_known=scale_known,
            models=models,
        )
        return JointFruit(alone, first.number, {first.number: np.eye(4)})
    fruit = with_length(joint[0], definition, scale_known=scale_known, models=models)
    numbers = [fitted.number for fitted in chosen]
    return JointFruit(fruit, first.number, dict(zip(numbers, joint[1], strict=True)))


def _joint(chosen: Sequence[_FittedView]) -> tuple[Fruit, tuple[NDArray[np.float64], ...]] | None:
    """Return the fruit with one tube for all views, and the camera poses; None if it fails."""
    first = chosen[0]
    cameras = [SeenFrom(first.tube.evidence, np.eye(3), np.zeros(3))]
    cameras += [_relative(first, fitted_view) for fitted_view in chosen[1:]]
    try:
        fitted = fit_views(cameras, first.fitting.shape)
    except np.linalg.LinAlgError:
        return None
    ends = _beyond_ends(chosen, fitted.poses, fitted.body.shape)
    one_tube, sure = stem_first(
        judged_fit(first.tube, fitted.body, ends), first.view.instance, first.view.capture
    )
    # Properties of the fruit other than its length.
    alone = measure_fruit(first.view.capture, first.view.instance, ())
    return _joint_measurement(alone, one_tube, sure, chosen, fitted.poses), fitted.poses


def _beyond_ends(
    chosen: Sequence[_FittedView], poses: Sequence[NDArray[np.float64]], shape: TubeShape
) -> tuple[BeyondEnd, BeyondEnd]:
    # Background seen beyond an end in any view outweighs an occluder in another view.
    centres, radii = shape.balls()
    by_view = [
        beyond_ends(
            fitted.view.capture.depth_m,
            fitted.mask,
            fitted.view.capture.intrinsics,
            centres @ pose[:3, :3].T + pose[:3, 3],
            radii,
        )
        for fitted, pose in zip(chosen, poses, strict=True)
    ]
    first, last = (max(end.behind for end in ends) for ends in zip(*by_view, strict=True))
    return BeyondEnd(behind=first), BeyondEnd(behind=last)


def _joint_measurement(
    alone: Fruit,
    one_tube: Measurement,
    stem_confidence: float,
    chosen: Sequence[_FittedView],
    poses: Sequence[NDArray[np.float64]],
) -> Fruit:
    """Return the fruit with the tube of all views, and the flags that apply to all views."""
    fit = one_tube.fit
    flags: list[Flag] = []
    if fit is not None:
        hidden = _hidden_share(chosen, poses, fit.traits.axis_m)
        flags += (flag for flag in fit.flags if flag is not Flag.PART_HIDDEN)
        flags += [Flag.PART_HIDDEN] if hidden > PART_HIDDEN else []
        one_tube = replace(one_tube, fit=replace(fit, hidden_share=hidden, flags=tuple(flags)))
    ends = [hidden_ends(fitted.mask, fitted.view.instance.keypoints) for fitted in chosen]
    blossom, stem = (all(of_end) for of_end in zip(*ends, strict=True))
    if blossom or stem:
        flags.append(Flag.END_HIDDEN)
    if all(_is_cut(fitted.view) for fitted in chosen):
        flags.append(Flag.CUT_BY_FRAME)
    flags += [flag for flag in alone.flags if flag not in _BY_VIEW]
    return replace(
        alone,
        measurements={MethodName.M6: one_tube},
        selected=None if one_tube.length_m is None else one_tube,
        reason=Choice.SEVERAL_VIEWS,
        flags=tuple(dict.fromkeys(flags)),
        pose=fruit_pose(one_tube, stem_confidence, (blossom, stem), chosen[0].view.capture),
    )


def _is_cut(view: FruitView) -> bool:
    capture, instance = view.capture, view.instance
    return cut_by_frame(instance.box, instance.mask, capture.width, capture.height)


def _hidden_share(
    chosen: Sequence[_FittedView], poses: Sequence[NDArray[np.float64]], axis_m: NDArray[np.float64]
) -> float:
    # Share of the axis that is in no mask.
    is_shown = np.zeros(len(axis_m), bool)
    for fitted, pose in zip(chosen, poses, strict=True):
        points = axis_m @ pose[:3, :3].T + pose[:3, 3]
        u, v = fitted.view.capture.intrinsics.project(points).round().astype(int).T
        height, width = fitted.mask.shape
        inside = (points[:, 2] > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        is_shown[inside] |= fitted.mask[v[inside], u[inside]]
    return float(1.0 - is_shown.mean())


@dataclass(frozen=True, eq=False)
class _FittedView:
    """A view with the tube that fits it alone."""

    number: int
    view: FruitView
    mask: NDArray[np.bool_]
    tube: TubeView
    fitting: TubeFitting


def _fitted_view(number: int, view: FruitView) -> _FittedView | None:
    mask, capture = view.instance.mask, view.capture
    tube = None if mask is None else view_tube(capture.depth_m, mask, capture.intrinsics)
    fitting = None if tube is None else fit_view(tube)
    if mask is None or tube is None or fitting is None or isinstance(fitting, Reason):
        return None
    return _FittedView(number=number, view=view, mask=mask, tube=tube, fitting=fitting)


def _relative_sd(fitting: TubeFitting) -> float:
    centres, _ = fitting.shape.balls()
    along = float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())
    return fitting.centreline_sd_m / max(along, 1e-6)


def _middle(fitting: TubeFitting) -> NDArray[np.float64]:
    return np.asarray(fitting.shape.balls(3)[0][1], dtype=np.float64)


def _is_elsewhere(first: _FittedView, second: _FittedView) -> bool:
    away = float(np.linalg.norm(first.view.pose[:3, 3] - second.view.pose[:3, 3]))
    return away > _SAME_PLACE * float(np.linalg.norm(_middle(first.fitting)))


def _relative(first: _FittedView, second: _FittedView) -> SeenFrom:
    # Align the body of the first view with that of the second, because the position of a stop is
    # known only to centimetres. For a partly visible fruit, the middle is unknown along the axis.
    view, fitting = second.view, second.fitting
    turn = view.pose[:3, :3].T @ first.view.pose[:3, :3]
    shift = view.pose[:3, :3].T @ (first.view.pose[:3, 3] - view.pose[:3, 3])
    off = _middle(fitting) - (turn @ _middle(first.fitting) + shift)
    sd = _ALIGNED_SD_M
    if not (all(fitting.ends_seen) and all(first.fitting.ends_seen)):
        run = np.diff(fitting.shape.balls(2)[0], axis=0)[0]
        run /= np.linalg.norm(run)
        off, sd = off - (off @ run) * run, view.shift_sd_m
    return SeenFrom(
        evidence=second.tube.evidence,
        turn=turn,
        shift_m=shift + off,
        shift_sd_m=sd,
        turn_sd_rad=view.turn_sd_rad,
    )
