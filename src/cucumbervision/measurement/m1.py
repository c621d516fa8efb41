"""M1, scan line: three lines along the box, each between its outermost samples."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.frames import valid_depth
from cucumbervision.geometry.pixels import valid_median
from cucumbervision.measurement.cloud import box_pixels
from cucumbervision.measurement.methods import Region, TableMethod
from cucumbervision.measurement.result import LengthKind, Measurement, MethodName, Reason

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.capture.intrinsics import Intrinsics

_LINES = (0.25, 0.5, 0.75)
_SAMPLES = 13
WINDOW_PX = 11
GATE_M = 0.035


def measure_m1(
    depth_m: NDArray[np.float32], box: NDArray[Any], intrinsics: Intrinsics
) -> Measurement:
    """Measure a fruit by three scan lines along the longer side of its box.

    Lines at 1/4, 1/2 and 3/4 of the width, 13 samples each from end to end, each the median of
    the valid readings in an 11x11 window. A sample counts when it is within 3.5 cm of the median
    depth of the box's middle ninth. A line's length is the distance between its two outermost
    counting samples; the median of the lines is the result.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres, aligned to colour; 0 where there is no reading.
    box : ndarray of float, shape (4,)
        Edges x1, y1, x2, y2 in pixels.
    intrinsics : Intrinsics
        The colour stream's.

    Returns
    -------
    Measurement
        Kind 'box-chord'; reason 'no-depth' when the middle ninth has no reading and
        'too-few-samples' when no line has two counting samples.

    Notes
    -----
    The paper's M1 (Eq. 1). For a fruit at angle t in the picture, before a backdrop at its own
    depth, it tends to L cos t; before empty or far space the lines leave the fruit and it reads
    far less. This known error of the method is kept.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> camera = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    >>> depth = np.full((480, 640), 0.6, np.float32)
    >>> result = measure_m1(depth, np.array([219.5, 219.5, 419.5, 259.5]), camera)
    >>> round(result.length_m, 4)  # 200 px at 0.6 m and f = 600 px
    0.2
    """
    reference = reference_depth(depth_m, box)
    if reference is None:
        return Measurement(MethodName.M1, reason=Reason.NO_DEPTH)
    u, v = sample_grid(box)
    z = window_depths(depth_m, u, v, WINDOW_PX)
    with np.errstate(invalid="ignore"):
        counts = np.abs(z - reference) <= GATE_M
    x, y = intrinsics.rays(u, v)
    points = np.stack([x * z, y * z, z], axis=-1).astype(np.float64)
    segments = []
    for line, ok in zip(points, counts, strict=True):
        index = np.flatnonzero(ok)
        if len(index) >= 2:
            segments.append(line[[index[0], index[-1]]])
    if not segments:
        return Measurement(MethodName.M1, reason=Reason.TOO_FEW_SAMPLES)
    lengths = np.array([np.linalg.norm(b - a) for a, b in segments])
    length = float(np.median(lengths))
    path = segments[int(np.argmin(np.abs(lengths - length)))]
    return Measurement(MethodName.M1, length, LengthKind.BOX_CHORD, path_m=path)


def reference_depth(depth_m: NDArray[np.float32], box: NDArray[Any]) -> float | None:
    """Return the median depth of a box's middle ninth, metres, or None without a reading.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres; 0 where there is no reading.
    box : ndarray of float, shape (4,)
        Edges x1, y1, x2, y2 in pixels.
    """
    third = (box[2:] - box[:2]) / 3
    middle = np.concatenate([box[:2] + third, box[2:] - third])
    x1, y1, x2, y2 = box_pixels(middle, depth_m.shape)
    region = depth_m[y1:y2, x1:x2]
    readings = region[valid_depth(region)]
    return float(np.median(readings)) if len(readings) else None


def sample_grid(box: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the pixels u and v of a box's samples, each of shape (lines, samples).

    Parameters
    ----------
    box : ndarray of float, shape (4,)
        Edges x1, y1, x2, y2 in pixels; lines run along the longer side.

    Examples
    --------
    >>> u, v = sample_grid(np.array([0.0, 0.0, 24.0, 8.0]))
    >>> u.shape, u[0, :3].tolist(), v[:, 0].tolist()
    ((3, 13), [0.0, 2.0, 4.0], [2.0, 4.0, 6.0])
    """
    # Axis of the longer side: 0 for a wide box, 1 for a high one.
    side = int(box[3] - box[1] > box[2] - box[0])
    across_axis = 1 - side
    along = np.linspace(box[side], box[side + 2], _SAMPLES)
    across = box[across_axis] + np.array(_LINES)[:, None] * (
        box[across_axis + 2] - box[across_axis]
    )
    grids = np.broadcast_arrays(along[None, :], across)
    return grids[side], grids[across_axis]


def window_depths(
    depth_m: NDArray[np.float32],
    u_px: NDArray[np.float64],
    v_px: NDArray[np.float64],
    window_px: int,
    mask: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64]:
    """Return the median of the valid readings in a square window around each position.

    Parameters
    ----------
    depth_m : ndarray of float32, shape (H, W)
        Metres.
    u_px, v_px : ndarray of float, any shape
        Positions in pixels; a window is centred on the nearest pixel and cut to the picture.
    window_px : int
        Odd width of the window.
    mask : ndarray of bool, shape (H, W), optional
        Only readings inside it count.

    Returns
    -------
    ndarray of float64, the shape of `u_px`
        Metres; NaN where the window has no reading.

    Examples
    --------
    >>> depth = np.zeros((9, 9), np.float32)
    >>> depth[4, 3:6] = 0.5, 0.6, 0.75
    >>> window_depths(depth, np.array([4.2]), np.array([3.9]), 3).round(2)
    array([0.6])
    """
    height, width = depth_m.shape
    offsets = np.arange(window_px) - window_px // 2
    rows = np.rint(v_px).astype(np.intp).ravel()[:, None, None] + offsets[:, None]
    columns = np.rint(u_px).astype(np.intp).ravel()[:, None, None] + offsets
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    rows, columns = np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)
    readings = depth_m[rows, columns]
    counts = inside & valid_depth(readings)
    if mask is not None:
        counts &= mask[rows, columns]
    flat = (len(readings), window_px * window_px)
    medians = valid_median(readings.reshape(flat), counts.reshape(flat), axis=1)
    return medians.astype(np.float64).reshape(u_px.shape)


def _measure(region: Region) -> Measurement:
    return measure_m1(region.depth_m, region.box, region.intrinsics)


METHOD = TableMethod(
    name="M1",
    title="scan line",
    kind=LengthKind.BOX_CHORD,
    measure=_measure,
    needs=("box",),
    rank=50,
    rank_compact=70,
    is_paper=True,
    color="#56B4E9",
)
