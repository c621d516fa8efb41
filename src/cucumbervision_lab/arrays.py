"""Types that most signatures of the laboratory name."""

from collections.abc import Callable

from numpy.random import Generator

from cucumbervision.arrays import Array, Array32, Mask, Pixels

__all__ = ["Array", "Array32", "Generator", "Mask", "Pixels", "Progress"]

Progress = Callable[[int], None]
"""Called with the number of pictures that were finished since the last call."""
