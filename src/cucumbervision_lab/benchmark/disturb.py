"""Masks and keypoints as a good network draws them: right, but for a pixel or two."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["Disturbance", "disturb_mask", "draw_disturbance"]

CORRELATION_PX = 12.0


class Disturbance:
    """A smooth random field by which an outline is moved outward or inward.

    Parameters
    ----------
    shift_px : ndarray of float32, shape (H, W)
        Outward shift at each pixel.
    """

    def __init__(self, shift_px: NDArray[np.float32]) -> None:
        self.shift_px = shift_px

    def at(self, u_px: float, v_px: float) -> float:
        """Give the shift at a position, the nearest pixel's; positions outside are clamped."""
        height, width = self.shift_px.shape
        column, row = round(np.clip(u_px, 0, width - 1)), round(np.clip(v_px, 0, height - 1))
        return float(self.shift_px[row, column])


def draw_disturbance(
    shape: tuple[int, int], rms_px: float, rng: np.random.Generator
) -> Disturbance:
    """Draw a field of the given RMS, smooth over a dozen pixels.

    Examples
    --------
    >>> field = draw_disturbance((240, 320), 1.5, np.random.default_rng(0))
    >>> bool(abs(field.shift_px.std() - 1.5) < 1e-3)
    True
    """
    import cv2

    noise = cv2.GaussianBlur(rng.standard_normal(shape, dtype=np.float32), (0, 0), CORRELATION_PX)
    return Disturbance(np.asarray(noise * np.float32(rms_px / noise.std())))


def disturb_mask(mask: NDArray[np.bool_], disturbance: Disturbance) -> NDArray[np.bool_]:
    """Move a mask's outline by a field.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        The exact mask.
    disturbance : Disturbance
        The field, of the same size.

    Returns
    -------
    ndarray of bool, shape (H, W)
        The pixels whose signed distance inside the outline exceeds minus the shift there.

    Examples
    --------
    >>> mask = np.zeros((40, 40), bool)
    >>> mask[10:30, 10:30] = True
    >>> grown = disturb_mask(mask, Disturbance(np.full((40, 40), 2.0, np.float32)))
    >>> int(np.flatnonzero(grown[20])[0])
    8
    """
    import cv2

    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # A pixel's centre is half a pixel from the border between it and its neighbour.
    signed = np.where(mask, inside - 0.5, 0.5 - outside)
    return np.asarray(signed > -disturbance.shift_px)
