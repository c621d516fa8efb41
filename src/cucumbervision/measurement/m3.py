"""M3, mask PCA: M2's geometry on the mask's pixels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from cucumbervision.geometry.axis import AlignedCloud, align_near
from cucumbervision.measurement.m2 import GATE_M, principal_chord
from cucumbervision.measurement.result import Measurement, Method, Reason

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["MIN_POINTS", "measure_m3"]

MIN_POINTS = 50


def measure_m3(mask_points_m: NDArray[Any], near: AlignedCloud | None = None) -> Measurement:
    """Measure a fruit by the spread of its mask's points along their principal axis.

    Parameters
    ----------
    mask_points_m : ndarray of float, shape (N, 3)
        The mask's pixels with a valid reading, deprojected
        (`measurement.cloud.masked_points`), metres.
    near : AlignedCloud, optional
        The same points behind the gate, where that is known already.

    Returns
    -------
    Measurement
        Kind 'surface-chord'; reason 'too-few-points' below 50 valid pixels, where
        `measurement.methods` falls back on M2.

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
    if len(mask_points_m) < MIN_POINTS:
        return Measurement(Method.M3, reason=Reason.TOO_FEW_POINTS)
    return principal_chord(near or align_near(mask_points_m, GATE_M), Method.M3)
