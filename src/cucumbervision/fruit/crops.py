"""Crops of the image for the networks that look at a fruit and at its ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cucumbervision.arrays import Array, Array32, Ints, Mask, Pixels
from cucumbervision.capture.frames import valid_depth
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.masks import distances_inside, mask_pixels, mask_window
from cucumbervision.tube.shape import arc_positions

HEIGHT_PX, WIDTH_PX = 112, 256
"""Size of a crop."""

_ALONG, _ACROSS = 1.45, 1.6  # the crop's sides, in extents of the mask
_LEAST_STEP_PX = 0.25  # of the image: a smaller fruit fills less of the crop


@dataclass(frozen=True, eq=False)
class FruitCrop:
    """The image around one detected fruit.

    Parameters
    ----------
    planes : ndarray of uint8, shape (HEIGHT_PX, WIDTH_PX, 6)
        As `crop_planes` returns them. The mask's longer axis is horizontal.
    middle_px : ndarray of float64, shape (2,)
        u, v of the crop's middle in the image.
    along : ndarray of float64, shape (2,)
        Unit vector of the crop's rows in the image.
    step_px : float
        Image pixels of a crop pixel.
    """

    planes: Pixels
    middle_px: Array
    along: Array
    step_px: float

    @property
    def axes(self) -> Array:
        """The crop's two directions in the image, as rows of a matrix, of one crop pixel each."""
        return self.step_px * np.array([self.along, [-self.along[1], self.along[0]]])

    def to_picture(self, points: Array) -> Array:
        """Convert points of the crop to image pixels, both of shape (N, 2).

        Examples
        --------
        >>> planes = np.zeros((HEIGHT_PX, WIDTH_PX, 6), np.uint8)
        >>> crop = FruitCrop(planes, np.array([50.0, 40.0]), np.array([0.0, 1.0]), 2.0)
        >>> crop.to_picture(np.array([[(WIDTH_PX - 1) / 2 + 3, (HEIGHT_PX - 1) / 2]])).tolist()
        [[50.0, 46.0]]
        """
        return np.asarray((points - _MIDDLE) @ self.axes + self.middle_px)

    def to_crop(self, points_px: Array) -> Array:
        """Convert image pixels to points of the crop, both of shape (N, 2)."""
        inverse = self.axes.T / self.step_px**2
        return np.asarray((points_px - self.middle_px) @ inverse + _MIDDLE)

    def mask_in_picture(self, log_odds: Array32, shape: tuple[int, int]) -> Mask:
        """Return the image's pixels at which log-odds given for the crop's pixels are positive.

        Parameters
        ----------
        log_odds : ndarray of float32, shape (HEIGHT_PX, WIDTH_PX)
            Interpolated linearly between the crop's pixels.
        shape : tuple of int
            Height and width of the image.
        """
        import cv2

        inverse = self.axes.T / self.step_px**2
        offset = _MIDDLE - self.middle_px @ inverse
        warped = cv2.warpAffine(
            np.ascontiguousarray(log_odds, np.float32),
            np.column_stack([inverse.T, offset]),
            shape[::-1],
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=-1.0,
        )
        return np.asarray(warped > 0)


_MIDDLE = np.array([(WIDTH_PX - 1) / 2, (HEIGHT_PX - 1) / 2])


