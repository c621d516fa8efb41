"""Camera intrinsics, and checks against wrong ones.

Pixel convention throughout the project: the centre of the top-left pixel is (0, 0), as in the
RealSense SDK; a box's edges lie half a pixel outside its outermost pixel centres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cucumbervision.arrays import Array, Array32, Numbers
from cucumbervision.capture import DepthAlong as DepthAlong
from cucumbervision.capture import Stream as Stream
from cucumbervision.errors import IntrinsicsError

_SHORTEST_FOCAL, _LONGEST_FOCAL = 0.05, 100.0  # range of focal lengths relative to the longer side
# Maxima: ratio of the focal lengths, distortion coefficient, entry of a camera matrix.
_MOST_ASPECT, _MOST_COEFFICIENT, _MOST_PX = 1.5, 1e3, 1e9
_WIDEST_TANGENT = 20.0  # maximum tangent of a pixel's viewing angle
# A principal point that lies off the middle by the same factor in both directions, within
# `_SAME_FACTOR`, belongs to an image of another size; within `_CENTRED` of 1 cameras vary.
# `_OFF_CENTRE` is a share of the image's size.
_SAME_FACTOR, _CENTRED, _OFF_CENTRE = 0.06, 0.09, 0.06
_LARGEST_FOOTPRINT = 4096.0  # colour pixels of one depth pixel; of a D4xx it is under 100
_UNDISTORT_STEPS = 10  # as the SDK: more changes nothing at the distortions of a D4xx


class Distortion(StrEnum):
    """Lens models of the RealSense SDK that occur on D4xx colour and aligned streams."""

    NONE = "none"
    BROWN_CONRADY = "brown_conrady"
    MODIFIED_BROWN_CONRADY = "modified_brown_conrady"
    INVERSE_BROWN_CONRADY = "inverse_brown_conrady"


def _brown(
    x: Numbers, y: Numbers, c: Sequence[float], *, scaled_tangential: bool = False
) -> tuple[Numbers, Numbers]:
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
    x: Numbers, y: Numbers, model: Distortion, coefficients: Sequence[float]
) -> tuple[Numbers, Numbers]:
    """Apply the lens distortion to the ray (x, y): the forward model, used to project.

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
    x: Numbers, y: Numbers, model: Distortion, coefficients: Sequence[float]
) -> tuple[Numbers, Numbers]:
    """Remove the lens distortion at (x, y): the inverse of `distort`, by fixed point.

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
    >>> distorted = distort(*ray, Distortion.BROWN_CONRADY, c)
    >>> [float(x[0].round(6)) for x in undistort(*distorted, Distortion.BROWN_CONRADY, c)]
    [0.3, -0.2]
    """
    if model is Distortion.NONE:
        return x, y
    ux, uy = x, y
    for _ in range(_UNDISTORT_STEPS):
        dx, dy = distort(ux, uy, model, coefficients)
        ux, uy = ux + (x - dx), uy + (y - dy)
    return ux, uy


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera with optional lens distortion.

    Parameters
    ----------
    width, height : int
        Image size of the calibration, pixels.
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
    def matrix(self) -> Array:
        """The 3x3 camera matrix, float64, pixels."""
        return np.array(
            [[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]]
        )

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.width, self.height

    def rays(self, u_px: ArrayLike, v_px: ArrayLike) -> tuple[Numbers, Numbers]:
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

    def project(self, points_m: ArrayLike) -> Array:
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
    """Check that intrinsics belong to a colour image of a given size.

    Depth aligned to colour needs the intrinsics of the colour camera. Those of another stream or
    size scale every length; the error message states by how much for a fruit across the view:
    f_right / f_wrong - 1. The check uses stream, size and the principal point, which shows the size
    of image that a matrix belongs to; not the value of the focal length.

    Parameters
    ----------
    camera : Intrinsics
        Intrinsics to check.
    width, height : int
        Size of the colour image to which depth is aligned, pixels.
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
    """Refuse a principal point that no camera's image has, or that fits another image size."""
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

    Real colour cameras have it within 4 % of the image's size from the middle. An image that
    was cut out of a larger one may have it anywhere; so does a matrix of another image.

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
    percent = 100 * (right_px / camera.fx_px - 1)
    return (
        f" (fx {right_px:.1f} px): lengths would come out {qualifier}{percent:+.0f} % wrong "
        "(f_right/f_wrong - 1)"
    )


