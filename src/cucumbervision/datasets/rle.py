"""Masks as COCO's compressed run lengths, which is how thousands of them fit in memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.perception.mask_codes import decode_rle

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

__all__ = ["Rle", "encode_rle"]


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
        """Code a mask of shape (H, W)."""
        return cls(mask.shape[0], mask.shape[1], encode_rle(mask))

    def decode(self) -> NDArray[np.bool_]:
        """Give the mask, bool, shape (height, width).

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


def encode_rle(mask: NDArray[np.bool_]) -> str:
    """Code a mask as COCO's compressed run lengths; `decode_rle` is its inverse.

    Runs go down the columns and begin with background; each from the third on is written as the
    difference to the last but one, six bits a character, lowest first (`rleToString` in
    pycocotools' `maskApi.c`).

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)

    Returns
    -------
    str

    Examples
    --------
    >>> encode_rle(np.array([[0, 1, 0], [1, 0, 0]], bool))
    '123'
    """
    line = np.asarray(mask, bool).T.ravel()
    changes = np.flatnonzero(line[1:] != line[:-1]) + 1
    runs = np.diff(np.concatenate([[0], changes, [line.size]])).tolist()
    if line.size and line[0]:
        runs.insert(0, 0)
    return _packed(run - (runs[i - 2] if i > 2 else 0) for i, run in enumerate(runs))


def _packed(numbers: Iterable[int]) -> str:
    text = []
    for number in numbers:
        more = True
        while more:
            bits = number & 0x1F
            number >>= 5
            # The last character's fifth bit is the sign, which the reader extends.
            more = number != (-1 if bits & 0x10 else 0)
            text.append(chr((bits | 0x20 if more else bits) + 48))
    return "".join(text)