def fruit_crop(
    color_rgb: Pixels,
    depth_m: Array32 | None,
    mask: Mask,
    focal_px: float | None,
    size_px: tuple[int, int] = (HEIGHT_PX, WIDTH_PX),
) -> FruitCrop | None:
    """Cut out the image around one mask.

    Parameters
    ----------
    color_rgb : ndarray of uint8, shape (H, W, 3)
        The image.
    depth_m : ndarray of float32, shape (H, W), optional
        Metres, aligned to colour; 0 for no reading.
    mask : ndarray of bool, shape (H, W)
        The fruit's pixels, of a detector.
    focal_px : float, optional
        Focal length of the colour camera, pixels; without it depth is not shown.
    size_px : tuple of int
        Height and width of the crop; a larger one shows more at the same scale.

    Returns
    -------
    FruitCrop or None
        None for an empty mask.

    Examples
    --------
    >>> mask = np.zeros((480, 640), bool)
    >>> mask[200:300, 300:324] = True
    >>> color = np.where(mask[..., None], (40, 140, 40), (90, 90, 90)).astype(np.uint8)
    >>> crop = fruit_crop(color, None, mask, None)
    >>> crop.middle_px.round(1).tolist(), round(crop.step_px, 2)
    ([311.5, 249.5], 0.57)
    """
    window = mask_window(mask, 1)
    if window is None:
        return None
    middle_px, along, step_px, radius_px = _frame_of(mask, window)
    places_px = crop_places(middle_px, along, step_px, size_px)
    planes = crop_planes(color_rgb, mask, places_px, step_px)
    if depth_m is not None and focal_px is not None:
        read_m = depth_m[window][mask[window]]
        read_m = read_m[valid_depth(read_m)]
        if read_m.size:
            surface_m = float(np.median(read_m))
            radius_m = max(radius_px * surface_m / focal_px, 1e-3)
            add_depth(planes, depth_m, places_px, surface_m, radius_m)
    return FruitCrop(planes, middle_px, along, step_px)


def _frame_of(mask: Mask, window: tuple[slice, slice]) -> tuple[Array, Array, float, float]:
    """Return the middle of a mask, its longer axis, the crop's step and the mask's radius."""
    rows, columns = window  # of the mask and a pixel around it
    pixels = mask_pixels(mask[window]) + np.array([columns.start, rows.start])
    spread = np.cov((pixels - pixels.mean(axis=0)).T) if len(pixels) > 2 else np.eye(2)
    along = np.linalg.eigh(spread)[1][:, 1]
    axes = np.array([along, [-along[1], along[0]]])
    places = pixels @ axes.T
    low, high = places.min(axis=0), places.max(axis=0)
    extents = high - low + 1
    step_px = max(_ALONG * extents[0] / WIDTH_PX, _ACROSS * extents[1] / HEIGHT_PX, _LEAST_STEP_PX)
    middle_px = (low + high) / 2 @ axes
    radius_px = float(distances_inside(np.pad(mask[window], 1)).max())
    return middle_px, along, float(step_px), radius_px


