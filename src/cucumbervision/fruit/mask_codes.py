"""Encode and decode masks as COCO run lengths and polygons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cucumbervision.arrays import Array, Mask


def decode_rle(counts: str | bytes | Sequence[int], height: int, width: int) -> Mask:
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
    # Check before NumPy, where large integers would overflow.
    size = height * width
    if not all(0 <= run <= size and run % 1 == 0 for run in runs) or sum(runs) != size:
        raise ValueError(f"the run lengths do not fill {width}x{height} pixels")
    values = np.arange(len(runs)) % 2 == 1
    return np.repeat(values, np.array(runs, np.int64)).reshape(width, height).T.copy()


def encode_rle(mask: Mask) -> str:
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
    # Runs begin with background: an empty first run if the first pixel is set.
    starts = [0, 0] if pixels[:1].any() else [0]
    runs = np.diff(np.concatenate([starts, changes, [pixels.size]])).tolist()
    return "".join(_pack(n - runs[k - 2] if k > 2 else n) for k, n in enumerate(runs))


def fill_polygon(points: Array, height: int, width: int) -> Mask:
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
    # An edge that is traversed in both directions (a bridge between parts) must cross a row at
    # exactly the same position: computed from its lower end.
    lower = np.where(y1 <= y2, [x1, y1], [x2, y2])[:, edges]
    upper = np.where(y1 <= y2, [x2, y2], [x1, y1])[:, edges]
    crossings = lower[0] + (centres[rows, 0] - lower[1]) * (
        (upper[0] - lower[0]) / (upper[1] - lower[1])
    )
    # All pixel centres at or right of a crossing change sides.
    first = np.clip(np.ceil(crossings - 0.5), 0, width).astype(int)
    mask = np.zeros((height, width), bool)
    if len(rows):
        # Counted in the polygon's own rows and columns: there may be thousands in a picture.
        (top, first_column), (bottom, right) = (rows.min(), first.min()), (rows.max(), first.max())
        changes = np.zeros((bottom + 1 - top, right + 1 - first_column), np.int32)
        np.add.at(changes, (rows - top, first - first_column), 1)
        mask[top : bottom + 1, first_column:right] = changes[:, :-1].cumsum(axis=1) % 2 == 1
    return mask


def polygon_points(values: Any) -> Array:
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


def mask_of_segmentation(shape: Any, height: int, width: int) -> Mask:
    """Decode COCO's 'segmentation'.

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
        If it is neither, has another size, or covers no pixel.

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


_MOST_DIGITS = 12  # of five bits each: no image needs more


def _pack(value: int) -> str:
    text = ""
    while True:
        digit, value = value & 0x1F, value >> 5
        # The last character's sign bit must match the sign of the value.
        continues = value != (-1 if digit & 0x10 else 0)
        text += chr((digit | (0x20 if continues else 0)) + 48)
        if not continues:
            return text


def _unpack(text: str) -> list[int]:
    codes = np.array([*map(ord, text)], np.int64) - 48
    if ((codes < 0) | (codes > 63)).any():
        raise ValueError("holds a character that is no run length")
    ends = np.flatnonzero(codes & 0x20 == 0)
    if not len(ends) or ends[-1] != len(codes) - 1:
        raise ValueError("the run lengths end within a number")
    starts = np.append(0, ends[:-1] + 1)
    digits = ends - starts + 1
    if digits.max() > _MOST_DIGITS:
        raise ValueError("a run length has more digits than any picture needs")
    places = np.arange(len(codes)) - np.repeat(starts, digits)
    runs = np.add.reduceat((codes & 0x1F) << 5 * places, starts)
    runs -= np.where(codes[ends] & 0x10, np.int64(1) << 5 * digits, 0)  # the sign
    # From the third on, each is the difference to the last but one.
    runs[1::2], runs[2::2] = runs[1::2].cumsum(), runs[2::2].cumsum()
    return [int(run) for run in runs]


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
    def of(cls, mask: Mask) -> Rle:
        """Return the code of a mask of shape (H, W)."""
        return cls(mask.shape[0], mask.shape[1], encode_rle(mask))

    def decode(self) -> Mask:
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
