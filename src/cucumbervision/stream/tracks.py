"""Track fruit from frame to frame by position in space and mask overlap.

Rows of a round are merged in the same way: the similarity of two views is a log likelihood ratio
(`rounds.row_views` of the greenhouse), the likeliest shift of the camera is found by trial, and
views are assigned one to one. Frames have few fruit and follow each other closely, so each frame is
assigned once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import count

import numpy as np

from cucumbervision.arrays import Array, Ints, Mask
from cucumbervision.capture.frames import Capture, valid_depth
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.instance import Instance, visible_mask
from cucumbervision.fruit.masks import mask_window
from cucumbervision.methods import matching
from cucumbervision.methods.intervals import SCALE_SD
from cucumbervision.methods.result import (
    INTERVAL_Z,
    UNKNOWN_SD,
    Length,
    LengthDefinition,
    LengthKind,
)

FIXED = 0.95  # share of a length's variance common to all frames from one place
_SAME_PLACE = 0.10  # of the distance: smaller movements of the camera count as one place
_MOST_PLACES = 64
_SURE_SD, _LEAST_APART = 4.0, 0.15  # standard deviations, and log lengths: least difference
_LEAST_SD = 0.002  # of a length, relative


def same_place(a_m: Array, b_m: Array) -> bool:
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

    at_m: Array
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
        self, length: Length, at_m: Array, *, partial: bool = False, scale_known: bool = False
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

    def _place(self, at_m: Array) -> _Place:
        for place in self.places:
            if same_place(place.at_m, at_m):
                return place
        if len(self.places) < _MOST_PLACES:
            self.places.append(_Place(at_m))
        return self.places[-1]

    def _pooled(self, latest: Length, scale: float) -> Length:
        means = np.exp([place.mean for place in self.places])
        deviations = np.sqrt([place.view_variance for place in self.places])
        pooled = matching.pooled_length(means, deviations, np.zeros(len(means), bool))
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


_STEP = 4  # pixels; the sampling step of masks
_WALK_M_S = 1.0  # assumed speed of the camera before it is known
_TURN_M_S = 0.5  # change of that speed per second
_DRIFT_M_S = 0.03  # growth of a position's standard deviation while its fruit is out of sight
_STILL_M = 0.005
_HALF_OVERLAP = 0.25  # of masks: no evidence for one fruit nor for two
_LEAST_OVERLAP = 0.03  # offset against log 0


@dataclass(frozen=True, eq=False)
class Sighting:
    """One detection, for comparison with those of other frames.

    Parameters
    ----------
    at_m : ndarray of float64, shape (3,)
        Centre of the visible part, camera coordinates in metres; NaN without depth.
    top_px, left_px : int
        Position of the outline's window, pixels.
    outline : ndarray of bool, shape (h, w)
        Every fourth pixel of the mask, or of the box without a mask.
    """

    at_m: Array
    top_px: int
    left_px: int
    outline: Mask

    def overlap(self, later: Sighting, shift_px: Array) -> float:
        """Compute the intersection over union of this outline, shifted, with another.

        Examples
        --------
        >>> block = Sighting(np.zeros(3), 0, 0, np.ones((4, 4), bool))
        >>> block.overlap(block, np.array([0.0, 0.0])), block.overlap(block, np.array([8.0, 0.0]))
        (1.0, 0.3333333333333333)
        """
        down = round((self.top_px + float(shift_px[1]) - later.top_px) / _STEP)
        right = round((self.left_px + float(shift_px[0]) - later.left_px) / _STEP)
        (h, w), (height, width) = self.outline.shape, later.outline.shape
        rows, columns = _common(down, h, height), _common(right, w, width)
        window = self.outline[
            rows[0] - down : rows[1] - down, columns[0] - right : columns[1] - right
        ]
        shared = int(np.count_nonzero(window & later.outline[slice(*rows), slice(*columns)]))
        union = int(np.count_nonzero(self.outline) + np.count_nonzero(later.outline)) - shared
        return shared / max(union, 1)


def _common(shift: int, size: int, later_size: int) -> tuple[int, int]:
    start = max(shift, 0)
    return start, max(min(shift + size, later_size), start)


def sighting_of(capture: Capture, instance: Instance) -> Sighting:
    """Return outline and centre of one detection.

    The centre is that of the mask's box, at the median of the depth readings.
    """
    mask = visible_mask(instance)
    window = None if mask is None else mask_window(mask)
    x1, y1, x2, y2 = (round(float(edge) + 0.5) for edge in instance.box)
    if mask is None or window is None:
        window = (slice(max(y1, 0), max(y2, 1)), slice(max(x1, 0), max(x2, 1)))
        outline = np.ones(capture.depth_m[window][::_STEP, ::_STEP].shape, bool)
    else:
        outline = mask[window][::_STEP, ::_STEP]
    rows, columns = window
    readings = capture.depth_m[window][::_STEP, ::_STEP][outline]
    readings = readings[valid_depth(readings)]
    at_m = np.full(3, np.nan)
    if readings.size:
        depth_m = float(np.median(readings))
        middle = (columns.start + columns.stop - 1) / 2, (rows.start + rows.stop - 1) / 2
        x, y = capture.intrinsics.rays(*middle)
        at_m = np.array([float(x) * depth_m, float(y) * depth_m, depth_m])
    return Sighting(at_m, rows.start, columns.start, outline)


# Frames without a fruit before it may be lost, and more than any camera takes in `keep_s`.
_FEW_UNSEEN, _MOST_UNSEEN = 3, 200
_LONGEST_UNSEEN_S = 20.0


@dataclass(eq=False)
class Track:
    """A fruit that is followed from frame to frame.

    Parameters
    ----------
    number : int
        Its number.
    sighting : Sighting
        The latest detection.
    at_m : ndarray of float64, shape (3,)
        Where it is now, after the estimated movement of the camera since then.
    seen_s : float
        When it was seen last, seconds.
    moved_m : ndarray of float64, shape (3,)
        Movement since then.
    unseen_frames : int
        Frames since then.
    length : TrackLength
        Its length from all frames.
    seen_frames, waiting : int
        Frames in which it was seen, and those since it was measured.
    measured_at : Sighting, optional
        The detection that was measured last.
    """

    number: int
    sighting: Sighting
    at_m: Array
    seen_s: float
    moved_m: Array = field(default_factory=lambda: np.zeros(3))
    unseen_frames: int = 0
    length: TrackLength = field(default_factory=TrackLength)
    seen_frames: int = 0
    waiting: int = 0
    measured_at: Sighting | None = None

    def is_lost(self, now_s: float, keep_s: float) -> bool:
        """Return whether it was out of sight for too long, also where time goes back.

        A pause between two frames loses no fruit: a loaded computer takes few.
        """
        unseen_s = abs(now_s - self.seen_s)
        is_missed = self.unseen_frames >= _FEW_UNSEEN and unseen_s > keep_s
        return is_missed or unseen_s > _LONGEST_UNSEEN_S or self.unseen_frames > _MOST_UNSEEN


class Tracker:
    """Assigns a number to each fruit, the same in all frames.

    The camera may move, the fruit may not: one shift of all fruit is estimated between two frames.
    It also approximates small rotations.

    Parameters
    ----------
    keep_s : float
        Time for which a fruit that frames do not show is kept, seconds.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> square = np.ones((10, 3), bool)
    >>> def sighting(x):
    ...     return Sighting(np.array([x, 0.0, 0.6]), 100, round(900 * x / 0.6), square)
    >>> tracker = Tracker()
    >>> camera = Intrinsics(1280, 720, 900.0, 900.0, 0.0, 360.0)
    >>> tracks = tracker.assign([sighting(0.10), sighting(0.25)], camera, 0.0)
    >>> [track.number for track in tracks]
    [1, 2]

    The camera walks on by 6 cm; a third fruit comes into sight:

    >>> tracks = tracker.assign([sighting(x) for x in (0.04, 0.19, 0.34)], camera, 0.1)
    >>> [track.number for track in tracks]
    [1, 2, 3]
    """

    def __init__(self, keep_s: float = 2.0) -> None:
        self._keep_s = keep_s
        self.tracks: list[Track] = []
        self._numbers = count(1)
        self._at_s: float | None = None
        self._speed_m_s: Array | None = None

    def forget(self) -> None:
        """Forget all fruit, for a new scene. Numbers are not reused."""
        self.tracks, self._speed_m_s = [], None

    def split(self, track: Track) -> Track:
        """Return the track of another fruit, in place of one that was matched wrongly."""
        other = self._begun(track.sighting, track.seen_s)
        self.tracks[self.tracks.index(track)] = other
        return other

    def _begun(self, sighting: Sighting, now_s: float) -> Track:
        return Track(next(self._numbers), sighting, sighting.at_m, now_s)

    def assign(
        self, sightings: Sequence[Sighting], camera: Intrinsics, now_s: float
    ) -> list[Track]:
        """Return the track of each detection's fruit.

        Parameters
        ----------
        sightings : sequence of Sighting
            The frame's detections.
        camera : Intrinsics
            Intrinsics of the frame.
        now_s : float
            Time in seconds.
        """
        elapsed_s = max(now_s - self._at_s, 0.0) if self._at_s is not None else 0.0
        self._at_s = now_s
        self.tracks = [track for track in self.tracks if not track.is_lost(now_s, self._keep_s)]
        for track in self.tracks:
            track.unseen_frames += 1
        matched: dict[int, Track] = {}
        if self.tracks and sightings:
            pairs = self._pair(sightings, camera, elapsed_s)
            matched = {j: self.tracks[i] for i, j in pairs.tolist()}
        else:
            self._carry_on(self._predicted(elapsed_s))
        for j, sighting in enumerate(sightings):
            if j in matched:
                track = matched[j]
                track.sighting, track.at_m, track.seen_s = sighting, sighting.at_m, now_s
                track.moved_m, track.unseen_frames = np.zeros(3), 0
            else:
                matched[j] = self._begun(sighting, now_s)
                self.tracks.append(matched[j])
        return [matched[j] for j in range(len(sightings))]

    def _predicted(self, elapsed_s: float) -> Array:
        speed = np.zeros(3) if self._speed_m_s is None else self._speed_m_s
        return np.asarray(speed * elapsed_s)

    def _carry_on(self, shift_m: Array) -> None:
        for track in self.tracks:
            track.at_m = track.at_m + shift_m
            track.moved_m = track.moved_m + shift_m

    def _pair(self, sightings: Sequence[Sighting], camera: Intrinsics, elapsed_s: float) -> Ints:
        """Return pairs of track and sighting, shape (K, 2), after shifting the tracks."""
        from scipy.optimize import linear_sum_assignment

        predicted = self._predicted(elapsed_s)
        reach = _WALK_M_S if self._speed_m_s is None else _TURN_M_S
        reach_m = _STILL_M + reach * elapsed_s
        gap = np.array([sighting.at_m for sighting in sightings]) - np.array(
            [track.at_m for track in self.tracks]
        ).reshape(-1, 1, 3)
        unseen_s = np.array([(self._at_s or 0.0) - track.seen_s for track in self.tracks])
        spread = np.array(
            [matching.SURFACE_SD_M, matching.SURFACE_SD_M, matching.SURFACE_DEPTH_SD_M]
        )
        variance = 2 * spread**2 + (_DRIFT_M_S * unseen_s[:, None, None]) ** 2
        crowd = _crowd(sightings, camera)
        shift_m = _likeliest_shift(gap, variance, crowd, predicted, reach_m)
        ratio = _place_ratio(gap - shift_m, variance, crowd, unknown=0.0)
        self._carry_on(shift_m)
        ratio += self._overlaps(sightings, camera)
        rows, columns = linear_sum_assignment(np.maximum(ratio, 0.0), maximize=True)
        likely = ratio[rows, columns] > 0
        pairs = np.stack([rows[likely], columns[likely]], axis=1)
        self._learn_speed(gap[rows[likely], columns[likely]], elapsed_s)
        return pairs

    def _overlaps(self, sightings: Sequence[Sighting], camera: Intrinsics) -> Array:
        """Return the log ratio from the mask overlap of each pair."""
        shares = np.zeros((len(self.tracks), len(sightings)))
        for i, track in enumerate(self.tracks):
            before = track.sighting.at_m
            shift_px = np.zeros(2)
            if np.isfinite(before).all() and before[2] + track.moved_m[2] > 0:
                shift_px = np.subtract(*camera.project([before + track.moved_m, before]))
            shares[i] = [track.sighting.overlap(sighting, shift_px) for sighting in sightings]
        return np.asarray(np.log((shares + _LEAST_OVERLAP) / (_HALF_OVERLAP + _LEAST_OVERLAP)))

    def _learn_speed(self, gap_m: Array, elapsed_s: float) -> None:
        gaps_m = gap_m[np.isfinite(gap_m).all(axis=1)]
        if len(gaps_m) and elapsed_s > 0:
            self._speed_m_s = np.median(gaps_m, axis=0) / elapsed_s


def _crowd(sightings: Sequence[Sighting], camera: Intrinsics) -> matching.Crowd:
    """Return the density of other fruit in a frame."""
    depths_m = np.array([sighting.at_m[2] for sighting in sightings])
    far_m = (
        float(np.median(depths_m[np.isfinite(depths_m)])) if np.isfinite(depths_m).any() else 0.6
    )
    across_m, up_m = far_m * camera.width / camera.fx_px, far_m * camera.height / camera.fy_px
    return matching.Crowd(
        per_m=max(len(sightings), 1) / across_m,
        up_m=up_m,
        depth_m=0.3,
        length_width=1.0,
        diameter_width=0.3,
    )


def _place_ratio(gap_m: Array, variance_m2: Array, crowd: matching.Crowd, unknown: float) -> Array:
    """Return the log ratio of positions; `unknown` if one of the two is NaN."""
    is_located: Mask = np.asarray(np.isfinite(gap_m).all(axis=-1))
    ratio = matching.position_ratio(np.where(is_located[..., None], gap_m, 0.0), variance_m2, crowd)
    return np.asarray(np.where(is_located, ratio, unknown))


def _likeliest_shift(
    gap_m: Array, variance_m2: Array, crowd: matching.Crowd, predicted_m: Array, reach_m: float
) -> Array:
    """Return the shift of all fruit in camera coordinates, shape (3,).

    Candidates are every pair's difference, and the shift predicted by the speed.
    """
    gaps = gap_m.reshape(-1, 3)
    tried = np.vstack([predicted_m, gaps[np.isfinite(gaps).all(axis=1)]])
    off = (tried - predicted_m) / reach_m
    left_m = gap_m[None] - tried[:, None, None]
    ratio = _place_ratio(left_m, variance_m2[None], crowd, unknown=-50.0)
    gain = np.log1p(np.exp(np.clip(ratio, -50.0, 20.0)).sum(axis=1))
    score = gain.sum(axis=1) - 0.5 * np.square(off).sum(axis=1)
    best = tried[int(score.argmax())]
    # Average the agreeing differences: a single pair's has its own error.
    agreeing = gaps[np.linalg.norm(gaps - best, axis=1) < 3 * matching.SURFACE_DEPTH_SD_M]
    return np.asarray(agreeing.mean(axis=0) if len(agreeing) else best)
