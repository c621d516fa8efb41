"""A tracked fruit's length from all of its frames.

Much of a depth camera's error is the same in all frames from one place (`docs/results.md`), and so
are errors of the outline and hidden ends. Frames from one place are therefore averaged to one view,
which keeps the share `FIXED` of the variance of a single frame. Views from different places are
pooled like the stops of a round, by `measurement.matching.pooled_length`: half of the variance is
common, since they share a camera, and views that disagree widen the interval.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.measurement.intervals import SCALE_SD
from cucumbervision.measurement.matching import pooled_length
from cucumbervision.measurement.result import INTERVAL_Z, UNKNOWN_SD, Length, LengthDefinition

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from cucumbervision.measurement.result import LengthKind

FIXED = 0.95  # share of a length's variance common to all frames from one place
_SAME_PLACE = 0.10  # of the distance: smaller movements of the camera count as one place
_MOST_PLACES = 64
_SURE_SD, _LEAST_APART = 4.0, 0.15  # standard deviations, and log lengths: least difference
_LEAST_SD = 0.002  # of a length, relative


def same_place(a_m: NDArray[np.float64], b_m: NDArray[np.float64]) -> bool:
    """Return whether a fruit was seen twice from one place.

    Parameters
    ----------
    a_m, b_m : ndarray of float64, shape (3,)
        The fruit's centre in camera coordinates, twice; unknown ones (NaN) count as one place.

    Examples
    --------
    >>> centre_m = np.array([0.0, 0.0, 0.5])
    >>> same_place(centre_m, centre_m + [0.02, 0, 0]), same_place(centre_m, centre_m + [0.08, 0, 0])
    (True, False)
    """
    away = float(np.linalg.norm(a_m - b_m))
    return not away > _SAME_PLACE * max(float(abs(a_m[2])), 0.1)


@dataclass
class _Place:
    """Running mean and scatter of the log lengths of frames from one place."""

    at_m: NDArray[np.float64]
    count: int = 0
    mean: float = 0.0
    scatter: float = 0.0
    variance: float = 0.0

    def add(self, log: float, variance: float) -> None:
        """Add one frame (Welford 1962)."""
        self.count += 1
        off = log - self.mean
        self.mean += off / self.count
        self.scatter += off * (log - self.mean)
        self.variance += (variance - self.variance) / self.count

    @property
    def view_variance(self) -> float:
        """Variance of the mean; its fixed part does not fall with the number of frames."""
        fresh = (1 - FIXED) * self.variance
        if self.count > 2:  # an unstable outline shows as scatter between frames
            fresh = max(fresh, self.scatter / (self.count - 1))
        return FIXED * self.variance + fresh / self.count


@dataclass
class TrackLength:
    """Accumulates one fruit's length over its frames.

    Parameters
    ----------
    kind : LengthDefinition or LengthKind, optional
        The kind of `length`.
    places : list
        One entry per place from which the whole fruit was measured.
    at_least_m : float, optional
        The longest lower bound.
    frames : int
        Number of frames in `length`.
    length : Length, optional
        The length from all frames; None until the whole fruit was measured.

    Examples
    --------
    Frames from one place, then from others:

    >>> track = TrackLength()
    >>> frame_length = Length(0.30, LengthDefinition.THREAD, 0.285, 0.3158)
    >>> def width(along_m):
    ...     track.add(frame_length, np.array([along_m, 0.0, 0.5]))
    ...     length = track.length
    ...     return round(100 * (length.high_m - length.low_m), 1)
    >>> width(0.0), [width(0.0) for _ in range(50)][-1], [width(x) for x in (0.1, 0.2, 0.3)][-1]
    (3.1, 3.0, 2.5)
    """

    kind: LengthDefinition | LengthKind | None = None
    places: list[_Place] = field(default_factory=list)
    at_least_m: float | None = None
    frames: int = 0
    length: Length | None = None
    _shift: float = 0.0

    def add(
        self,
        length: Length,
        at_m: NDArray[np.float64],
        *,
        partial: bool = False,
        scale_known: bool = False,
    ) -> None:
        """Add the length of one frame.

        Parameters
        ----------
        length : Length
            As measured. A fitted tube's length replaces raw lengths of other methods; the two are
            never mixed.
        at_m : ndarray of float64, shape (3,)
            The fruit's centre in camera coordinates.
        partial : bool
            Whether it is a lower bound; used only until the whole fruit was seen.
        scale_known : bool
            Whether the camera's depth scale was calibrated.
        """
        if partial:
            self.at_least_m = max(self.at_least_m or 0.0, length.value_m)
            return
        tube = isinstance(length.kind, LengthDefinition)
        if self.kind is None or (tube and not isinstance(self.kind, LengthDefinition)):
            self.kind = length.kind
            self.places.clear()
            self.frames, self._shift = 0, 0.0
        if length.kind != self.kind:
            return
        log, sd, shift = _log_length(length)
        scale = 0.0 if scale_known else SCALE_SD
        # The depth scale's error is the same at every place and is added at the end.
        self._place(at_m).add(log, max(sd**2 - scale**2, _LEAST_SD**2))
        self.frames += 1
        self._shift += (shift - self._shift) / self.frames
        self.length = self._pooled(length, scale)

    def contradicts(self, length: Length, *, partial: bool = False) -> bool:
        """Return whether a length contradicts this fruit's, so that it must be another fruit.

        Parameters
        ----------
        length : Length
            As measured in a frame.
        partial : bool
            Whether it is a lower bound.

        Examples
        --------
        >>> track = TrackLength()
        >>> track.add(Length(0.30, LengthDefinition.THREAD, 0.285, 0.3158), np.zeros(3))
        >>> shorter = Length(0.22, LengthDefinition.THREAD, 0.21, 0.23)
        >>> track.contradicts(shorter), track.contradicts(shorter, partial=True)
        (True, False)
        """
        log, sd, _ = _log_length(length)
        if self.length is None:
            least_m = 0.0 if partial or self.at_least_m is None else self.at_least_m
            return least_m > 0 and np.log(least_m) - log > max(_SURE_SD * sd, _LEAST_APART)
        if length.kind != self.length.kind:
            return False
        before, before_sd, _ = _log_length(self.length)
        longer = log - before if partial else abs(log - before)
        return longer > max(_SURE_SD * float(np.hypot(sd, before_sd)), _LEAST_APART)

    def _place(self, at_m: NDArray[np.float64]) -> _Place:
        for place in self.places:
            if same_place(place.at_m, at_m):
                return place
        if len(self.places) < _MOST_PLACES:
            self.places.append(_Place(at_m))
        return self.places[-1]

    def _pooled(self, latest: Length, scale: float) -> Length:
        means = np.exp([place.mean for place in self.places])
        deviations = np.sqrt([place.view_variance for place in self.places])
        pooled = pooled_length(means, deviations, np.zeros(len(means), bool))
        value, sd_m = pooled or (latest.value_m, UNKNOWN_SD * latest.value_m)
        spread = INTERVAL_Z * float(np.hypot(sd_m / value, scale))
        middle = value * float(np.exp(self._shift))
        low_m, high_m = middle * float(np.exp(-spread)), middle * float(np.exp(spread))
        return Length(value, latest.kind, low_m, high_m, latest.interval_of, latest.basis)


def _log_length(length: Length) -> tuple[float, float, float]:
    """Return the log length, its standard deviation, and the offset of its interval's middle."""
    log = float(np.log(length.value_m))
    if not (length.low_m and length.high_m):
        return log, UNKNOWN_SD, 0.0
    sd = length.relative_sd or UNKNOWN_SD
    return log, sd, float(np.log(length.low_m * length.high_m)) / 2 - log