END_PX = 64
"""Height and width of a crop."""

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Levels of `EndLook.missing`."""

_RADII = 8.0  # side of a crop
_INNER_RADII = 1.5  # the direction of an end is that of the axis this far inside
_LEAST_RADIUS_PX = 1.0


@dataclass(frozen=True)
class EndLook:
    """Evaluation of one end of a fruit.

    Parameters
    ----------
    true, covered, running_on : float
        Probabilities, with the sum 1: the fruit ends there; more than 5 % of its length is missing
        (covered, or outside the image); the measured axis extends beyond the fruit by as much,
        into a stem, a flower or a leaf.
    missing : tuple of float, length 5
        Quantiles (`QUANTILES`) of the missing length, relative to the fruit's length; negative if
        too much was measured.
    stem : float
        Probability that it is the stem end.
    """

    true: float
    covered: float
    running_on: float
    missing: tuple[float, ...]
    stem: float


@dataclass(frozen=True, eq=False)
class EndCrop:
    """The image around one end of a fruit.

    Parameters
    ----------
    planes : ndarray of uint8, shape (64, 64, 6)
        See `PLANES`. The end is in the middle, the fruit comes from the left.
    shape : tuple of float
        Length over radius, and radius in pixels, both as logarithms.
    """

    planes: Pixels
    shape: tuple[float, float]


def end_crop(
    color_rgb: Pixels,
    depth_m: Array32,
    mask: Mask,
    intrinsics: Intrinsics,
    axis_m: Array,
    diameter_m: float,
) -> EndCrop:
    """Cut out the image around the first point of a fruit's axis.

    Parameters
    ----------
    color_rgb : ndarray of uint8, shape (H, W, 3)
        The image.
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour; 0 for no reading.
    mask : ndarray of bool, shape (H, W)
        The fruit's pixels.
    intrinsics : Intrinsics
        The colour stream's.
    axis_m : ndarray of float64, shape (K, 3)
        The measured axis, from the end of the crop to the other end, camera coordinates.
    diameter_m : float
        The fruit's largest diameter, metres.

    Examples
    --------
    A green fruit of 4 cm before a wall, 0.5 m away; its right end is in the middle of the crop:

    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> camera = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    >>> mask = np.zeros((480, 640), bool)
    >>> mask[216:265, 200:321] = True
    >>> color = np.where(mask[..., None], (40, 140, 40), (90, 90, 90)).astype(np.uint8)
    >>> depth = np.where(mask, 0.5, 1.0).astype(np.float32)
    >>> axis = np.stack([np.linspace(0, -0.1, 9), np.zeros(9), np.full(9, 0.52)], axis=1)
    >>> crop = end_crop(color, depth, mask, camera, axis, 0.04)
    >>> crop.planes[32, [13, 51], 1].tolist(), crop.planes[32, [13, 51], 5].tolist()
    ([140, 90], [255, 0])
    >>> crop.planes[32, [13, 51], 3].tolist()  # at the fruit's surface, far behind it
    [128, 255]
    """
    radius_m = max(diameter_m / 2, 1e-3)
    run = arc_positions(axis_m)
    inner = axis_m[min(int(np.searchsorted(run, _INNER_RADII * radius_m)), len(axis_m) - 1)]
    tip_px, inner_px, far_px = intrinsics.project(np.stack([axis_m[0], inner, axis_m[-1]]))
    radius_px = max(radius_m * intrinsics.fx_px / float(axis_m[0, 2]), _LEAST_RADIUS_PX)
    ahead = _direction(tip_px - inner_px, tip_px - far_px)
    step_px = _RADII * radius_px / END_PX
    places_px = crop_places(tip_px, ahead, step_px, (END_PX, END_PX))
    surface_m = float(inner[2]) - radius_m
    planes = crop_planes(color_rgb, mask, places_px, step_px)
    add_depth(planes, depth_m, places_px, surface_m, radius_m)
    length_m = max(float(run[-1]), 1e-3)
    return EndCrop(planes, (float(np.log(length_m / radius_m)), float(np.log(radius_px))))


def _direction(first: Array, second: Array) -> Array:
    """Return a unit vector along the first of two vectors that is not zero."""
    for vector in (first, second):
        norm = float(np.linalg.norm(vector))
        if norm > 1e-3:
            return np.asarray(vector / norm)
    return np.array([1.0, 0.0])


PLANES = 6
"""Red, green, blue, depth relative to the fruit, whether depth was read, the fruit's mask."""

_DEPTH_RADII = 4.0  # depth relative to the surface is clipped to this range


def crop_places(middle_px: Array, along: Array, step_px: float, size_px: tuple[int, int]) -> Array:
    """Return where a turned crop's pixels lie in the image.

    Parameters
    ----------
    middle_px : ndarray of float64, shape (2,)
        u, v of the crop's middle.
    along : ndarray of float64, shape (2,)
        Unit vector of its rows.
    step_px : float
        Image pixels of a crop pixel.
    size_px : tuple of int
        Its height and width.

    Returns
    -------
    ndarray of float64, shape (height, width, 2)
        u, v; each of the two is contiguous.

    Examples
    --------
    >>> crop_places(np.array([5.0, 4.0]), np.array([0.0, 1.0]), 2.0, (1, 3)).tolist()
    [[[5.0, 2.0], [5.0, 4.0], [5.0, 6.0]]]
    """
    height, width = size_px
    aside = np.array([-along[1], along[0]])
    columns = (np.arange(width) - (width - 1) / 2) * step_px
    rows = (np.arange(height) - (height - 1) / 2) * step_px
    middle_px, along, aside = (vector[:, None, None] for vector in (middle_px, along, aside))
    return np.moveaxis(middle_px + columns * along + rows[:, None] * aside, 0, -1)


