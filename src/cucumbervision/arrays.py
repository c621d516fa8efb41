"""Types of arrays that most signatures name."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Ints = NDArray[np.intp]
Mask = NDArray[np.bool_]
Numbers = NDArray[Any]
Pixels = NDArray[np.uint8]
