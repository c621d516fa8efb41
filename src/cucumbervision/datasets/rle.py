"""Masks as COCO's compressed run lengths, which is how thousands of them fit in memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.perception.mask_codes import decode_rle, encode_rle

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["Rle"]


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