def crop_planes(color_rgb: Pixels, mask: Mask, places_px: Array, step_px: float) -> Pixels:
    """Sample an image with a mask; the planes of depth stay empty.

    Parameters
    ----------
    color_rgb : ndarray of uint8, shape (H, W, 3)
        The image.
    mask : ndarray of bool, shape (H, W)
        The fruit's pixels.
    places_px : ndarray of float64, shape (h, w, 2)
        As `crop_places` returns them; nothing is read outside the image.
    step_px : float
        Their spacing.

    Returns
    -------
    ndarray of uint8, shape (h, w, 6)
        See `PLANES`.
    """
    planes = np.zeros((*places_px.shape[:2], PLANES), np.uint8)
    planes[..., :3] = sample_color(color_rgb, places_px, step_px)
    planes[..., 3] = 128
    pixels, is_inside = _pixels_at(places_px, mask.shape)
    planes[..., 5] = np.where(is_inside & mask[pixels], 255, 0)
    return planes


def add_depth(
    planes: Pixels, depth_m: Array32, places_px: Array, surface_m: float, radius_m: float
) -> None:
    """Fill in the planes of depth.

    Parameters
    ----------
    planes : ndarray of uint8, shape (h, w, 6)
        Of `crop_planes`; changed in place.
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour; 0 for no reading.
    places_px : ndarray of float64, shape (h, w, 2)
        Where the pixels lie in the image.
    surface_m, radius_m : float
        Distance of the fruit's surface, and its radius: the origin and the unit of its depth.
    """
    pixels, is_inside = _pixels_at(places_px, depth_m.shape)
    z = np.where(is_inside, depth_m[pixels], np.float32(0))
    off = np.clip((z - surface_m) / radius_m, -_DEPTH_RADII, _DEPTH_RADII)
    planes[..., 3] = np.where(valid_depth(z), np.rint(127.5 + 127.5 * off / _DEPTH_RADII), 128)
    planes[..., 4] = np.where(valid_depth(z), 255, 0)


def _pixels_at(places_px: Array, shape: tuple[int, ...]) -> tuple[tuple[Ints, Ints], Mask]:
    """Return the nearest rows and columns of an image, and which of them lie in it."""
    columns, rows = np.moveaxis(np.rint(places_px).astype(np.intp), -1, 0)
    pixels = np.clip(rows, 0, shape[0] - 1), np.clip(columns, 0, shape[1] - 1)
    return pixels, (pixels[0] == rows) & (pixels[1] == columns)


_PADDING_GREY = 114  # outside a picture, as the padding of network inputs


def sample_color(color_rgb: Pixels, points_px: Array, step_px: float) -> Pixels:
    """Return the colours at some points, averaged over their spacing where that is wide.

    Parameters
    ----------
    color_rgb : ndarray of uint8, shape (H, W, 3)
        The image.
    points_px : ndarray of float64, shape (h, w, 2)
        u, v of each pixel of the result; grey outside the image.
    step_px : float
        Spacing of the points: above one pixel, the image is shrunk to it first.

    Returns
    -------
    ndarray of uint8, shape (h, w, 3)

    Examples
    --------
    >>> picture = np.zeros((2, 4, 3), np.uint8)
    >>> picture[:, 2:] = 200
    >>> sample_color(picture, np.array([[[0.0, 0], [1.5, 0], [3, 0], [40, 0]]]), 1.0)[0, :, 0]
    array([  0, 100, 200, 114], dtype=uint8)
    """
    import cv2

    height, width = color_rgb.shape[:2]
    along = points_px[..., 0], points_px[..., 1]  # a plane each: both at once take several times
    lowest_px, highest_px = np.array([(plane.min(), plane.max()) for plane in along]).T
    first_px = np.clip(np.floor(lowest_px) - 2, 0, (width - 1, height - 1)).astype(int)
    end_px = np.clip(np.ceil(highest_px) + 3, first_px + 1, (width, height)).astype(int)
    part = color_rgb[first_px[1] : end_px[1], first_px[0] : end_px[0]]
    before = np.array([part.shape[1], part.shape[0]])
    after = before
    if step_px > 1:
        after = np.maximum(np.rint(before / step_px), 1).astype(int)
        part = np.asarray(cv2.resize(part, after.tolist(), interpolation=cv2.INTER_AREA), np.uint8)
    places = ((points_px - first_px + 0.5) * (after / before) - 0.5).astype(np.float32)
    sampled = cv2.remap(
        part,
        places[..., 0],
        places[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(_PADDING_GREY,) * 3,
    )
    return np.asarray(sampled, np.uint8)
