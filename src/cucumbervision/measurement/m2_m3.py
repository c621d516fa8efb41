"""M2, box PCA, and M3, mask PCA: the chord along the principal axis of a cloud."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.geometry.axis import AlignedCloud, align_near
from cucumbervision.measurement.methods import GATE_M, Region, TableMethod, or_else
from cucumbervision.measurement.result import LengthKind, Measurement, MethodName, Reason

if TYPE_CHECKING:
    from numpy.typing import NDArray


def measure_m2(box_points_m: NDArray[Any]) -> Measurement:
    """Measure a fruit by the spread of its box's points along their principal axis.

    Parameters
    ----------
    box_points_m : ndarray of float, shape (N, 3)
        The box's pixels at stride 2, deprojected (`measurement.cloud.box_points`), metres.

    Returns
    -------
    Measurement
        Kind 'surface-chord'; reason 'no-depth' when the box has no readings and
        'too-few-points' when fewer than two pass the gate.

    Notes
    -----
    The paper's M2 (Eq. 2): |z - median z| <= 3.5 cm, centre, first singular vector, extreme
    projections.

    Examples
    --------
    >>> x = np.linspace(-0.1, 0.1, 101)
    >>> rod = np.stack([x, 0 * x, 0 * x + 0.5], axis=1)
    >>> round(measure_m2(rod).length_m, 6)
    0.2
    """
    if not len(box_points_m):
        return Measurement(MethodName.M2, reason=Reason.NO_DEPTH)
    return _principal_chord(align_near(box_points_m, GATE_M), MethodName.M2)


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


_MIN_POINTS = 50


def measure_m3(mask_points_m: NDArray[Any], cloud: AlignedCloud | None = None) -> Measurement:
    """Measure a fruit by the spread of its mask's points along their principal axis.

    Parameters
    ----------
    mask_points_m : ndarray of float, shape (N, 3)
        The mask's pixels with a valid reading, deprojected
        (`measurement.cloud.masked_points`), metres.
    cloud : AlignedCloud, optional
        The same points after the depth gate, if already computed.

    Returns
    -------
    Measurement
        Kind 'surface-chord'; reason 'too-few-points' below 50 valid pixels, where
        the table's method falls back on M2.

    Notes
    -----
    The paper's M3, by its method section: PCA, the gate included. (Its abstract says skeleton.)

    Examples
    --------
    >>> import numpy as np
    >>> x = np.linspace(-0.1, 0.1, 101)
    >>> rod = np.stack([x, 0 * x, 0 * x + 0.5], axis=1)
    >>> round(measure_m3(rod).length_m, 6)
    0.2
    >>> measure_m3(rod[:49]).reason
    <Reason.TOO_FEW_POINTS: 'too-few-points'>
    """
    if len(mask_points_m) < _MIN_POINTS:
        return Measurement(MethodName.M3, reason=Reason.TOO_FEW_POINTS)
    return _principal_chord(cloud or align_near(mask_points_m, GATE_M), MethodName.M3)


def _measure_m2(region: Region) -> Measurement:
    return measure_m2(region.box_points_m)


def m3_or_m2(region: Region) -> Measurement:
    """Measure a fruit by M3, or by M2 in its name below 50 valid pixels."""
    if region.mask_points_m is None:
        return Measurement(MethodName.M3, reason=Reason.NO_MASK)
    result = measure_m3(region.mask_points_m, region.mask_near)
    return result if result.is_direct else or_else(result, MethodName.M2, _measure_m2(region))


METHOD_M2 = TableMethod(
    name="M2",
    title="box PCA",
    kind=LengthKind.SURFACE_CHORD,
    measure=_measure_m2,
    needs=("box",),
    rank=60,
    is_paper=True,
    color="#CC79A7",
)

METHOD_M3 = TableMethod(
    name="M3",
    title="mask PCA",
    kind=LengthKind.SURFACE_CHORD,
    measure=m3_or_m2,
    needs=("mask",),
    rank=40,
    least_points=0,
    is_paper=True,
    stands_in=True,
    color="#E69F00",
)
