"""From a length's interval to a distribution, for probabilities."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.errors import ForecastError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["INTERVAL_LEVEL", "LengthBelief"]

INTERVAL_LEVEL = 0.90  # of the intervals in `interval_low_cm` and `interval_high_cm`


@dataclass(frozen=True)
class LengthBelief:
    """What is believed of one fruit's length: two half normals of its logarithm.

    The intervals are conformal, with half of 1 - level missed on either side, and may be longer
    on one side. Their ends are taken as quantiles, the measured length as the median (the
    interval's geometric middle where it lies outside), and either side as half a normal
    distribution of the logarithm. Ends and median are then exact, the shape between them is an
    assumption.

    Parameters
    ----------
    median_m : float
        Median, metres.
    low_sd, high_sd : float
        Relative standard deviations below and above it, of the logarithm.

    Examples
    --------
    >>> belief = LengthBelief.from_interval(0.252, 0.246, 0.258)
    >>> round(belief.probability(0.25, 0.35), 2)
    0.71
    """

    median_m: float
    low_sd: float
    high_sd: float

    @classmethod
    def from_interval(
        cls, length_m: float, low_m: float, high_m: float, level: float = INTERVAL_LEVEL
    ) -> LengthBelief:
        """Read an interval as a distribution.

        Parameters
        ----------
        length_m : float
            The measured length, metres.
        low_m, high_m : float
            Its interval.
        level : float
            The share of true lengths that such intervals hold.

        Raises
        ------
        ForecastError
            If the interval is none.
        """
        from scipy.special import ndtri

        if not (0 < low_m <= high_m < np.inf and 0 < level < 1 and length_m > 0):
            raise ForecastError(
                f"length {length_m} m with interval {low_m} to {high_m} m at level {level}",
                remedy="give positive metres, the lower end first, and a level between 0 and 1",
            )
        median = length_m if low_m <= length_m <= high_m else float(np.sqrt(low_m * high_m))
        z = float(ndtri(0.5 + level / 2))
        return cls(median, float(np.log(median / low_m)) / z, float(np.log(high_m / median)) / z)

    @property
    def sd_m(self) -> float:
        """Standard deviation, metres: the root mean square of both sides, as the forecast uses."""
        return self.median_m * float(np.sqrt((self.low_sd**2 + self.high_sd**2) / 2))

    def below(self, limit_m: ArrayLike) -> NDArray[np.float64]:
        """Give the probability to be shorter than each limit in metres, float64."""
        from scipy.special import ndtr

        limit = np.asarray(limit_m, np.float64)
        gap = np.log(np.maximum(limit, 1e-12) / self.median_m)
        sd = np.where(gap < 0, self.low_sd, self.high_sd)
        # A side without spread ends at the median: a limit on it has nothing below.
        z = np.where(sd > 0, gap / np.maximum(sd, 1e-12), np.where(gap > 0, np.inf, -np.inf))
        return np.asarray(ndtr(z), np.float64)

    def probability(self, low_m: float, high_m: float) -> float:
        """Give the probability to be from `low_m`, inclusive, to `high_m`, exclusive."""
        below = self.below([low_m, high_m])
        return float(below[1] - below[0])
