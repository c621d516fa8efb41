"""M2, box PCA, and the principal-axis chord that M3 shares with it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.geometry.axis import depth_gate, principal_axis, project
from cucumbervision.measurement.results import LengthKind, Measurement, Method, Reason

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["GATE_M", "measure_m2", "principal_chord"]

GATE_M = 0.035


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
    return principal_chord(box_points_m, Method.M2)


def principal_chord(points_m: NDArray[Any], method: Method) -> Measurement:
    """Give the chord between the extreme projections on the principal axis, after the gate.

    Parameters
    ----------
    points_m : ndarray of float, shape (N, 3)
        Camera coordinates in metres.
    method : Method
        The method in whose name it measures.

    Returns
    -------
    Measurement
        Kind 'surface-chord'; its path runs along the axis through the centroid.

    Examples
    --------
    >>> points = np.array([[0.0, 0.0, 0.5], [0.3, 0.4, 0.5]])
    >>> round(principal_chord(points, Method.M3).length_m, 6)
    0.5
    """
    if not len(points_m):
        return Measurement(method, reason=Reason.NO_DEPTH)
    near = depth_gate(points_m, GATE_M)
    if len(near) < 2:
        return Measurement(method, reason=Reason.TOO_FEW_POINTS)
    centroid, axis = principal_axis(near)
    along = project(near, centroid, axis)
    low, high = float(along.min()), float(along.max())
    path = centroid + np.array([[low], [high]]) * axis
    return Measurement(method, high - low, LengthKind.SURFACE_CHORD, path_m=path)
