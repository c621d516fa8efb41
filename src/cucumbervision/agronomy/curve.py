"""How growth depends on length: not at all, or falling towards a full length."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

__all__ = ["LINEAR", "Curve"]

NEARLY_FULL = 0.98  # nearer to its full length a fruit's age cannot be told from its length


@dataclass(frozen=True)
class Curve:
    """Growth that falls linearly with length, from half of `full_m` on, to nothing there.

    With dL/dt = rate s(L) and s = min(1, 2 (1 - L / full)), the *unslowed* length u, for which
    du = dL / s(L), grows linearly whatever the length. The whole model is in u: lengths are turned
    into it, and class limits with them.

    Parameters
    ----------
    full_m : float
        Full length, metres; infinite for growth that does not slow.

    Examples
    --------
    >>> curve = Curve(0.40)
    >>> curve.slowness([0.10, 0.20, 0.30]).round(6).tolist()
    [1.0, 1.0, 0.5]
    >>> curve.unslowed([0.10, 0.20, 0.30]).round(4).tolist()  # 0.2 + 0.2 log 2
    [0.1, 0.2, 0.3386]
    """

    full_m: float = float("inf")

    def slowness(self, length_m: ArrayLike) -> NDArray[np.float64]:
        """Give s(L), the share of its rate that a fruit of this length grows by, float64."""
        length = np.asarray(length_m, np.float64)
        if np.isinf(self.full_m):
            return np.ones_like(length)
        share = np.minimum(length / self.full_m, NEARLY_FULL)
        return np.asarray(np.minimum(2 * (1 - share), 1.0), np.float64)

    def unslowed(self, length_m: ArrayLike) -> NDArray[np.float64]:
        """Give u(L) in metres, float64."""
        length = np.asarray(length_m, np.float64)
        if np.isinf(self.full_m):
            return length
        half = self.full_m / 2
        # Below half the slowness is 1, and its logarithm nothing.
        return np.asarray(np.minimum(length, half) - half * np.log(self.slowness(length)))

    def points(
        self, measured: Sequence[tuple[float, float, float]], pace_m: float
    ) -> list[tuple[float, float, float]]:
        """Turn one fruit's measurements into points of the linear model.

        Parameters
        ----------
        measured : sequence of (day, length_m, sd_m)
            In order of days.
        pace_m : float
            About what a fruit that is not slowed grows by, metres a day.

        Returns
        -------
        list of (day, unslowed length in m, its variance)
            An error of the length is one of 1 / s times that in u, with s at the length that was
            to be expected after the point before: at the measured one, long readings would count
            less than short ones.
        """
        if np.isinf(self.full_m):
            return [(day, length, sd**2) for day, length, sd in measured]
        found: list[tuple[float, float, float]] = []
        for day, length, sd in measured:
            u = float(self.unslowed(length))
            expected = u if not found else found[-1][1] + (day - found[-1][0]) * pace_m
            found.append((day, u, (sd / self._slowness_of_unslowed(expected)) ** 2))
        return found

    def _slowness_of_unslowed(self, u_m: float) -> float:
        half = self.full_m / 2
        if u_m <= half:
            return 1.0
        return max(float(np.exp(1 - u_m / half)), 2 * (1 - NEARLY_FULL))


LINEAR = Curve()
