"""M5, the medial arc spline of the paper."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.geometry.axis import AlignedCloud, align_near, bin_centroids
from cucumbervision.geometry.curve import natural_spline
from cucumbervision.measurement.methods import GATE_M, Region, TableMethod
from cucumbervision.measurement.result import LengthKind, Measurement, MethodName, Reason

if TYPE_CHECKING:
    from numpy.typing import NDArray

MIN_POINTS = 100
_BINS = 25
_MIN_BIN_POINTS = 3
_TIP_POINTS = 5
_MIN_BINS = 2
_RANGE_M = (0.05, 0.80)


def measure_m5(mask_points_m: NDArray[Any], aligned: AlignedCloud | None = None) -> Measurement:
    """Measure a fruit along a cubic spline through the centroids of its cross-sections.

    The gate |z - median z| <= 3.5 cm; at least 100 points; first principal axis; 25 equal bins,
    the centroid of each with at least 3 points; both tips anchored by the mean of the five
    extreme points; natural cubic splines over the chord-length parameter; trapezoidal integral
    of the speed over 1,000 samples; accepted between 5 and 80 cm.

    Parameters
    ----------
    mask_points_m : ndarray of float, shape (N, 3)
        The mask's pixels with a valid reading, deprojected
        (`measurement.cloud.masked_points`), metres.
    aligned : AlignedCloud, optional
        The same points after the depth gate, if already computed.

    Returns
    -------
    Measurement
        Kind 'surface-arc'; reason 'too-few-points', 'too-few-bins' or 'out-of-range'.

    Notes
    -----
    The paper's M5 (Eqs. 4 to 6), kept for comparison with its known faults: the fixed gate cuts
    fruit tilted towards the camera, the tip anchors zigzag on rough edges, and the spline runs
    along the visible surface and not along the axis.

    Examples
    --------
    >>> t = np.linspace(-0.5, 0.5, 2001)
    >>> arc = np.stack([0.2 * np.sin(t), 0.2 * np.cos(t), 0 * t + 0.5], axis=1)
    >>> round(measure_m5(arc).length_m, 3)  # an arc of 0.2 m radius over 1 rad
    0.2
    """
    cloud = aligned or align_near(mask_points_m, GATE_M)
    points, along = cloud.points_m, cloud.along_m
    if len(points) < MIN_POINTS:
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


def _measure(region: Region) -> Measurement:
    if region.mask_points_m is None:
        return Measurement(MethodName.M5, reason=Reason.NO_MASK)
    return measure_m5(region.mask_points_m, region.mask_near)


METHOD = TableMethod(
    name="M5",
    title="medial arc spline",
    kind=LengthKind.SURFACE_ARC,
    measure=_measure,
    needs=("mask",),
    rank=20,
    least_points=MIN_POINTS,
    is_paper=True,
    color="#0072B2",
)
