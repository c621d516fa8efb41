"""The picture around one detected fruit, at the camera's own resolution, turned along its mask."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.capture.frames import valid_depth
from cucumbervision.instances.masks import distances_inside, mask_pixels, mask_window
from cucumbervision.instances.turned_crops import crop_places, crop_planes

if TYPE_CHECKING:
    from numpy.typing import NDArray

HEIGHT_PX, WIDTH_PX = 112, 256
"""Size of a crop."""

_ALONG, _ACROSS = 1.45, 1.6  # the crop's sides, in extents of the mask
_LEAST_STEP_PX = 0.25  # of the picture: a smaller fruit fills less of the crop


@dataclass(frozen=True, eq=False)
class FruitCrop:
    """The picture around one detected fruit.

    Parameters
    ----------
    planes : ndarray of uint8, shape (HEIGHT_PX, WIDTH_PX, 6)
        As `crop_planes` returns them. The mask's longer axis is horizontal.
    middle_px : ndarray of float64, shape (2,)
        u, v of the crop's middle in the picture.
    along : ndarray of float64, shape (2,)
        Unit vector of the crop's rows in the picture.
    step_px : float
        Picture pixels of a crop pixel.
    """

    planes: NDArray[np.uint8]
    middle_px: NDArray[np.float64]
    along: NDArray[np.float64]
    step_px: float

    @property
    def axes(self) -> NDArray[np.float64]:
        """The crop's two directions in the picture, as rows of a matrix, of one crop pixel each."""
        return self.step_px * np.array([self.along, [-self.along[1], self.along[0]]])

    def to_picture(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert points of the crop to picture pixels, both of shape (N, 2).

        Examples
        --------
        >>> planes = np.zeros((HEIGHT_PX, WIDTH_PX, 6), np.uint8)
        >>> crop = FruitCrop(planes, np.array([50.0, 40.0]), np.array([0.0, 1.0]), 2.0)
        >>> crop.to_picture(np.array([[(WIDTH_PX - 1) / 2 + 3, (HEIGHT_PX - 1) / 2]])).tolist()
        [[50.0, 46.0]]
        """
        return np.asarray((points - _MIDDLE) @ self.axes + self.middle_px)

    def to_crop(self, points_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert picture pixels to points of the crop, both of shape (N, 2)."""
        inverse = self.axes.T / self.step_px**2
        return np.asarray((points_px - self.middle_px) @ inverse + _MIDDLE)

    def mask_in_picture(
        self, log_odds: NDArray[np.float32], shape: tuple[int, int]
    ) -> NDArray[np.bool_]:
        """Return the picture's pixels at which log-odds given for the crop's pixels are positive.

        Parameters
        ----------
        log_odds : ndarray of float32, shape (HEIGHT_PX, WIDTH_PX)
            Interpolated linearly between the crop's pixels.
        shape : tuple of int
            Height and width of the picture.
        """
        import cv2

        inverse = self.axes.T / self.step_px**2
        offset = _MIDDLE - self.middle_px @ inverse
        picture_to_crop = np.column_stack([inverse.T, offset])
        warped = cv2.warpAffine(
            np.ascontiguousarray(log_odds, np.float32),
            picture_to_crop,
            (shape[1], shape[0]),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=-1.0,
        )
        return np.asarray(warped > 0)


_MIDDLE = np.array([(WIDTH_PX - 1) / 2, (HEIGHT_PX - 1) / 2])


def fruit_crop(
    color_rgb: NDArray[np.uint8],
    depth_m: NDArray[np.float32] | None,
    mask: NDArray[np.bool_],
    focal_px: float | None,
    size_px: tuple[int, int] = (HEIGHT_PX, WIDTH_PX),
) -> FruitCrop | None:
    """Cut out the picture around one mask.

    Parameters
    ----------
    color_rgb : ndarray of uint8, shape (H, W, 3)
        The picture.
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
    surface_m = (
        None if depth_m is None or focal_px is None else _surface_m(depth_m[window], mask[window])
    )
    if surface_m is None or focal_px is None:
        planes = crop_planes(color_rgb, None, mask, places_px, step_px)
    else:
        radius_m = max(radius_px * surface_m / focal_px, 1e-3)
        planes = crop_planes(color_rgb, depth_m, mask, places_px, step_px, surface_m, radius_m)
    return FruitCrop(planes, middle_px, along, step_px)


def _surface_m(depth_m: NDArray[np.float32], mask: NDArray[np.bool_]) -> float | None:
    """Return the median depth on a mask, None without a reading."""
    on_fruit_m = depth_m[mask]
    on_fruit_m = on_fruit_m[valid_depth(on_fruit_m)]
    return float(np.median(on_fruit_m)) if on_fruit_m.size else None


def _frame_of(
    mask: NDArray[np.bool_], window: tuple[slice, slice]
) -> tuple[NDArray[np.float64], NDArray[np.float64], float, float]:
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
