"""Types that most signatures of the laboratory name."""

from collections.abc import Callable

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

__all__ = ["Array", "Array32", "Generator", "Mask", "Pixels", "Progress"]

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8]
Progress = Callable[[int], None]
"""Called with the number of pictures that were finished since the last call."""
