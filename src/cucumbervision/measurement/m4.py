"""M4, keypoints: the polyline through five landmarks lifted to space."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.geometry.curve import polyline_length
from cucumbervision.measurement.m1 import window_depths
from cucumbervision.measurement.m2_m3 import m3_or_m2
from cucumbervision.measurement.methods import Region, TableMethod, or_else
from cucumbervision.measurement.result import LengthKind, Measurement, MethodName, Reason

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.capture.intrinsics import Intrinsics

MIN_VISIBILITY = np.array([0.50, 0.25, 0.25, 0.25, 0.50])
WINDOW_PX = 5
_DEPTH_SPREAD_M = 0.08
_POLYLINE_FROM = 4


def measure_m4(
    depth_m: NDArray[np.float32],
    mask: NDArray[np.bool_] | None,
    keypoints: NDArray[np.float64] | None,
    intrinsics: Intrinsics,
) -> Measurement:
    """Measure a fruit through its five landmarks, blossom end to stem end.

    A keypoint's depth is the median of the valid readings in a 5x5 window inside the mask.
    Keypoints of too little visibility, without depth, or more than 8 cm from the keypoints'
    median depth are left out. Four or five left: the sum of the segments; two or three: the
    straight line between the endpoints.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour.
    mask : ndarray of bool, shape (H, W), optional
        The fruit's pixels; without it every reading in the window counts.
    keypoints : ndarray of float, shape (5, 3), optional
        u, v in pixels and visibility 0 to 1, KP0 (blossom end) to KP4 (stem end).
    intrinsics : Intrinsics
        The colour stream's.

    Returns
    -------
    Measurement
        Kind 'keypoint-polyline'; reason 'no-keypoints', or 'endpoint-missing' when KP0 or KP4 is
        left out, where the table's method falls back on M3.

    Notes
    -----
    The paper's M4 (Eq. 3).

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> camera = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    >>> depth = np.full((480, 640), 0.6, np.float32)
    >>> u = np.array([220, 270, 320, 370, 420])
    >>> keypoints = np.stack([u, 0 * u + 240, 0 * u + 1], axis=1).astype(float)
    >>> round(measure_m4(depth, None, keypoints, camera).length_m, 4)
    0.2
    """
    if keypoints is None:
        return Measurement(MethodName.M4, reason=Reason.NO_KEYPOINTS)
    u, v, visibility = np.asarray(keypoints, dtype=np.float64).T
    z = window_depths(depth_m, u, v, WINDOW_PX, mask)
    is_used = (visibility >= MIN_VISIBILITY) & np.isfinite(z)
    if is_used.any():
        with np.errstate(invalid="ignore"):
            is_used &= np.abs(z - np.median(z[is_used])) <= _DEPTH_SPREAD_M
    if not is_used[0] or not is_used[-1]:
        return Measurement(MethodName.M4, reason=Reason.ENDPOINT_MISSING)
    x, y = intrinsics.rays(u, v)
    points = np.stack([x * z, y * z, z], axis=1)[is_used]
    path = points if len(points) >= _POLYLINE_FROM else points[[0, -1]]
    return Measurement(
        MethodName.M4, polyline_length(path), LengthKind.KEYPOINT_POLYLINE, path_m=path
    )


def _measure(region: Region) -> Measurement:
    result = measure_m4(region.depth_m, region.mask, region.keypoints, region.intrinsics)
    if result.reason is Reason.ENDPOINT_MISSING:
        return or_else(result, MethodName.M3, m3_or_m2(region))
    return result


METHOD = TableMethod(
    name="M4",
    title="keypoints",
    kind=LengthKind.KEYPOINT_POLYLINE,
    measure=_measure,
    needs=("keypoints",),
    rank=30,
    least_points=100,
    is_paper=True,
    color="#F0E442",
)
