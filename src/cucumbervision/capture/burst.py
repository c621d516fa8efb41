"""A burst of frames to one frame: the median of valid depth, the sharpest colour."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.capture.frames import valid_depth
from cucumbervision.errors import CaptureError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["fuse_burst", "median_depth", "sharpness"]


def fuse_burst(
    colors: Sequence[NDArray[np.uint8]], depths_m: Sequence[NDArray[np.float32]]
) -> tuple[NDArray[np.uint8], NDArray[np.float32], int]:
    """Fuse a burst to one frame.

    Parameters
    ----------
    colors : sequence of ndarray of uint8, shape (H, W, 3)
        RGB pictures.
    depths_m : sequence of ndarray of float32, shape (H, W)
        Depth in metres, aligned to colour, one to each colour picture.

    Returns
    -------
    color : ndarray of uint8, shape (H, W, 3)
        The picture whose Laplacian has the largest variance; the first of equals.
    depth_m : ndarray of float32, shape (H, W)
        `median_depth` of the burst.
    burst_frame : int
        Index of `color` in the burst.

    Raises
    ------
    CaptureError
        If the burst is empty, or its frames differ in number or size.

    Examples
    --------
    >>> grey = np.full((4, 4, 3), 90, np.uint8)
    >>> edge = grey.copy()
    >>> edge[:, 2:] = 200
    >>> depths = [np.full((4, 4), z, np.float32) for z in (0.5, 0.0, 0.75)]
    >>> color, depth_m, burst_frame = fuse_burst([grey, edge, grey], depths)
    >>> burst_frame, float(depth_m[0, 0])
    (1, 0.625)
    """
    sizes = {c.shape[:2] for c in colors} | {d.shape for d in depths_m}
    if not colors or len(colors) != len(depths_m) or len(sizes) != 1:
        text = ", ".join(sorted(f"{s[1]}x{s[0]}" for s in sizes))
        raise CaptureError(
            f"a burst of {len(colors)} colour and {len(depths_m)} depth pictures"
            f"{' of sizes ' + text if text else ''} is no burst",
            remedy="give as many depth as colour pictures, all of one size",
        )
    scores = [sharpness(c) for c in colors] if len(colors) > 1 else [0.0]
    best = int(np.argmax(scores))
    return colors[best], median_depth(depths_m), best


def sharpness(color: NDArray[np.uint8]) -> float:
    """Give the variance of the Laplacian of a picture's grey values: more is sharper.

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
    import cv2

    grey = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    _, deviation = cv2.meanStdDev(cv2.Laplacian(grey, cv2.CV_16S))
    return float(np.ravel(deviation)[0] ** 2)


def median_depth(depths_m: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Give each pixel's median over its valid readings (0.1 to 5 m).

    Parameters
    ----------
    depths_m : sequence of ndarray of float32, shape (H, W)
        Depth in metres; at least one.

    Returns
    -------
    ndarray of float32, shape (H, W)
        Metres; 0 where no frame has a valid reading. Of an even number of readings it is the
        mean of the two in the middle.

    Notes
    -----
    The planes are put in order by min and max of whole planes (odd-even transposition sort),
    with infinity for what is no reading. That is several times faster than sorting each pixel.

    Examples
    --------
    >>> frames = [np.full((1, 1), z, np.float32) for z in (0.5, 0.0, 0.75, 9.0, 0.625)]
    >>> float(median_depth(frames)[0, 0])
    0.625
    """
    valid = [valid_depth(d) for d in depths_m]
    planes = [np.where(v, d, np.float32(np.inf)) for v, d in zip(valid, depths_m, strict=True)]
    counts = np.zeros(planes[0].shape, np.uint8 if len(planes) < 256 else np.int64)
    for v in valid:
        counts += v
    _sort_planes(planes)
    depth_m = np.zeros(planes[0].shape, np.float32)
    for n in range(1, len(planes) + 1):
        low, high = planes[(n - 1) // 2], planes[n // 2]
        # Most pixels have all their readings, so whole planes beat picking pixels.
        value = low if low is high else (low + high) / np.float32(2)
        np.copyto(depth_m, value, where=counts == n)
    return depth_m


def _sort_planes(planes: list[NDArray[np.float32]]) -> None:
    spare = np.empty_like(planes[0])
    for turn in range(len(planes)):
        for i in range(turn % 2, len(planes) - 1, 2):
            np.minimum(planes[i], planes[i + 1], out=spare)
            np.maximum(planes[i], planes[i + 1], out=planes[i + 1])
            planes[i], spare = spare, planes[i]
