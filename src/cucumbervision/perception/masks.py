"""Masks: their window and box, overlaps, run lengths, polygons."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray


def mask_window(mask: NDArray[np.bool_], margin_px: int = 0) -> tuple[slice, slice] | None:
    """Return the rows and columns that hold a mask's pixels, None where none is set.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
    margin_px : int
        Pixels more on every side, as far as the picture goes.

    Examples
    --------
    >>> mask = np.zeros((4, 6), bool)
    >>> mask[1, 2:5] = True
    >>> mask_window(mask)
    (slice(1, 2, None), slice(2, 5, None))
    >>> mask_window(mask, 1)
    (slice(0, 3, None), slice(1, 6, None))
    """
    rows = np.flatnonzero(mask.any(axis=1))
    if not len(rows):
        return None
    # Only the mask's rows: the picture's would take several times as long.
    columns = np.flatnonzero(mask[rows[0] : rows[-1] + 1].any(axis=0))
    top, bottom, left, right = (
        int(edge) for found in (rows, columns) for edge in (found[0], found[-1] + 1)
    )
    return (
        slice(max(top - margin_px, 0), min(bottom + margin_px, mask.shape[0])),
        slice(max(left - margin_px, 0), min(right + margin_px, mask.shape[1])),
    )


def mask_pixels(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the places of a mask's pixels, row by row.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)

    Returns
    -------
    ndarray of float64, shape (N, 2)
        u, v in pixels.

    Examples
    --------
    >>> mask = np.zeros((4, 6), bool)
    >>> mask[1, 2:4] = mask[2, 1] = True
    >>> mask_pixels(mask).tolist()
    [[2.0, 1.0], [3.0, 1.0], [1.0, 2.0]]
    """
    window = mask_window(mask)
    if window is None:
        return np.empty((0, 2))
    v, u = np.nonzero(mask[window])
    corner = window[1].start, window[0].start
    return np.asarray(np.stack([u, v], axis=1) + corner, np.float64)


def distances_inside(mask: NDArray[Any]) -> NDArray[np.float32]:
    """Return each set pixel's distance from the nearest one that is not set, pixels.

    Parameters
    ----------
    mask : ndarray of bool or uint8, shape (H, W)
        Not 0 is set; beyond its border nothing is known.

    Returns
    -------
    ndarray of float32, shape (H, W)
        0 where no pixel is set; the same numbers at every call.

    Examples
    --------
    >>> mask = np.ones((3, 4), bool)
    >>> mask[0, 0] = False
    >>> distances_inside(mask)[1:, 1:].astype(float).round(2).tolist()
    [[1.41, 2.24, 3.16], [2.24, 2.83, 3.61]]
    """
    import cv2

    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # OpenCV's roots differ in their last bit from call to call; what they are roots of is whole.
    return np.sqrt(np.rint(np.square(inside)))


