"""Camera intrinsics, and checks against wrong ones.

Pixel convention throughout the project: the centre of the top-left pixel is (0, 0), as in the
RealSense SDK; a box's edges lie half a pixel outside its outermost pixel centres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture import DepthAlong as DepthAlong
from cucumbervision.capture import Stream as Stream
from cucumbervision.errors import IntrinsicsError
from cucumbervision.tube.camera import Distortion as Distortion
from cucumbervision.tube.camera import distort, scale_error, undistort

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


_SHORTEST_FOCAL, _LONGEST_FOCAL = 0.05, 100.0  # range of focal lengths relative to the longer side
# Maxima: ratio of the focal lengths, distortion coefficient, entry of a camera matrix.
_MOST_ASPECT, _MOST_COEFFICIENT, _MOST_PX = 1.5, 1e3, 1e9
_WIDEST_TANGENT = 20.0  # maximum tangent of a pixel's viewing angle
# A principal point that lies off the middle by the same factor in both directions, within
# `_SAME_FACTOR`, belongs to a picture of another size; within `_CENTRED` of 1 cameras vary.
# `_OFF_CENTRE` is a share of the picture's size.
_SAME_FACTOR, _CENTRED, _OFF_CENTRE = 0.06, 0.09, 0.06


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera with optional lens distortion.

    Parameters
    ----------
    width, height : int
        Picture size of the calibration, pixels.
    fx_px, fy_px : float
        Focal lengths in pixels.
    cx_px, cy_px : float
        Principal point in pixels; the centre of the top-left pixel is (0, 0).
    stream : Stream
        Stream of the calibration. Depth aligned to colour needs the intrinsics of the colour
        stream.
    distortion : Distortion
        The lens model of `coefficients`.
    coefficients : tuple of float
        k1, k2, p1, p2, k3 in the order of the RealSense SDK.

    Raises
    ------
    IntrinsicsError
        If a size or focal length is not positive and finite.

    Examples
    --------
    >>> Intrinsics(1280, 720, 910.2, 910.4, 642.8, 358.5).matrix.round(1)
    array([[910.2,   0. , 642.8],
           [  0. , 910.4, 358.5],
           [  0. ,   0. ,   1. ]])
    """

    width: int
    height: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    stream: Stream = Stream.COLOR
    distortion: Distortion = Distortion.NONE
    coefficients: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        focal, longest = (self.fx_px, self.fy_px), max(self.width, self.height)
        numbers = (*focal, self.cx_px, self.cy_px, *self.coefficients)
        size = f"{self.width}x{self.height}"
        if not np.isfinite(numbers).all() or min(focal) <= 0:
            fault = (
                f"focal length {self.fx_px}, {self.fy_px} px and centre {self.cx_px}, "
                f"{self.cy_px} px do not describe a camera"
            )
            remedy = "give fx, fy, cx, cy in pixels, all finite, the focal lengths positive"
        elif min(self.width, self.height) <= 0 or longest >= 2**31:
            fault = f"size {size} is not a picture size"
            remedy = "give the width and height in pixels that the calibration is for"
        elif (
            min(focal) < _SHORTEST_FOCAL * longest
            or max(focal) > _LONGEST_FOCAL * longest
            or max(focal) >= _MOST_ASPECT * min(focal)
            or max(map(abs, self.coefficients)) > _MOST_COEFFICIENT
        ):
            fault = (
                f"no camera of {size} pixels has focal lengths of {self.fx_px:g} and "
                f"{self.fy_px:g} px and distortion {self.coefficients}"
            )
            remedy = "give the values in pixels that belong to this size of picture"
        else:
            return
        raise IntrinsicsError(fault, remedy=remedy)

    @classmethod
    def from_matrix(
        cls, matrix: ArrayLike, width: int, height: int, stream: Stream = Stream.COLOR
    ) -> Intrinsics:
        """Create intrinsics from a 3x3 camera matrix in pixels, without distortion.

        Raises
        ------
        IntrinsicsError
            If `matrix` is not 3x3 with last row 0, 0, 1 and without skew.
        """
        return cls(width, height, *pinhole_of_matrix(matrix), stream)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The 3x3 camera matrix, float64, pixels."""
        return np.array(
            [[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]]
        )

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.width, self.height

    def rays(self, u_px: ArrayLike, v_px: ArrayLike) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the undistorted ray (x/z, y/z) of each pixel.

        Parameters
        ----------
        u_px, v_px : array_like
            Pixel coordinates, any shape, broadcast against each other.

        Returns
        -------
        x, y : ndarray
            Normalised image coordinates, float32 for float32 input and float64 otherwise.

        Notes
        -----
        The RealSense SDK's `rs2_deproject_pixel_to_point`, vectorised.

        Examples
        --------
        >>> x, y = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0).rays(380.0, 240.0)
        >>> float(x), float(y)
        (0.1, 0.0)
        """
        u, v = np.asarray(u_px), np.asarray(v_px)
        dtype = np.float32 if u.dtype == v.dtype == np.float32 else np.float64
        x = ((u - self.cx_px) / self.fx_px).astype(dtype)
        y = ((v - self.cy_px) / self.fy_px).astype(dtype)
        if self.distortion is Distortion.NONE or not any(self.coefficients):
            return x, y
        return undistort(x, y, self.distortion, self.coefficients)

    def project(self, points_m: ArrayLike) -> NDArray[np.float64]:
        """Project points to pixels, including lens distortion.

        Parameters
        ----------
        points_m : array_like of float, shape (N, 3)
            Points in front of the camera, camera coordinates, metres.

        Returns
        -------
        ndarray of float64, shape (N, 2)
            u, v in pixels.

        Notes
        -----
        The RealSense SDK's `rs2_project_point_to_pixel`, vectorised.

        Examples
        --------
        >>> Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0).project([[0.1, 0.0, 0.5]]).tolist()
        [[440.0, 240.0]]
        """
        points = np.asarray(points_m, dtype=np.float64)
        x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
        x, y = distort(x, y, self.distortion, self.coefficients)
        return np.stack([x * self.fx_px + self.cx_px, y * self.fy_px + self.cy_px], axis=1)


