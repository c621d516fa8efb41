"""Pose of a fruit for grasping and cutting: its ends, its axis, the place to cut."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cucumbervision.arrays import Array
from cucumbervision.capture.frames import Capture, valid_depth
from cucumbervision.fruit.instance import Instance
from cucumbervision.methods.flags import Flag
from cucumbervision.methods.intervals import SCALE_SD
from cucumbervision.methods.result import FruitPose, Measurement, Part, TubeFit
from cucumbervision.tube.fit import END_SHARE
from cucumbervision.tube.shape import arc_positions, points_along

CAMERA_FRAME = "camera_color_optical_frame"
"""Name of the coordinates of a capture that names none: x right, y down, z forward."""

CUT_BEYOND_M = 0.02
"""How far beyond the stem end a fruit is cut where no crop profile names it, metres."""

_AXIS_POINTS = 33

# Nearly all hanging fruit have the stem above: log-odds for an upright fruit.
_HANGING_LOG_ODDS = 6.0
_MOST_CONFIDENCE = 0.9999

# Not covered by the fit: a stem end is no hemisphere, and a peduncle deviates from the axis.
_END_SD_M = 0.0025
_PEDUNCLE_SD_RAD = 0.26

_NEARER_M = 0.01  # an object nearer than the cut place by more is in the way


def stem_first(
    measurement: Measurement, instance: Instance, capture: Capture
) -> tuple[Measurement, float]:
    """Return a measurement whose line begins at the stem end, and the confidence of that end.

    Parameters
    ----------
    measurement : Measurement
        Measurement of one method.
    instance : Instance
        The fruit, with keypoints and the confidence of their direction, if there are any.
    capture : Capture
        The frame; its `gravity` gives the upward direction.

    Returns
    -------
    measurement : Measurement
        Unchanged if it has no line.
    confidence : float
        0.5 to 1.

    Examples
    --------
    >>> from cucumbervision.capture.frames import Capture
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> from cucumbervision.methods.result import Measurement, MethodName
    >>> from cucumbervision.fruit.instance import Instance
    >>> lens = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
    >>> blank = np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64), np.float32)
    >>> line = np.array([[0.0, 0.1, 0.5], [0.0, -0.1, 0.5]])  # upwards: y is down
    >>> down = Capture(*blank, lens, "a", gravity=(0.0, 1.0, 0.0))
    >>> fruit = Instance(np.array([20.0, 12, 40, 36]))
    >>> turned, sure = stem_first(Measurement(MethodName.M3, 0.2, path_m=line), fruit, down)
    >>> turned.path_m[0].tolist(), round(sure, 3)
    ([0.0, -0.1, 0.5], 0.998)
    """
    path = measurement.path_m
    if path is None:
        return measurement, 0.5
    ends = path[[0, -1]]
    odds = _keypoint_odds(ends, instance, capture) + _gravity_odds(ends, capture)
    sure = float(1 / (1 + np.exp(-abs(odds))))
    if odds > 0 or (odds == 0 and ends[0, 1] <= ends[1, 1]):
        return measurement, sure
    fit = measurement.fit
    return replace(measurement, path_m=path[::-1], fit=fit and _turned(fit)), sure


def _keypoint_odds(ends_m: Array, instance: Instance, capture: Capture) -> float:
    """Return the log-odds, from the keypoints, that the first of two ends is the stem end."""
    points = instance.keypoints
    if points is None or (ends_m[:, 2] <= 0).any():
        return 0.0
    blossom, stem = points[0, :2], points[-1, :2]
    first, last = capture.intrinsics.project(ends_m)
    as_is = np.linalg.norm(first - stem) + np.linalg.norm(last - blossom)
    swapped = np.linalg.norm(first - blossom) + np.linalg.norm(last - stem)
    confidence = 1.0 if instance.end_confidence is None else instance.end_confidence
    sure = min(confidence, _MOST_CONFIDENCE)
    return float(np.sign(swapped - as_is) * np.log(sure / (1 - sure)))


def _gravity_odds(ends_m: Array, capture: Capture) -> float:
    """Return the same log-odds from gravity, near 0 for a horizontal fruit."""
    if capture.gravity is None:
        return 0.0
    down = np.array(capture.gravity) / np.linalg.norm(capture.gravity)
    run = ends_m[1] - ends_m[0]
    return float(_HANGING_LOG_ODDS * (run @ down) / max(np.linalg.norm(run), 1e-9))


def _turned(fit: TubeFit) -> TubeFit:
    traits = replace(
        fit.traits,
        along_m=fit.traits.along_m[-1] - fit.traits.along_m[::-1],
        diameter_m=fit.traits.diameter_m[::-1],
        axis_m=fit.traits.axis_m[::-1],
    )
    first, last = fit.ends_seen
    return replace(
        fit,
        traits=traits,
        ends_seen=(last, first),
        ends_covariance=fit.ends_covariance[::-1],
        ends_open=fit.ends_open[::-1],
        looks=None if fit.looks is None else fit.looks[::-1],
    )


def fruit_pose(
    measurement: Measurement,
    stem_confidence: float,
    hidden: tuple[bool, bool],
    capture: Capture,
    *,
    cut_beyond_m: float = CUT_BEYOND_M,
    scale_known: bool = False,
) -> FruitPose | None:
    """Return the pose of a fruit with a fitted tube; None for other fruit.

    Parameters
    ----------
    measurement : Measurement
        Measurement that begins at the stem end (`stem_first`).
    stem_confidence : float
        Confidence of the stem end.
    hidden : tuple of bool
        Whether keypoints say that the blossom's and the stem's end are hidden.
    capture : Capture
        The frame.
    cut_beyond_m : float
        Distance of the cut beyond the stem end, metres.
    scale_known : bool
        Whether the camera's depth scale was measured; otherwise its uncertainty is included.
    """
    fit = measurement.fit
    if fit is None:
        return None
    axis, run = fit.traits.axis_m, arc_positions(fit.traits.axis_m)
    shares = np.linspace(0.0, 1.0, _AXIS_POINTS)
    even = points_along(axis, shares)
    inner = points_along(axis, [END_SHARE])[0]
    direction = (axis[0] - inner) / max(float(np.linalg.norm(axis[0] - inner)), 1e-9)
    covered = [
        part
        for part, is_hidden, is_seen in zip(
            (Part.STEM, Part.BLOSSOM), hidden[::-1], fit.ends_seen, strict=True
        )
        if is_hidden or not is_seen
    ]
    covered += [Part.BODY] if Flag.PART_HIDDEN in fit.flags else []
    cut = covariance = None
    if Part.STEM not in covered:
        cut = axis[0] + cut_beyond_m * direction
        covariance = _cut_covariance(
            fit.ends_covariance[0], cut, direction, cut_beyond_m, 0.0 if scale_known else SCALE_SD
        )
        covered += [Part.CUT] if _is_behind(cut, capture) else []
    return FruitPose(
        frame=str(capture.provenance.get("frame_id") or CAMERA_FRAME),
        stem_m=axis[0],
        blossom_m=axis[-1],
        stem_confidence=stem_confidence,
        centre_m=even[_AXIS_POINTS // 2],
        axis_m=even,
        radius_m=np.interp(shares * run[-1], fit.traits.along_m, fit.traits.diameter_m) / 2,
        direction=direction,
        cut_m=cut,
        cut_covariance_m2=covariance,
        covered=tuple(covered),
    )


def _cut_covariance(
    end: Array, cut_m: Array, direction: Array, beyond_m: float, scale_sd: float
) -> Array:
    """Return the covariance of a point on the extension beyond an end.

    The sum of the fitted covariance of the end and its direction, the variation of the end's shape
    along the line, that of the peduncle's direction across it, and that of the depth scale along
    the view.
    """
    reach = np.hstack([np.eye(3), beyond_m * np.eye(3)])
    along = np.outer(direction, direction)
    covariance = reach @ end @ reach.T
    covariance += _END_SD_M**2 * along
    covariance += (_PEDUNCLE_SD_RAD * beyond_m) ** 2 * (np.eye(3) - along)
    covariance += scale_sd**2 * np.outer(cut_m, cut_m)
    return (covariance + covariance.T) / 2


def _is_behind(point_m: Array, capture: Capture) -> bool:
    """Return whether an object is in front of a point."""
    if point_m[2] <= 0:
        return False
    u, v = np.rint(capture.intrinsics.project(point_m[None])[0]).astype(int).tolist()
    if not (0 <= u < capture.width and 0 <= v < capture.height):
        return False
    depth_m = capture.depth_m[v, u]
    return bool(valid_depth(depth_m) and depth_m < point_m[2] - _NEARER_M)