def align_depth_to_color(
    depth_m: Array32,
    depth: Intrinsics,
    color: Intrinsics,
    rotation: ArrayLike,
    translation_m: ArrayLike,
) -> Array32:
    """Align depth to the colour camera's pixels.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres in the depth camera's pixels; 0 for no reading.
    depth, color : Intrinsics
        The two cameras; the result has the size of `color`.
    rotation : array_like, shape (3, 3)
        R of x_color = R x_depth + t, rows first.
    translation_m : array_like, shape (3,)
        t, metres.

    Returns
    -------
    ndarray of float32, shape (color height, color width)
        Metres; 0 where no depth pixel falls. The value is the depth camera's own z, as in the
        SDK: on a D4xx the two cameras' z differ by less than 1 mm.

    Raises
    ------
    ValueError
        If a depth pixel covers thousands of colour pixels: no two cameras are like that.

    Notes
    -----
    The rule of the RealSense SDK's `rs2::align` (`align.cpp`, `sse-align.cpp`): a depth pixel's
    footprint runs from the projection of its corner at -0.5, -0.5 px to that of its corner at
    +0.5, +0.5 px; every colour pixel from the one that holds the first to the one that holds the
    second takes the depth; of several depths the nearest stays. One difference: the SDK's fast
    path ignores the colour camera's lens unless it is `modified_brown_conrady`; here every
    lens model is applied (a D435's colour stream has no distortion).

    Examples
    --------
    >>> depth_m = np.zeros((3, 3), np.float32)
    >>> depth_m[1, 1] = 0.5
    >>> cameras = Intrinsics(3, 3, 10, 10, 1, 1), Intrinsics(4, 3, 6, 6, 1.3, 1.1)
    >>> moved = align_depth_to_color(depth_m, *cameras, np.eye(3), [0.05, 0, 0])
    >>> np.argwhere(moved > 0).tolist()
    [[1, 2]]
    """
    sources = color_sources(depth_m, depth, color, rotation, translation_m)
    return np.where(sources >= 0, depth_m.ravel()[sources], np.float32(0))


def color_sources(
    depth_m: Array32,
    depth: Intrinsics,
    color: Intrinsics,
    rotation: ArrayLike,
    translation_m: ArrayLike,
) -> NDArray[np.int64]:
    """Return the depth pixel that each colour pixel takes its reading from.

    Parameters and errors are those of `align_depth_to_color`.

    Returns
    -------
    ndarray of int64, shape (color height, color width)
        Index into `depth_m.ravel()`; -1 where no depth pixel falls.
    """
    width, height = color.size
    readings = np.flatnonzero(depth_m > 0)
    # From far to near: of several readings of a colour pixel, the last is the nearest.
    readings = readings[np.argsort(-depth_m.ravel()[readings], kind="stable")]
    v, u = np.divmod(readings, depth_m.shape[1])
    z = depth_m.ravel()[readings]

    def corner(off_px: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        x, y = depth.rays(u + off_px, v + off_px)
        moved = np.asarray(rotation, float) @ np.stack([x * z, y * z, z.astype(float)])
        moved += np.reshape(translation_m, (3, 1))
        # Points behind the colour camera have no pixel.
        moved[2] = np.where(moved[2] > 0, moved[2], np.nan)
        # The pixel that holds the point, by the cast that the SDK makes: towards zero.
        pixels = np.trunc(color.project(moved.T) + 0.5)
        px, py = np.nan_to_num(pixels, nan=-9.0).astype(np.int64).T
        return px, py

    (x0, y0), (x1, y1) = corner(-0.5), corner(0.5)
    footprint = [max(float((b - a).max(initial=0)), 0) + 1 for a, b in ((x0, x1), (y0, y1))]
    if math.prod(footprint) > _LARGEST_FOOTPRINT:
        raise ValueError("a depth pixel covers thousands of colour pixels")
    rank, order = np.full(height * width, -1), np.arange(len(readings))
    for dy in range(int((y1 - y0).max(initial=-1)) + 1):
        for dx in range(int((x1 - x0).max(initial=-1)) + 1):
            x, y = x0 + dx, y0 + dy
            part = (x <= x1) & (y <= y1) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
            nearest = np.full(height * width, -1)
            nearest[y[part] * width + x[part]] = order[part]
            np.maximum(rank, nearest, out=rank)
    sources: NDArray[np.int64] = np.append(readings, -1)[rank]
    return sources.reshape(height, width)


MASKS = "mask_visib"
"""Folder of a data set's masks, beside the images of a capture or of a BOP scene."""