def pinhole_of_matrix(matrix: ArrayLike) -> tuple[float, float, float, float]:
    """Return fx, fy, cx and cy of a 3x3 camera matrix, or of its nine values in row-major order.

    Raises
    ------
    IntrinsicsError
        If it is not 3x3 with last row 0, 0, 1 and without skew.
    """
    try:
        k = np.asarray(matrix, dtype=float).reshape(3, 3)
    except (ValueError, TypeError, OverflowError):
        k = np.zeros((3, 3))
    pixels = bool((np.abs(k) < _MOST_PX).all())  # False for NaN
    form = pixels and np.allclose(k[2], (0, 0, 1)) and not k[0, 1] and not k[1, 0]
    if not form:
        fault = "the camera matrix is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
        remedy = "give the 3x3 matrix row by row, in pixels, without skew"
        raise IntrinsicsError(fault, remedy=remedy)
    fx, fy, cx, cy = k[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return fx, fy, cx, cy


def check_intrinsics(
    camera: Intrinsics,
    width: int,
    height: int,
    *,
    color: Intrinsics | None = None,
    source: object = None,
) -> Intrinsics:
    """Check that intrinsics belong to a colour picture of a given size.

    Depth aligned to colour needs the intrinsics of the colour camera. Those of another stream or
    size scale every length; the error message states by how much for a fruit across the view:
    f_right / f_wrong - 1. The check uses stream, size and the principal point, which shows the size
    of picture that a matrix belongs to; not the value of the focal length.

    Parameters
    ----------
    camera : Intrinsics
        Intrinsics to check.
    width, height : int
        Size of the colour picture to which depth is aligned, pixels.
    color : Intrinsics, optional
        Colour intrinsics of the capture, if known.
    source : object, optional
        The file, for error messages.

    Returns
    -------
    Intrinsics
        `given`, unchanged.

    Raises
    ------
    IntrinsicsError
        If the intrinsics do not match, with the scale error that they would cause.

    Examples
    --------
    >>> colour = Intrinsics(1280, 720, 927.2, 927.4, 651.3, 349.6)
    >>> depth = Intrinsics(1280, 720, 640.0, 640.0, 640.0, 360.0, stream=Stream.DEPTH)
    >>> check_intrinsics(depth, 1280, 720, color=colour)
    Traceback (most recent call last):
    ...
    cucumbervision.errors.IntrinsicsError: these are the depth stream's ... +45 % wrong ...
    """
    right_px = color.fx_px if color is not None and color.size == (width, height) else None
    if camera.stream is not Stream.COLOR:
        raise IntrinsicsError(
            "these are the {stream} stream's intrinsics (fx {fx:.1f} px), but the depth is "
            "aligned to colour{wrong}",
            source=source,
            remedy="give the colour stream's intrinsics; or, if the colour picture was "
            "aligned to depth, say so with --aligned-to depth",
            stream=camera.stream,
            fx=camera.fx_px,
            wrong=_wrong_by(camera, right_px),
        )
    if camera.size != (width, height):
        # RealSense colour modes keep the full height and crop the sides, so if the aspect ratio
        # differs, the height gives the scale (640x480 with f 616 becomes 1280x720 with f 924).
        estimate_px = right_px or camera.fx_px * height / camera.height
        qualifier = "" if right_px else "about "
        raise IntrinsicsError(
            "the intrinsics are for {camera}, the picture is {picture}{wrong}",
            source=source,
            remedy="give the colour stream's intrinsics at {picture}",
            camera=f"{camera.width}x{camera.height}",
            picture=f"{width}x{height}",
            wrong=_wrong_by(camera, estimate_px, qualifier),
        )
    _check_principal_point(camera, source)
    with np.errstate(all="ignore"):
        corners = camera.rays(
            np.array([0.0, width, 0.0, width]), np.array([0.0, 0.0, height, height])
        )
    if not (np.abs(corners) <= _WIDEST_TANGENT).all():
        raise IntrinsicsError(
            "the lens distortion {coefficients} cannot be undone in the picture's corners",
            source=source,
            remedy="give k1, k2, p1, p2, k3 of this camera",
            coefficients=camera.coefficients,
        )
    return camera


def _check_principal_point(camera: Intrinsics, source: object) -> None:
    """Refuse a principal point that no camera's picture has, or that fits another picture size."""
    width, height = camera.size
    centre = {"cx": camera.cx_px, "cy": camera.cy_px}
    across, down = 2 * camera.cx_px / width, 2 * camera.cy_px / height
    factor = math.sqrt(max(across * down, 0.0))
    is_scaled = min(across, down) > 0 and abs(across - down) <= _SAME_FACTOR * factor
    if is_scaled and abs(factor - 1) > _CENTRED:
        raise IntrinsicsError(
            "the principal point {cx:g}, {cy:g} px is the middle of a picture of "
            "about {size}, {factor:.2g} times as large as {picture}: lengths would come "
            "out about {percent:+.0f} % wrong",
            source=source,
            remedy="divide fx, fy, cx, cy by {factor:.2g}, or give the calibration of this size",
            **centre,
            size=f"{width * factor:.0f}x{height * factor:.0f}",
            factor=factor,
            picture=f"{width}x{height}",
            percent=100 * (1 / factor - 1),
        )
    if not (0 <= camera.cx_px <= width and 0 <= camera.cy_px <= height):
        raise IntrinsicsError(
            "the principal point {cx:g}, {cy:g} px is outside the picture of {size}",
            source=source,
            remedy="give cx and cy in pixels of this picture",
            **centre,
            size=f"{width}x{height}",
        )


def is_off_centre(intrinsics: Intrinsics) -> bool:
    """Return whether the principal point lies where cameras do not have it, but a cut-out may.

    Real colour cameras have it within 4 % of the picture's size from the middle. A picture that
    was cut out of a larger one may have it anywhere; so does a matrix of another picture.

    Examples
    --------
    >>> is_off_centre(Intrinsics(1280, 720, 910.2, 910.4, 642.8, 358.5))
    False
    >>> is_off_centre(Intrinsics(1280, 720, 910.2, 910.4, 900.0, 358.5))
    True
    """
    across, down = intrinsics.cx_px / intrinsics.width, intrinsics.cy_px / intrinsics.height
    return max(abs(across - 0.5), abs(down - 0.5)) > _OFF_CENTRE


def _wrong_by(camera: Intrinsics, right_px: float | None, qualifier: str = "") -> str:
    if right_px is None:
        return (
            "; by how much lengths would be wrong cannot be said without the colour calibration "
            "(f_right/f_wrong - 1; about +42 % on a typical D435 at 1280x720)"
        )
    percent = 100 * scale_error(right_px, camera.fx_px)
    return (
        f" (fx {right_px:.1f} px): lengths would come out {qualifier}{percent:+.0f} % wrong "
        "(f_right/f_wrong - 1)"
    )


MASKS = "mask_visib"
"""Folder of a data set's masks, beside the pictures of a capture or of a BOP scene."""
