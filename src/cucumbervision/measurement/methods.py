"""Run the methods on one fruit, each with its own fallback."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from cucumbervision.geometry.axis import AlignedCloud, align_near
from cucumbervision.measurement.cloud import box_points, masked_points
from cucumbervision.measurement.m1 import measure_m1
from cucumbervision.measurement.m2_m3 import GATE_M, measure_m2, measure_m3
from cucumbervision.measurement.m4 import measure_m4
from cucumbervision.measurement.m5 import measure_m5
from cucumbervision.measurement.m6 import measure_m6
from cucumbervision.measurement.result import Measurement, MethodName, Reason
from cucumbervision.threads import OneThread

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy as np
    from numpy.typing import NDArray

    from cucumbervision.capture.intrinsics import Intrinsics

AVAILABLE = tuple(MethodName)


@dataclass(frozen=True, eq=False)
class Region:
    """The data of one fruit in a frame, with point clouds shared by several methods.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour.
    intrinsics : Intrinsics
        The colour stream's.
    box : ndarray of float, shape (4,)
        Edges x1, y1, x2, y2 in pixels.
    mask : ndarray of bool, shape (H, W), optional
        The fruit's pixels.
    keypoints : ndarray of float, shape (5, 3), optional
        u, v, visibility.
    """

    depth_m: NDArray[np.float32]
    intrinsics: Intrinsics
    box: NDArray[Any]
    mask: NDArray[np.bool_] | None = None
    keypoints: NDArray[np.float64] | None = None

    @cached_property
    def mask_points_m(self) -> NDArray[np.float64] | None:
        """The mask's points in metres, shape (N, 3); None without a mask."""
        if self.mask is None:
            return None
        return masked_points(self.depth_m, self.mask, self.intrinsics)

    @cached_property
    def mask_near(self) -> AlignedCloud | None:
        """The mask's points after the depth gate, with principal axis; None without a mask."""
        points = self.mask_points_m
        return None if points is None else align_near(points, GATE_M)

    @cached_property
    def box_points_m(self) -> NDArray[np.float64]:
        """The box's points at stride 2 in metres, shape (N, 3)."""
        return box_points(self.depth_m, self.box, self.intrinsics)


@OneThread()
def run_methods(
    region: Region, methods: Iterable[MethodName] = AVAILABLE
) -> dict[MethodName, Measurement]:
    """Measure one fruit by each of the methods.

    M3 falls back on M2 below 50 valid pixels, M4 on M3 where an endpoint is missing; such a
    measurement says so in `fallback` and `measured_by`.

    Parameters
    ----------
    region : Region
        The fruit.
    methods : iterable of MethodName
        Methods to run; each is computed once, in the order M1 to M6.

    Returns
    -------
    dict of MethodName to Measurement
        One for each method asked.

    Raises
    ------
    KeyError
        For a method that is not in `AVAILABLE`.

    Examples
    --------
    >>> import numpy as np
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> camera = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    >>> depth = np.full((480, 640), 0.6, np.float32)
    >>> mask = np.zeros((480, 640), bool)
    >>> mask[230:250, 220:420] = True
    >>> region = Region(depth, camera, np.array([219.5, 229.5, 419.5, 249.5]), mask)
    >>> for method, result in run_methods(region).items():
    ...     print(method, result.reason, result.fallback, result.measured_by)
    M1 ok () None
    M2 ok () None
    M3 ok () None
    M4 no-keypoints () None
    M5 ok () None
    M6 ok () None
    """
    chosen = set(methods)
    unknown = chosen - set(AVAILABLE)
    if unknown:
        raise KeyError(f"no such method: {', '.join(sorted(unknown))}")
    return {method: _RUN[method](region) for method in AVAILABLE if method in chosen}


def _m1(region: Region) -> Measurement:
    return measure_m1(region.depth_m, region.box, region.intrinsics)


def _m2(region: Region) -> Measurement:
    return measure_m2(region.box_points_m)


def _m3(region: Region) -> Measurement:
    if region.mask_points_m is None:
        return Measurement(MethodName.M3, reason=Reason.NO_MASK)
    result = measure_m3(region.mask_points_m, region.mask_near)
    return _or_else(result, MethodName.M2, _m2(region)) if not result.is_direct else result


def _m4(region: Region) -> Measurement:
    result = measure_m4(region.depth_m, region.mask, region.keypoints, region.intrinsics)
    if result.reason is Reason.ENDPOINT_MISSING:
        return _or_else(result, MethodName.M3, _m3(region))
    return result


def _m5(region: Region) -> Measurement:
    if region.mask_points_m is None:
        return Measurement(MethodName.M5, reason=Reason.NO_MASK)
    return measure_m5(region.mask_points_m, region.mask_near)


def _m6(region: Region) -> Measurement:
    if region.mask is None:
        return Measurement(MethodName.M6, reason=Reason.NO_MASK)
    return measure_m6(region.depth_m, region.mask, region.intrinsics)


def _or_else(failed: Measurement, method: MethodName, substitute: Measurement) -> Measurement:
    path = (f"{failed.method}:{failed.reason}", *substitute.fallback)
    if substitute.length_m is None:
        return replace(failed, fallback=(*path, f"{method}:{substitute.reason}"))
    return replace(
        substitute,
        method=failed.method,
        fallback=path,
        measured_by=substitute.measured_by or method,
    )


_RUN = dict(zip(AVAILABLE, (_m1, _m2, _m3, _m4, _m5, _m6), strict=True))
