"""RGB-D captures, the fusion of bursts, and the motion within them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import ArrayLike

from cucumbervision.arrays import Array, Array32, Mask, Numbers, Pixels
from cucumbervision.capture.intrinsics import Intrinsics, check_intrinsics, is_off_centre
from cucumbervision.capture.pictures import depth_to_metres
from cucumbervision.capture.pictures import valid_depth as valid_depth
from cucumbervision.errors import CaptureError, DepthError
from cucumbervision.names import checked_name
from cucumbervision.tube.shape import robust_plane

LONGEST_ROW_M = 1000.0


class Doubt(StrEnum):
    """Reasons to doubt the data of a capture; the flags of its fruit have the same names."""

    PRINCIPAL_POINT = "principal-point"
    DEPTH_RESAMPLED = "depth-resampled"
    DEPTH_ALONG_RAY = "depth-along-ray"


@dataclass(frozen=True)
class Stop:
    """Position in the greenhouse of a capture; every field may be unknown."""

    row: str | None = None
    side: str | None = None
    position_m: float | None = None
    step: int | None = None

    def __post_init__(self) -> None:
        """Check its names and position.

        Raises
        ------
        NameRefusedError
            If the row or the side is not a valid name.
        CaptureError
            If the position is farther than any row is long.
        """
        for what, name in (("row", self.row), ("side", self.side)):
            if name is not None:
                object.__setattr__(self, what, checked_name(name, what))
        if self.position_m is not None and not abs(self.position_m) <= LONGEST_ROW_M:
            remedy = "correct the position along the row"
            fault = "no row is as long as {position:g} m"
            raise CaptureError(fault, remedy=remedy, position=self.position_m)


@dataclass(frozen=True, eq=False)
class Capture:
    """An RGB-D frame, or a fused burst, with depth aligned to colour.

    Parameters
    ----------
    color : ndarray of uint8, shape (H, W, 3)
        RGB.
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour; 0 for no reading.
    intrinsics : Intrinsics
        Intrinsics of the colour stream at the image's size.
    name : str
        Name in tables and file names; unique within a source.
    frame : int
        Number in the source: BOP image id, recording frame, index in a burst folder.
    burst_frame : int
        Index within the burst of the frame whose colour was kept.
    burst_size : int
        Number of fused frames.
    moved_px : float
        Motion of the image within the burst, pixels; frames that moved too far were dropped.
    masks : tuple of ndarray of bool, shape (H, W)
        Fruit masks of the data set, if any.
    stop : Stop
        Where it was taken.
    timestamp_s : float, optional
        Seconds since the epoch.
    simulated : bool
        True for rendered captures; shown wherever the capture is.
    source : str
        The file or folder it was read from.
    provenance : mapping
        Further data of the source: camera name, serial number, software.
    gravity : tuple of float, optional
        Direction of gravity in camera coordinates, where the camera's pose is known.
    doubts : tuple of Doubt
        Doubts of the reader about the data.

    Raises
    ------
    CaptureError
        If sizes of colour, depth and masks differ, a dtype is wrong, or gravity has no direction.
    IntrinsicsError
        If the intrinsics belong to another stream or size of image.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> capture = Capture(
    ...     np.zeros((48, 64, 3), np.uint8),
    ...     np.full((48, 64), 0.5, np.float32),
    ...     Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0),
    ...     name="a",
    ... )
    >>> capture.width, capture.height, capture.fill
    (64, 48, 1.0)
    """

    color: Pixels
    depth_m: Array32
    intrinsics: Intrinsics
    name: str
    frame: int = 0
    burst_frame: int = 0
    burst_size: int = 1
    moved_px: float = 0.0
    masks: tuple[Mask, ...] = ()
    stop: Stop = field(default_factory=Stop)
    timestamp_s: float | None = None
    simulated: bool = False
    source: str = ""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    gravity: tuple[float, float, float] | None = None
    doubts: tuple[Doubt, ...] = ()

    def __repr__(self) -> str:
        return f"<Capture {self.name}: {self.width}x{self.height}>"

    def __post_init__(self) -> None:
        source, color, depth_m = self.source or self.name, self.color, self.depth_m
        if color.ndim != 3 or color.shape[2] != 3 or color.dtype != np.uint8:
            fault = f"colour is {color.dtype} {color.shape}, not uint8 (H, W, 3)"
            raise CaptureError(fault, source=source, remedy="give an 8-bit RGB picture")
        if depth_m.ndim != 2 or depth_m.dtype != np.float32:
            fault = f"depth is {depth_m.dtype} {depth_m.shape}, not float32 (H, W) in metres"
            raise DepthError(fault, source=source, remedy="give one depth value a pixel")
        masks = {f"mask {i}": m.shape for i, m in enumerate(self.masks)}
        sizes = {"colour": color.shape[:2], "depth": depth_m.shape, **masks}
        if len(set(sizes.values())) > 1:
            fault = "sizes differ: " + ", ".join(f"{k} {s[1]}x{s[0]}" for k, s in sizes.items())
            remedy = "align depth to colour, and give masks of the picture's own size"
            raise CaptureError(fault, source=source, remedy=remedy)
        if self.gravity is not None and not 0 < np.linalg.norm(self.gravity) < np.inf:
            fault = f"gravity {tuple(self.gravity)} is no direction"
            remedy = "give it in camera coordinates, or leave it out"
            raise CaptureError(fault, source=source, remedy=remedy)
        check_intrinsics(self.intrinsics, self.width, self.height, source=source)
        signs = {
            Doubt.PRINCIPAL_POINT: is_off_centre(self.intrinsics),
            Doubt.DEPTH_ALONG_RAY: is_along_ray(self.depth_m, self.intrinsics),
        }
        doubts = [doubt for doubt in self.doubts if doubt not in signs]
        doubts += [doubt for doubt, is_shown in signs.items() if is_shown]
        object.__setattr__(self, "doubts", tuple(doubts))

    @classmethod
    def from_arrays(
        cls,
        color: Pixels,
        depth: Numbers,
        intrinsics: Intrinsics | ArrayLike,
        *,
        depth_unit_m: float | None = None,
        name: str = "arrays",
    ) -> Self:
        """Create a capture from arrays of other programs.

        Parameters
        ----------
        color : ndarray of uint8, shape (H, W, 3)
            RGB.
        depth : ndarray, shape (H, W)
            Aligned to colour, one value per pixel; 0 or NaN for no reading.
        intrinsics : Intrinsics or array_like, shape (3, 3)
            The colour camera's, or its matrix in pixels.
        depth_unit_m : float, optional
            Metres of one step of depth; by default 0.001 for whole numbers and 1 for floating
            point.
        name : str
            Name of the capture.

        Raises
        ------
        CaptureError
            If the arrays do not fit each other.
        DepthError
            If depth has 8 bits, or its unit is not the declared one.
        IntrinsicsError
            If the matrix is not a camera matrix, or belongs to another image size.

        Examples
        --------
        >>> depth_mm = np.full((48, 64), 500, np.uint16)
        >>> matrix = [[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]
        >>> capture = Capture.from_arrays(np.zeros((48, 64, 3), np.uint8), depth_mm, matrix)
        >>> float(capture.depth_m[0, 0]), capture.intrinsics.fx_px
        (0.5, 60.0)
        """
        raw = np.ma.filled(depth, 0)  # pixels that a masked array leaves out are no readings
        depth_m = depth_to_metres(np.asarray(raw), depth_unit_m, source=name)
        if not isinstance(intrinsics, Intrinsics):
            height, width = color.shape[:2]
            intrinsics = Intrinsics.from_matrix(intrinsics, width, height)
        return cls(np.ascontiguousarray(color), depth_m, intrinsics, name)

    @property
    def width(self) -> int:
        """Width in pixels."""
        return int(self.depth_m.shape[1])

    @property
    def height(self) -> int:
        """Height in pixels."""
        return int(self.depth_m.shape[0])

    @property
    def fill(self) -> float:
        """Share of pixels with a valid depth reading, 0 to 1."""
        return float(valid_depth(self.depth_m).mean())


@dataclass(frozen=True, eq=False)
class FusedBurst:
    """Result of fusing a burst.

    Parameters
    ----------
    color : ndarray of uint8, shape (H, W, 3)
        The sharpest image, the first of equally sharp ones.
    depth_m : ndarray of float32, shape (H, W)
        `median_depth` of the frames without motion relative to `color`.
    burst_frame : int
        Index of `color` in the burst.
    burst_size : int
        Number of frames in `depth_m`; 1 if the camera moved too fast.
    moved_px : float
        Motion within the burst, pixels; see `motion.moved_px`.
    """

    color: Pixels
    depth_m: Array32
    burst_frame: int = 0
    burst_size: int = 1
    moved_px: float = 0.0


def fuse_burst(colors: Sequence[Pixels], depths_m: Sequence[Array32]) -> FusedBurst:
    """Fuse a burst to one frame, without frames that moved too far.

    Parameters
    ----------
    colors : sequence of ndarray of uint8, shape (H, W, 3)
        RGB images.
    depths_m : sequence of ndarray of float32, shape (H, W)
        Depth in metres, aligned to colour, one per colour image.

    Raises
    ------
    CaptureError
        If the burst is empty, or numbers or sizes of the images differ.

    Examples
    --------
    >>> grey = np.full((4, 4, 3), 90, np.uint8)
    >>> edge = grey.copy()
    >>> edge[:, 2:] = 200
    >>> depths = [np.full((4, 4), z, np.float32) for z in (0.5, 0.0, 0.75)]
    >>> fused = fuse_burst([grey, edge, grey], depths)
    >>> fused.burst_frame, fused.burst_size, float(fused.depth_m[0, 0])
    (1, 3, 0.625)
    """
    sizes = {c.shape[:2] for c in colors} | {d.shape for d in depths_m}
    if not colors or len(colors) != len(depths_m) or len(sizes) != 1:
        text = ", ".join(sorted(f"{s[1]}x{s[0]}" for s in sizes))
        raise CaptureError(
            f"a burst of {len(colors)} colour and {len(depths_m)} depth pictures"
            f"{' of sizes ' + text if text else ''} is not a burst",
            remedy="give as many depth as colour pictures, all of one size",
        )
    if len(colors) == 1:
        return FusedBurst(colors[0], median_depth(depths_m))
    best = int(np.argmax([sharpness(c) for c in colors]))
    moved = moved_px(colors[best], [*colors[:best], *colors[best + 1 :]])
    moved.insert(best, 0.0)
    still = [d for d, by in zip(depths_m, moved, strict=True) if by <= still_px(colors[best])]
    return FusedBurst(
        color=colors[best],
        depth_m=median_depth(still),
        burst_frame=best,
        burst_size=len(still),
        moved_px=max(moved),
    )


def sharpness(color: Pixels) -> float:
    """Return the sharpness of an image, the variance of the Laplacian of its grey values.

    Source: Pech-Pacheco et al. (2000), "Diatom autofocusing in brightfield microscopy".

    Parameters
    ----------
    color : ndarray of uint8, shape (H, W, 3)
        RGB.

    Examples
    --------
    >>> sharpness(np.full((8, 8, 3), 90, np.uint8))
    0.0
    """
    grey = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    _, deviation = cv2.meanStdDev(cv2.Laplacian(grey, cv2.CV_16S))
    return float(np.ravel(deviation)[0] ** 2)


def median_depth(depths_m: Sequence[Array32]) -> Array32:
    """Return the median of the valid readings (0.1 to 5 m) of each pixel.

    Parameters
    ----------
    depths_m : sequence of ndarray of float32, shape (H, W)
        Depth in metres; at least one.

    Returns
    -------
    ndarray of float32, shape (H, W)
        Metres; 0 if no frame has a valid reading.

    Examples
    --------
    >>> frames = [np.full((1, 1), z, np.float32) for z in (0.5, 0.0, 0.75, 9.0, 0.625)]
    >>> float(median_depth(frames)[0, 0])
    0.625
    """
    valid = [valid_depth(depth) for depth in depths_m]
    planes = [np.where(v, d, np.float32(np.inf)) for v, d in zip(valid, depths_m, strict=True)]
    spare = np.empty_like(planes[0])
    # Odd-even transposition by whole planes is several times faster than sorting each pixel.
    for turn in range(len(planes)):
        for i in range(turn % 2, len(planes) - 1, 2):
            np.minimum(planes[i], planes[i + 1], out=spare)
            np.maximum(planes[i], planes[i + 1], out=planes[i + 1])
            planes[i], spare = spare, planes[i]
    counts, depth_m = np.sum(valid, axis=0, dtype=np.uint16), np.zeros_like(spare)
    for n in range(1, len(planes) + 1):
        lower, upper = planes[(n - 1) // 2], planes[n // 2]
        value = lower if lower is upper else (lower + upper) / np.float32(2)
        np.copyto(depth_m, value, where=counts == n)
    return depth_m


_STILL_SHARE = 1 / 250  # of the width: 3 px of 848, up to which fused lengths are correct
_WIDTH_PX = 320
_CORNERS, _LEAST_CORNERS = 100, 8
_CORNER_STRENGTH = 5e-5  # twenty times the noise on a plain wall
_WEAKEST_CORNER = 0.02  # minimum corner strength relative to the strongest
_THERE_AND_BACK_PX = 0.5
_MOTION_QUANTILE = 0.9  # quantile of the corners, so that swinging or near fruit do not dominate


def moved_px(reference: Pixels, pictures: Sequence[Pixels]) -> list[float]:
    """Return the motion between a reference frame and each other frame.

    Corners of the reference are tracked forward and backward (Lucas and Kanade).

    Parameters
    ----------
    reference : ndarray of uint8, shape (H, W, 3)
        RGB.
    pictures : sequence of ndarray of uint8, shape (H, W, 3)
        Frames of the same camera.

    Returns
    -------
    list of float
        The 90 % quantile of the corners' motion, pixels; infinity if most corners are lost, and 0
        if the image has too few corners.

    Examples
    --------
    >>> import cv2
    >>> blots = np.random.default_rng(1).integers(0, 255, (30, 40, 3), np.uint8)
    >>> leaf = cv2.resize(blots, (640, 480))
    >>> [round(x) for x in moved_px(leaf, [leaf, np.roll(leaf, 12, axis=1)])]
    [0, 12]
    """
    first, scale = _small_grey(reference)
    strongest = float(np.max(cv2.cornerMinEigenVal(first, 5)))
    if strongest < _CORNER_STRENGTH:
        return [0.0] * len(pictures)
    level = max(_CORNER_STRENGTH / strongest, _WEAKEST_CORNER)
    features = cv2.goodFeaturesToTrack(first, _CORNERS, level, 5, blockSize=5)
    if np.size(features) < 2 * _LEAST_CORNERS:  # None where all lie at the border
        return [0.0] * len(pictures)
    corners, first = np.asarray(features, np.float32).reshape(-1, 2), _levelled(first)
    return [
        scale * _moved(first, _levelled(_small_grey(picture)[0]), corners) for picture in pictures
    ]


def still_px(color: Pixels) -> float:
    """Return the maximum motion that counts as still for this image size, pixels.

    Examples
    --------
    >>> still_px(np.zeros((720, 1250, 3), np.uint8))
    5.0
    """
    return float(_STILL_SHARE * color.shape[1])


def _moved(first: Pixels, second: Pixels, corners: Array32) -> float:
    # OpenCV writes into the last argument if it is given.
    buffers = np.zeros((2, *corners.shape), np.float32)
    moved, forward_status, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, buffers[0])
    returned, backward_status, _ = cv2.calcOpticalFlowPyrLK(second, first, moved, buffers[1])
    same = np.linalg.norm(np.asarray(returned) - corners, axis=1) < _THERE_AND_BACK_PX
    same &= (np.ravel(forward_status) == 1) & (np.ravel(backward_status) == 1)
    if np.count_nonzero(same) < len(corners) / 2:
        return float("inf")
    by = np.linalg.norm(np.asarray(moved) - corners, axis=1)[same]
    return float(np.quantile(by, _MOTION_QUANTILE))


def _levelled(grey: Pixels) -> Pixels:
    """Normalise brightness and contrast, because exposure adapts between frames."""
    off = grey - np.float32(grey.mean())
    spread = max(float(off.std()), 1.0)
    return np.asarray(np.clip(128 + off * np.float32(40 / spread), 0, 255), np.uint8)


def _small_grey(color: Pixels) -> tuple[Pixels, float]:
    """Return a downscaled grey image and its scale factor."""
    grey = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    scale = max(grey.shape[1] / _WIDTH_PX, 1.0)
    size = round(grey.shape[1] / scale), max(round(grey.shape[0] / scale), 1)
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA) if scale > 1 else grey
    return np.asarray(cv2.GaussianBlur(small, (3, 3), 0), np.uint8), scale


_PLANE_SAMPLES, _LEAST_PLANE_SAMPLES = 800, 100
_ON_PLANE = 0.01  # of the distance
# Real boards and tables hold 0.47 to 0.94 of the readings, and 0.11 to 0.18 read the other way;
# images between plants hold 0.01 to 0.12 both ways.
_LEAST_PLANE_SHARE, _CLEARLY = 0.4, 2.5


def depth_along_axis(depth_m: Array32, camera: Intrinsics) -> Array32:
    """Return depth along the optical axis, of distances along each pixel's ray.

    Simulators and laser scanners write the distance to the camera's centre; depth cameras write
    the coordinate z. They differ by the factor sqrt(1 + x^2 + y^2) of the pixel's ray (x, y, 1).

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Distances from the camera's centre, metres; 0 for no reading.
    camera : Intrinsics
        The camera of the depth image, of size (W, H).

    Returns
    -------
    ndarray of float32, shape (H, W)
        Metres.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> distance_m = np.full((1, 3), 1.25, np.float32)
    >>> depth_along_axis(distance_m, Intrinsics(3, 1, 4.0, 4.0, -2.0, 0.0))[0, 1]
    np.float32(1.0)
    """
    height, width = depth_m.shape
    x, y = camera.rays(np.arange(width)[None, :], np.arange(height)[:, None])
    axial_m: Array32 = (depth_m / np.sqrt(1.0 + x**2 + y**2)).astype(np.float32)
    return axial_m


def is_along_ray(depth_m: Array32, camera: Intrinsics) -> bool:
    """Return whether depth shows a plane only if it is taken for distances along each pixel's ray.

    Most images of fruit on a table, a board or before a wall show a plane. Read along the wrong
    direction it is a bowl. Without a plane over much of the image, as between plants, or in a
    narrow view the direction cannot be determined.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres, as for the optical axis; 0 for no reading.
    camera : Intrinsics
        The camera, of size (W, H).

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> camera = Intrinsics(64, 48, 45.0, 45.0, 31.5, 23.5)
    >>> x, y = camera.rays(np.arange(64)[None, :], np.arange(48)[:, None])
    >>> wall_m = np.full((48, 64), 0.9, np.float32)
    >>> is_along_ray(wall_m, camera), is_along_ray(wall_m * np.sqrt(1 + x**2 + y**2), camera)
    (False, True)
    """
    height, width = depth_m.shape
    step = max(1, int(np.sqrt(height * width / _PLANE_SAMPLES)))
    rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    samples_m = depth_m[rows, columns]
    x, y = camera.rays(columns, rows)
    is_read = (samples_m > 0) & np.isfinite(samples_m + x + y)
    if np.count_nonzero(is_read) < _LEAST_PLANE_SAMPLES:
        return False
    x, y, axial_m = x[is_read], y[is_read], samples_m[is_read].astype(np.float64)
    terms = np.column_stack([x, y, np.ones(len(x))])
    by_axis = _plane_share(terms, axial_m)
    if by_axis >= _LEAST_PLANE_SHARE:
        return False
    by_ray = _plane_share(terms, axial_m / np.sqrt(1.0 + x**2 + y**2))
    return by_ray >= max(_LEAST_PLANE_SHARE, _CLEARLY * by_axis)


def _plane_share(terms: Array, depth_m: Array) -> float:
    """Return the share of readings on the plane along which most of them lie."""
    off = robust_plane(terms, 1 / depth_m, depth_m, _ON_PLANE / 4)[1]
    return float(np.mean(off < _ON_PLANE))
