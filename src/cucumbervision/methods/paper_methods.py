"""The methods of the paper: M1 scan line, M2 box PCA, M3 mask PCA, M4 keypoints, M5 spline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cucumbervision.arrays import Array, Array32, Mask, Numbers
from cucumbervision.capture.frames import valid_depth
from cucumbervision.methods.result import LengthKind, Measurement, MethodName, Reason
from cucumbervision.methods.table import GATE_M, Region, box_pixels, or_else, own_method
from cucumbervision.tube.evidence import valid_median
from cucumbervision.tube.shape import (
    AlignedCloud,
    align_near,
    bin_centroids,
    natural_spline,
    polyline_length,
)

_LINES = (0.25, 0.5, 0.75)
_SAMPLES = 13
M1_WINDOW_PX = 11


def measure_m1(region: Region) -> Measurement:
    """Measure a fruit by three scan lines along the longer side of its box.

    Lines at 1/4, 1/2 and 3/4 of the width, 13 samples each from end to end, each the median of
    the valid readings in an 11x11 window. A sample counts when it is within 3.5 cm of the median
    depth of the box's middle ninth. A line's length is the distance between its two outermost
    counting samples; the median of the lines is the result.

    Returns
    -------
    Measurement
        Kind 'box-chord'; reason 'no-depth' when the middle ninth has no reading and
        'too-few-samples' when no line has two counting samples.

    Notes
    -----
    The paper's M1 (Eq. 1). For a fruit at angle t in the picture, before a backdrop at its own
    depth, it tends to L cos t; before empty or far space the lines leave the fruit and it reads
    far less. This known error of the method is kept.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> camera = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    >>> depth = np.full((480, 640), 0.6, np.float32)
    >>> region = Region(depth, camera, np.array([219.5, 219.5, 419.5, 259.5]))
    >>> result = measure_m1(region)
    >>> round(result.length_m, 4)  # 200 px at 0.6 m and f = 600 px
    0.2
    """
    box, reference = region.box, reference_depth(region.depth_m, region.box)
    if reference is None:
        return Measurement(MethodName.M1, reason=Reason.NO_DEPTH)
    u, v = sample_grid(box)
    z = window_depths(region.depth_m, u, v, M1_WINDOW_PX)
    with np.errstate(invalid="ignore"):
        counts = np.abs(z - reference) <= GATE_M
    x, y = region.intrinsics.rays(u, v)
    points = np.stack([x * z, y * z, z], axis=-1).astype(np.float64)
    segments = []
    for line, ok in zip(points, counts, strict=True):
        index = np.flatnonzero(ok)
        if len(index) >= 2:
            segments.append(line[[index[0], index[-1]]])
    if not segments:
        return Measurement(MethodName.M1, reason=Reason.TOO_FEW_SAMPLES)
    lengths = np.array([np.linalg.norm(b - a) for a, b in segments])
    length = float(np.median(lengths))
    path = segments[int(np.argmin(np.abs(lengths - length)))]
    return Measurement(MethodName.M1, length, LengthKind.BOX_CHORD, path_m=path)


def reference_depth(depth_m: Array32, box: Numbers) -> float | None:
    """Return the median depth of a box's middle ninth, metres, or None without a reading.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres; 0 where there is no reading.
    box : ndarray of float, shape (4,)
        Edges x1, y1, x2, y2 in pixels.
    """
    third = (box[2:] - box[:2]) / 3
    middle = np.concatenate([box[:2] + third, box[2:] - third])
    x1, y1, x2, y2 = box_pixels(middle, depth_m.shape)
    region = depth_m[y1:y2, x1:x2]
    readings = region[valid_depth(region)]
    return float(np.median(readings)) if len(readings) else None


def sample_grid(box: Numbers) -> tuple[Array, Array]:
    """Return the pixels u and v of a box's samples, each of shape (lines, samples).

    Parameters
    ----------
    box : ndarray of float, shape (4,)
        Edges x1, y1, x2, y2 in pixels; lines run along the longer side.

    Examples
    --------
    >>> u, v = sample_grid(np.array([0.0, 0.0, 24.0, 8.0]))
    >>> u.shape, u[0, :3].tolist(), v[:, 0].tolist()
    ((3, 13), [0.0, 2.0, 4.0], [2.0, 4.0, 6.0])
    """
    # Axis of the longer side: 0 for a wide box, 1 for a high one.
    side = int(box[3] - box[1] > box[2] - box[0])
    across_axis = 1 - side
    along = np.linspace(box[side], box[side + 2], _SAMPLES)
    across = box[across_axis] + np.array(_LINES)[:, None] * (
        box[across_axis + 2] - box[across_axis]
    )
    grids = np.broadcast_arrays(along[None, :], across)
    return grids[side], grids[across_axis]


def window_depths(
    depth_m: Array32, u_px: Array, v_px: Array, window_px: int, mask: Mask | None = None
) -> Array:
    """Return the median of the valid readings in a square window around each position.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres.
    u_px, v_px : ndarray of float, any shape
        Positions in pixels; a window is centred on the nearest pixel and cut to the picture.
    window_px : int
        Odd width of the window.
    mask : ndarray of bool, shape (H, W), optional
        Only readings inside it count.

    Returns
    -------
    ndarray of float64, the shape of `u_px`
        Metres; NaN where the window has no reading.

    Examples
    --------
    >>> depth = np.zeros((9, 9), np.float32)
    >>> depth[4, 3:6] = 0.5, 0.6, 0.75
    >>> window_depths(depth, np.array([4.2]), np.array([3.9]), 3).round(2)
    array([0.6])
    """
    height, width = depth_m.shape
    offsets = np.arange(window_px) - window_px // 2
    rows = np.rint(v_px).astype(np.intp).ravel()[:, None, None] + offsets[:, None]
    columns = np.rint(u_px).astype(np.intp).ravel()[:, None, None] + offsets
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    rows, columns = np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)
    readings = depth_m[rows, columns]
    counts = inside & valid_depth(readings)
    if mask is not None:
        counts &= mask[rows, columns]
    flat = (len(readings), window_px * window_px)
    medians = valid_median(readings.reshape(flat), counts.reshape(flat), axis=1)
    return medians.astype(np.float64).reshape(u_px.shape)


def measure_m2(region: Region) -> Measurement:
    """Measure a fruit by the spread of its box's points along their principal axis.

    Returns
    -------
    Measurement
        Kind 'surface-chord'; reason 'no-depth' when the box has no readings and
        'too-few-points' when fewer than two pass the gate.

    Notes
    -----
    The paper's M2 (Eq. 2): |z - median z| <= 3.5 cm, centre, first singular vector, extreme
    projections.
    """
    if not len(region.box_points_m):
        return Measurement(MethodName.M2, reason=Reason.NO_DEPTH)
    return _principal_chord(align_near(region.box_points_m, GATE_M), MethodName.M2)


def _principal_chord(cloud: AlignedCloud, method: MethodName) -> Measurement:
    """Return the chord between the extreme projections on the principal axis.

    Parameters
    ----------
    cloud : AlignedCloud
        The cloud after the depth gate.
    method : MethodName
        Name of the method in the result.

    Returns
    -------
    Measurement
        Kind 'surface-chord'; its path runs along the axis through the centroid. Reason
        'too-few-points' below two points.

    Examples
    --------
    >>> cloud = align_near(np.array([[0.0, 0.0, 0.5], [0.3, 0.4, 0.5]]), GATE_M)
    >>> round(_principal_chord(cloud, MethodName.M3).length_m, 6)
    0.5
    """
    if len(cloud.points_m) < 2:
        return Measurement(method, reason=Reason.TOO_FEW_POINTS)
    first_m, last_m = float(cloud.along_m.min()), float(cloud.along_m.max())
    path = cloud.centroid_m + np.array([[first_m], [last_m]]) * cloud.axis
    return Measurement(method, last_m - first_m, LengthKind.SURFACE_CHORD, path_m=path)


_M3_POINTS = 50


def measure_m3(region: Region) -> Measurement:
    """Measure a fruit by the spread of its mask's points along their principal axis.

    Returns
    -------
    Measurement
        Kind 'surface-chord'; that of M2 below 50 valid pixels.

    Notes
    -----
    The paper's M3, by its method section: PCA, the gate included. (Its abstract says skeleton.)
    """
    cloud, result = region.mask_near, Measurement(MethodName.M3, reason=Reason.TOO_FEW_POINTS)
    if cloud is None or region.mask_points_m is None:
        return replace(result, reason=Reason.NO_MASK)
    if len(region.mask_points_m) >= _M3_POINTS:
        result = _principal_chord(cloud, MethodName.M3)
    return result if result.is_direct else or_else(result, MethodName.M2, measure_m2(region))


MIN_VISIBILITY = np.array([0.50, 0.25, 0.25, 0.25, 0.50])
M4_WINDOW_PX = 5
_DEPTH_SPREAD_M = 0.08
_POLYLINE_FROM = 4


def measure_m4(region: Region) -> Measurement:
    """Measure a fruit through its five landmarks, blossom end to stem end.

    A keypoint's depth is the median of the valid readings in a 5x5 window inside the mask.
    Keypoints of too little visibility, without depth, or more than 8 cm from the keypoints'
    median depth are left out. Four or five left: the sum of the segments; two or three: the
    straight line between the endpoints.

    Returns
    -------
    Measurement
        Kind 'keypoint-polyline'; reason 'no-keypoints', or 'endpoint-missing' when KP0 or KP4 is
        left out, where it falls back on M3.

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
    >>> region = Region(depth, camera, np.array([219.5, 219.5, 419.5, 259.5]), None, keypoints)
    >>> round(measure_m4(region).length_m, 4)
    0.2
    """
    if region.keypoints is None:
        return Measurement(MethodName.M4, reason=Reason.NO_KEYPOINTS)
    u, v, visibility = np.asarray(region.keypoints, dtype=np.float64).T
    z = window_depths(region.depth_m, u, v, M4_WINDOW_PX, region.mask)
    is_used = (visibility >= MIN_VISIBILITY) & np.isfinite(z)
    if is_used.any():
        with np.errstate(invalid="ignore"):
            is_used &= np.abs(z - np.median(z[is_used])) <= _DEPTH_SPREAD_M
    if not is_used[0] or not is_used[-1]:
        failed = Measurement(MethodName.M4, reason=Reason.ENDPOINT_MISSING)
        return or_else(failed, MethodName.M3, measure_m3(region))
    x, y = region.intrinsics.rays(u, v)
    points = np.stack([x * z, y * z, z], axis=1)[is_used]
    path = points if len(points) >= _POLYLINE_FROM else points[[0, -1]]
    return Measurement(
        MethodName.M4, polyline_length(path), LengthKind.KEYPOINT_POLYLINE, path_m=path
    )


SPLINE_POINTS = 100
_BINS = 25
_MIN_BIN_POINTS = 3
_TIP_POINTS = 5
_MIN_BINS = 2
_RANGE_M = (0.05, 0.80)


def measure_m5(region: Region) -> Measurement:
    """Measure a fruit along a cubic spline through the centroids of its cross-sections.

    The gate |z - median z| <= 3.5 cm; at least 100 points; first principal axis; 25 equal bins,
    the centroid of each with at least 3 points; both tips anchored by the mean of the five
    extreme points; natural cubic splines over the chord-length parameter; trapezoidal integral
    of the speed over 1,000 samples; accepted between 5 and 80 cm.

    Returns
    -------
    Measurement
        Kind 'surface-arc'; reason 'too-few-points', 'too-few-bins' or 'out-of-range'.

    Notes
    -----
    The paper's M5 (Eqs. 4 to 6), kept for comparison with its known faults: the fixed gate cuts
    fruit tilted towards the camera, the tip anchors zigzag on rough edges, and the spline runs
    along the visible surface and not along the axis.
    """
    if region.mask_near is None:
        return Measurement(MethodName.M5, reason=Reason.NO_MASK)
    points, along = region.mask_near.points_m, region.mask_near.along_m
    if len(points) < SPLINE_POINTS:
        return Measurement(MethodName.M5, reason=Reason.TOO_FEW_POINTS)
    spine = bin_centroids(points, along, _BINS, _MIN_BIN_POINTS)
    if len(spine) < _MIN_BINS:
        return Measurement(MethodName.M5, reason=Reason.TOO_FEW_BINS)
    first_tip = points[np.argpartition(along, _TIP_POINTS - 1)[:_TIP_POINTS]].mean(axis=0)
    last_tip = points[np.argpartition(along, -_TIP_POINTS)[-_TIP_POINTS:]].mean(axis=0)
    length, path = natural_spline(np.vstack([first_tip, spine, last_tip]))
    if not _RANGE_M[0] <= length <= _RANGE_M[1]:
        return Measurement(MethodName.M5, reason=Reason.OUT_OF_RANGE)
    return Measurement(MethodName.M5, length, LengthKind.SURFACE_ARC, path_m=path)


M1, M2, M3, M4, M5 = map(
    own_method, MethodName, (measure_m1, measure_m2, measure_m3, measure_m4, measure_m5)
)
