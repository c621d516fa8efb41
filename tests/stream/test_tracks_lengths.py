"""What many frames make of a length, against what is worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.arrays import Array
from cucumbervision.methods.result import INTERVAL_Z, Length, LengthDefinition, LengthKind
from cucumbervision.stream.tracks import FIXED, TrackLength

HERE, THERE = np.array([0.0, 0.0, 0.5]), np.array([0.2, 0.0, 0.5])
SCALE = 0.01
OWN_SD = 0.02


def length(value_m: float, sd: float = np.hypot(OWN_SD, SCALE), shift: float = 0.0) -> Length:
    """A length whose interval is that of a relative standard deviation."""
    low, high = value_m * np.exp(shift + INTERVAL_Z * sd * np.array([-1, 1]))
    return Length(value_m, LengthDefinition.THREAD, float(low), float(high))


def relative_sd(one: Length) -> float:
    return one.relative_sd or 0.0


def after(*frames: tuple[Length, Array], **how: bool) -> tuple[TrackLength, Length]:
    """Return a track after frames of the whole fruit, and its length."""
    track = TrackLength()
    for frame, place in frames:
        track.add(frame, place, **how)
    assert track.length is not None
    return track, track.length


def test_one_frame_is_the_measurement_itself() -> None:
    given = length(0.25, shift=-0.03)  # an interval beside the length: the method reads long
    _, known = after((given, HERE))
    assert (known.value_m, known.low_m, known.high_m) == pytest.approx(
        (0.25, given.low_m, given.high_m)
    )


def test_frames_from_one_place_leave_the_fixed_part() -> None:
    track, known = after(*[(length(0.25), HERE)] * 1000)
    # 1000 frames: all but the fixed part of the own variance is gone, and the scale's stays.
    left = OWN_SD**2 * (FIXED + (1 - FIXED) / 1000) + SCALE**2
    assert relative_sd(known) == pytest.approx(np.sqrt(left), rel=1e-6)
    assert (track.frames, len(track.places)) == (1000, 1)


def test_a_second_place_halves_the_part_that_views_do_not_share() -> None:
    track, known = after((length(0.25), HERE), (length(0.25), THERE), scale_known=False)
    # SHARED is a half: 0.5 + 0.5 / 2 of the own variance.
    assert relative_sd(known) == pytest.approx(np.sqrt(0.75 * OWN_SD**2 + SCALE**2))
    assert len(track.places) == 2


def test_places_that_disagree_widen_it() -> None:
    _, agreed = after((length(0.25), HERE), (length(0.25), THERE))
    _, apart = after((length(0.25), HERE), (length(0.30), THERE))
    assert apart.value_m == pytest.approx(np.sqrt(0.25 * 0.30))
    assert relative_sd(apart) > 3 * relative_sd(agreed)


def test_an_outline_that_flickers_widens_its_own_place() -> None:
    _, calm = after(*[(length(0.25), HERE)] * 10)
    _, restless = after(*[(length(0.25 * factor), HERE) for factor in (0.9, 1.1) * 5])
    assert relative_sd(restless) > 1.5 * relative_sd(calm)


def test_a_known_scale_is_not_added() -> None:
    _, known = after((length(0.25, OWN_SD), HERE), scale_known=True)
    assert relative_sd(known) == pytest.approx(OWN_SD)


def test_lower_bounds_count_until_the_whole_fruit_is_seen() -> None:
    track = TrackLength()
    for value in (0.10, 0.18, 0.14):
        track.add(length(value), HERE, partial=True)
    assert (track.length, track.at_least_m) == (None, 0.18)
    track.add(length(0.25), HERE)
    assert track.length is not None
    assert track.length.value_m == pytest.approx(0.25)


def test_a_tube_goes_before_raw_lengths_which_are_another_thing() -> None:
    raw = Length(0.21, LengthKind.SURFACE_ARC, 0.20, 0.24, LengthDefinition.CENTRELINE)
    track, known = after((raw, HERE), (length(0.25), HERE), (raw, HERE))
    assert known.value_m == pytest.approx(0.25)
    assert (track.frames, track.kind) == (1, LengthDefinition.THREAD)


def test_a_length_without_an_interval_is_unsure() -> None:
    _, known = after((Length(0.25, LengthDefinition.THREAD), HERE))
    assert relative_sd(known) == pytest.approx(0.08, rel=0.01)
