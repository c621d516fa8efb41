"""Pinhole camera with lens distortion: pixels to rays, rays to pixels, points from depth.

The formulas are the RealSense SDK's (`rsutil.h`: `rs2_deproject_pixel_to_point`,
`rs2_project_point_to_pixel`), whose lens models follow Brown (1971) with the coefficients ordered
k1, k2, p1, p2, k3.
"""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["Distortion", "distort", "scale_error", "scale_error_tilted", "undistort"]

_UNDISTORT_STEPS = 10  # as the SDK: more changes nothing at the distortions of a D4xx


class Distortion(StrEnum):
    """Lens models of the RealSense SDK that occur on D4xx colour and aligned streams."""

    NONE = "none"
    BROWN_CONRADY = "brown_conrady"
    MODIFIED_BROWN_CONRADY = "modified_brown_conrady"
    INVERSE_BROWN_CONRADY = "inverse_brown_conrady"


def _brown(
    x: NDArray[Any], y: NDArray[Any], c: Sequence[float], *, scaled_tangential: bool = False
) -> tuple[NDArray[Any], NDArray[Any]]:
    k1, k2, p1, p2, k3 = c
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xr, yr = x * radial, y * radial
    xt, yt = (xr, yr) if scaled_tangential else (x, y)
    return (
        xr + 2 * p1 * xt * yt + p2 * (r2 + 2 * xt * xt),
        yr + 2 * p2 * xt * yt + p1 * (r2 + 2 * yt * yt),
    )


def distort(
    x: NDArray[Any], y: NDArray[Any], model: Distortion, coefficients: Sequence[float]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Give where the lens puts the ray (x, y): the forward model, used to project.

    Parameters
    ----------
    x, y : ndarray
        Normalised image coordinates (x/z, y/z).
    model : Distortion
        The lens model.
    coefficients : sequence of float
        k1, k2, p1, p2, k3.

    Returns
    -------
    x, y : ndarray
        Distorted normalised image coordinates, the shape of the input.

    Examples
    --------
    >>> c = (0.1, 0, 0, 0, 0)
    >>> x, y = distort(np.array([0.5]), np.array([0.0]), Distortion.BROWN_CONRADY, c)
    >>> x.round(4)
    array([0.5125])
    """
    if model is Distortion.NONE:
        return x, y
    return _brown(x, y, coefficients, scaled_tangential=model is not Distortion.BROWN_CONRADY)


def undistort(
    x: NDArray[Any], y: NDArray[Any], model: Distortion, coefficients: Sequence[float]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Give the ray that the lens put at (x, y): the inverse of `distort`, by fixed point.

    Parameters
    ----------
    x, y : ndarray
        Distorted normalised image coordinates.
    model : Distortion
        The lens model.
    coefficients : sequence of float
        k1, k2, p1, p2, k3.

    Returns
    -------
    x, y : ndarray
        Normalised image coordinates (x/z, y/z), the shape of the input.

    Examples
    --------
    >>> c = (0.1, -0.05, 0.001, -0.002, 0.01)
    >>> ray = np.array([0.3]), np.array([-0.2])
    >>> back = undistort(*distort(*ray, Distortion.BROWN_CONRADY, c), Distortion.BROWN_CONRADY, c)
    >>> [float(b[0].round(6)) for b in back]
    [0.3, -0.2]
    """
    if model is Distortion.NONE:
        return x, y
    ux, uy = x, y
    for _ in range(_UNDISTORT_STEPS):
        dx, dy = distort(ux, uy, model, coefficients)
        ux, uy = ux + (x - dx), uy + (y - dy)
    return ux, uy


def scale_error(f_right_px: float, f_wrong_px: float) -> float:
    """Give the relative error of a length across the view, deprojected with a wrong focal length.

    A length's pixels are divided by the focal length, so L'/L - 1 = f_right / f_wrong - 1.

    Examples
    --------
    >>> round(scale_error(910.0, 640.0), 3)
    0.422
    """
    return f_right_px / f_wrong_px - 1.0


def scale_error_tilted(f_right_px: float, f_wrong_px: float, tilt_deg: float) -> float:
    """Give the same error for a fruit tilted towards the camera.

    Depth is unharmed by the focal length, only the part across the view scales by
    k = f_right / f_wrong: L'/L = sqrt(k² cos² t + sin² t).

    Parameters
    ----------
    f_right_px, f_wrong_px : float
        Focal lengths in pixels.
    tilt_deg : float
        Angle between the fruit's axis and the picture plane, degrees.

    Examples
    --------
    >>> round(scale_error_tilted(910.0, 640.0, 90.0), 6)
    0.0
    """
    k, t = f_right_px / f_wrong_px, np.deg2rad(tilt_deg)
    return float(np.sqrt((k * np.cos(t)) ** 2 + np.sin(t) ** 2)) - 1.0