def box_of_mask(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the edges x1, y1, x2, y2 of a mask's box, in pixels.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        At least one pixel set.

    Raises
    ------
    ValueError
        If no pixel is set.

    Examples
    --------
    >>> mask = np.zeros((4, 6), bool)
    >>> mask[1, 2:5] = True
    >>> box_of_mask(mask).tolist()
    [1.5, 0.5, 4.5, 1.5]
    """
    window = mask_window(mask)
    if window is None:
        raise ValueError("the mask is empty")
    rows, columns = window
    return np.array([columns.start, rows.start, columns.stop, rows.stop]) - 0.5


def mask_ious(masks: NDArray[np.bool_], mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Compute the intersection over union of several masks, shape (N, H, W), with one."""
    shared = np.count_nonzero(masks & mask, axis=(1, 2))
    return np.asarray(shared / np.maximum(np.count_nonzero(masks | mask, axis=(1, 2)), 1))


def mask_iou(a: NDArray[np.bool_] | None, b: NDArray[np.bool_]) -> float:
    """Compute two masks' intersection over union; 0 where there is no first one.

    Examples
    --------
    >>> mask_iou(np.array([[True, True, False]]), np.array([[False, True, True]])) == 1 / 3
    True
    """
    return 0.0 if a is None else float(mask_ious(a[None], b)[0])


_SWALLOWED = 0.5  # share of the smaller mask in the larger: then the larger has swallowed it
_ONE_IOU = 0.8  # two masks of one thing, which is nobody's neighbour
_BESIDE_PX = 8
_NEARER = 0.01  # of the distance: what tells by depth which of two lies in front


def disjoint_masks(
    masks: Sequence[NDArray[np.bool_] | None],
    scores: Sequence[float],
    depth_m: NDArray[np.float32] | None = None,
) -> list[NDArray[np.bool_] | None]:
    """Give each pixel that two masks share to one of them.

    The smaller one gets it where the larger holds half of it or more, and so has swallowed it;
    else the one whose own pixels are nearer in depth to what both share; else the surer one.

    Parameters
    ----------
    masks : sequence of ndarray of bool, shape (H, W), or None
        Of different fruit; two with an IoU of 0.8 or more are of one, and keep what they share.
    scores : sequence of float
        How sure each is.
    depth_m : ndarray of float32, shape (H, W), optional
        Metres; 0 where there is no reading.

    Returns
    -------
    list of ndarray of bool, shape (H, W), or None
        In the same order. Where nothing is shared the very array that was given.

    Examples
    --------
    >>> left, both = np.zeros((2, 1, 6), bool)
    >>> left[0, :3] = both[0, :] = True
    >>> [mask.astype(int).tolist() for mask in disjoint_masks([left, both], [0.5, 0.9])]
    [[[1, 1, 1, 0, 0, 0]], [[0, 0, 0, 1, 1, 1]]]
    """
    kept = list(masks)
    windows = [None if mask is None else mask_window(mask) for mask in masks]
    for j, of_b in enumerate(windows):
        for i, of_a in enumerate(windows[:j]):
            a, b = kept[i], kept[j]
            given_a, given_b = masks[i], masks[j]
            if a is None or b is None or of_a is None or of_b is None:
                continue
            rows, columns = (
                slice(max(one.start, other.start), min(one.stop, other.stop))
                for one, other in zip(of_a, of_b, strict=True)
            )
            if not (a[rows, columns] & b[rows, columns]).any():
                continue
            # As given: what others took from both may have made two fruit alike.
            if given_a is None or given_b is None or mask_iou(given_a, given_b) >= _ONE_IOU:
                continue
            loser = _loser((a, b), (scores[i], scores[j]), depth_m)
            kept[(i, j)[loser]] = (a & ~b, b & ~a)[loser]
    return kept


def _loser(
    pair: tuple[NDArray[np.bool_], NDArray[np.bool_]],
    scores: tuple[float, float],
    depth_m: NDArray[np.float32] | None,
) -> int:
    """Return which of two masks that overlap gives up what they share."""
    a, b = pair
    shared = a & b
    areas = int(np.count_nonzero(a)), int(np.count_nonzero(b))
    count = int(np.count_nonzero(shared))
    if count >= _SWALLOWED * min(areas):
        return int(areas[1] > areas[0])
    far_m = _distances(shared, pair, depth_m)
    if all(far_m):
        off = [abs(one - far_m[0]) for one in far_m[1:]]
        if abs(off[0] - off[1]) > _NEARER * far_m[0]:
            return int(off[1] > off[0])
    return int(scores[1] <= scores[0])


def _distances(
    shared: NDArray[np.bool_],
    pair: tuple[NDArray[np.bool_], NDArray[np.bool_]],
    depth_m: NDArray[np.float32] | None,
) -> list[float]:
    """Return the median depth of what two masks share and of each one's own beside it, metres.

    0 without a reading. A fruit that lies askew is at its other end at another depth.
    """
    window = mask_window(shared)
    if depth_m is None or window is None:
        return [0.0]
    margin = max(_BESIDE_PX, *(part.stop - part.start for part in window))
    around = mask_window(shared, margin) or window
    medians = []
    for mask in (shared, *(one & ~shared for one in pair)):
        readings = depth_m[around][mask[around]]
        readings = readings[readings > 0]
        medians.append(float(np.median(readings)) if readings.size else 0.0)
    return medians


def decode_rle(counts: str | bytes | Sequence[int], height: int, width: int) -> NDArray[np.bool_]:
    """Decode COCO run lengths, compressed (a string) or not (numbers).

    Runs go down the columns and begin with background. The string holds six bits a character,
    lowest first, each run from the third on as the difference to the last but one
    (`rleFrString` in pycocotools' `maskApi.c`).

    Parameters
    ----------
    counts : str, bytes or sequence of int
        The run lengths.
    height, width : int
        The picture's size.

    Returns
    -------
    ndarray of bool, shape (height, width)

    Raises
    ------
    ValueError
        If the runs do not fill the picture exactly.

    Examples
    --------
    >>> decode_rle([1, 2, 3], 2, 3).astype(int).tolist()
    [[0, 1, 0], [1, 0, 0]]
    >>> bool((decode_rle("123", 2, 3) == decode_rle([1, 2, 3], 2, 3)).all())
    True
    """
    if isinstance(counts, bytes):
        counts = counts.decode("ascii")
    runs = _unpack(counts) if isinstance(counts, str) else list(counts)
    # Python's integers have no bound: none reaches NumPy that could overflow there.
    size = height * width
    if not all(0 <= run <= size and run % 1 == 0 for run in runs) or sum(runs) != size:
        raise ValueError(f"the run lengths do not fill {width}x{height} pixels")
    values = np.arange(len(runs)) % 2 == 1
    return np.repeat(values, np.array(runs, np.int64)).reshape(width, height).T.copy()


def encode_rle(mask: NDArray[np.bool_]) -> str:
    """Write a mask as COCO's compressed run lengths, the inverse of `decode_rle`.

    Parameters
    ----------
    mask : ndarray of bool, shape (height, width)

    Returns
    -------
    str
        As `rleToString` in pycocotools' `maskApi.c` writes them.

    Examples
    --------
    >>> encode_rle(np.array([[0, 1, 0], [1, 0, 0]], bool))
    '123'
    """
    pixels = np.asarray(mask, bool).T.ravel()
    changes = np.flatnonzero(pixels[1:] != pixels[:-1]) + 1
    # Runs begin with background: a first run of nothing where the first pixel is set.
    starts = [0, 0] if pixels[:1].any() else [0]
    runs = np.diff(np.concatenate([starts, changes, [pixels.size]])).tolist()
    return "".join(_pack(n - runs[k - 2] if k > 2 else n) for k, n in enumerate(runs))


def fill_polygon(points: NDArray[np.float64], height: int, width: int) -> NDArray[np.bool_]:
    """Set the pixels whose centres lie inside a polygon (even-odd rule).

    Parameters
    ----------
    points : ndarray, shape (K, 2)
        x, y in pixels from the picture's corner: the first pixel's centre is (0.5, 0.5).
    height, width : int
        The picture's size.

    Returns
    -------
    ndarray of bool, shape (height, width)

    Examples
    --------
    >>> square = np.array([[1.0, 0], [3, 0], [3, 1], [1, 1]])
    >>> fill_polygon(square, 2, 4).astype(int).tolist()
    [[0, 1, 1, 0], [0, 0, 0, 0]]
    """
    x1, y1 = np.asarray(points, np.float64).T
    x2, y2 = np.roll(x1, -1), np.roll(y1, -1)
    centres = np.arange(height)[:, None] + 0.5
    crossed = (y1 <= centres) != (y2 <= centres)
    rows, edges = np.nonzero(crossed)
    # An edge that is passed there and back (a bridge between parts) must cross a row at the same
    # number both times, to the last bit: counted from its lower end.
    low = np.where(y1 <= y2, [x1, y1], [x2, y2])[:, edges]
    high = np.where(y1 <= y2, [x2, y2], [x1, y1])[:, edges]
    at = low[0] + (centres[rows, 0] - low[1]) * ((high[0] - low[0]) / (high[1] - low[1]))
    # Everything from the first pixel centre at or right of a crossing changes sides.
    first = np.clip(np.ceil(at - 0.5), 0, width).astype(int)
    changes = np.zeros((height, width + 1), np.int32)
    np.add.at(changes, (rows, first), 1)
    return np.asarray(changes[:, :width].cumsum(axis=1) % 2 == 1)


def polygon_points(values: Any) -> NDArray[np.float64]:
    """Return the points, shape (K, 2), of a polygon written x1, y1, x2, y2, ...

    Raises
    ------
    ValueError
        If there are fewer than three points, or a number is not finite.
    """
    numbers = np.array(values, np.float64)
    if numbers.ndim != 1 or len(numbers) < 6 or len(numbers) % 2:
        raise ValueError("has a polygon of fewer than three points")
    if not np.isfinite(numbers).all():
        raise ValueError("has a number that is not finite")
    return numbers.reshape(-1, 2)


def mask_of_segmentation(shape: Any, height: int, width: int) -> NDArray[np.bool_]:
    """Return the mask that COCO's 'segmentation' says.

    Parameters
    ----------
    shape : mapping or sequence
        Run lengths (`size` and `counts`), or polygons x1, y1, x2, y2, ... from the corner.
    height, width : int
        The picture's size.

    Returns
    -------
    ndarray of bool, shape (height, width)
        At least one pixel is set.

    Raises
    ------
    KeyError, TypeError, ValueError, OverflowError
        If it is neither, of another size, or covers no pixel.

    Examples
    --------
    >>> mask_of_segmentation([[1, 0, 3, 0, 3, 1, 1, 1]], 2, 4).astype(int).tolist()
    [[0, 1, 1, 0], [0, 0, 0, 0]]
    """
    if isinstance(shape, Mapping):
        rows, columns = (int(n) for n in shape["size"])
        if (rows, columns) != (height, width):
            raise ValueError(f"has a mask of {columns}x{rows}, the picture is {width}x{height}")
        mask = decode_rle(shape["counts"], height, width)
    else:
        parts = [fill_polygon(polygon_points(part), height, width) for part in shape]
        mask = np.logical_or.reduce(parts)
    if not mask.any():
        raise ValueError("its mask covers no pixel of the picture")
    return mask


_RUN_BITS = 60  # reading a number of a million digits would take minutes


def _pack(value: int) -> str:
    text = ""
    while True:
        low, value = value & 0x1F, value >> 5
        # The last character's sign bit must say the sign of the whole.
        more = value != (-1 if low & 0x10 else 0)
        text += chr((low | (0x20 if more else 0)) + 48)
        if not more:
            return text


def _unpack(text: str) -> list[int]:
    runs: list[int] = []
    at = 0
    while at < len(text):
        value, shift, more = 0, 0, True
        while more:
            if at == len(text):
                raise ValueError("the run lengths end within a number")
            if shift > _RUN_BITS:
                raise ValueError("a run length has more digits than any picture needs")
            code = ord(text[at]) - 48
            if not 0 <= code < 64:
                raise ValueError(f"{text[at]!r} is no run length")
            value |= (code & 0x1F) << shift
            more = bool(code & 0x20)
            at, shift = at + 1, shift + 5
            if not more and code & 0x10:
                value |= -1 << shift
        runs.append(value + runs[-2] if len(runs) > 2 else value)
    return runs


@dataclass(frozen=True)
class Rle:
    """One mask in run lengths.

    Parameters
    ----------
    height, width : int
        The picture's size in pixels.
    counts : str
        COCO's compressed run lengths, as `encode_rle` gives them.

    Examples
    --------
    >>> mask = np.array([[0, 1, 0], [1, 0, 0]], bool)
    >>> code = Rle.of(mask)
    >>> code.counts, code.area_px, bool((code.decode() == mask).all())
    ('123', 2, True)
    """

    height: int
    width: int
    counts: str

    @classmethod
    def of(cls, mask: NDArray[np.bool_]) -> Rle:
        """Return the code of a mask of shape (H, W)."""
        return cls(mask.shape[0], mask.shape[1], encode_rle(mask))

    def decode(self) -> NDArray[np.bool_]:
        """Return the mask, bool, shape (height, width).

        Raises
        ------
        ValueError
            If the runs do not fill the picture exactly.
        """
        return decode_rle(self.counts, self.height, self.width)

    @property
    def area_px(self) -> int:
        """Number of pixels set."""
        return int(np.count_nonzero(self.decode()))


def painted_mask(
    mask: NDArray[np.bool_], points_px: NDArray[np.float64], radius_px: float, *, erase: bool
) -> NDArray[np.bool_]:
    """Return a mask with a brush's stroke added to it, or taken away.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        The mask.
    points_px : ndarray of float64, shape (N, 2)
        The stroke: x and y.
    radius_px : float
        Of the brush.
    erase : bool
        Whether it takes away.

    Examples
    --------
    >>> mask = np.zeros((20, 20), bool)
    >>> line = np.array([[5.0, 10.0], [15.0, 10.0]])
    >>> painted = painted_mask(mask, line, 2.0, erase=False)
    >>> bool(painted[10, 10]), bool(painted[4, 10])
    (True, False)
    >>> int(painted_mask(painted, line, 4.0, erase=True).sum())
    0
    """
    import cv2

    ink = np.zeros(mask.shape, np.uint8)
    line = np.rint(points_px).astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(ink, [line], False, 1, thickness=max(round(2 * radius_px), 1))
    for x, y in line[[0, -1], 0].tolist():
        cv2.circle(ink, (x, y), max(round(radius_px), 1), 1, thickness=-1)
    return mask & (ink == 0) if erase else mask | (ink > 0)
