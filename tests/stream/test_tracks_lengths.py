"""What many frames make of a length, against what is worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

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


def test_one_frame_is_the_measurement_itself() -> None:
    known = TrackLength()
    given = length(0.25, shift=-0.03)  # an interval beside the length: the method reads long
    known.add(given, HERE)
    assert known.length is not None
    assert known.length.value_m == pytest.approx(0.25)
    assert known.length.low_m == pytest.approx(given.low_m)
    assert known.length.high_m == pytest.approx(given.high_m)


def test_frames_from_one_place_leave_the_fixed_part() -> None:
    known = TrackLength()
    for _ in range(1000):
        known.add(length(0.25), HERE)
    assert known.length is not None
    # 1000 frames: all but the fixed part of the own variance is gone, and the scale's stays.
    left = OWN_SD**2 * (FIXED + (1 - FIXED) / 1000) + SCALE**2
    assert relative_sd(known.length) == pytest.approx(np.sqrt(left), rel=1e-6)
    assert (known.frames, len(known.places)) == (1000, 1)


def test_a_second_place_halves_the_part_that_views_do_not_share() -> None:
    known = TrackLength()
    for place in (HERE, THERE):
        known.add(length(0.25), place, scale_known=False)
    assert known.length is not None
    # SHARED is a half: 0.5 + 0.5 / 2 of the own variance.
    assert relative_sd(known.length) == pytest.approx(np.sqrt(0.75 * OWN_SD**2 + SCALE**2))
    assert len(known.places) == 2


def test_places_that_disagree_widen_it() -> None:
    agreed, apart = TrackLength(), TrackLength()
    for place, value in ((HERE, 0.25), (THERE, 0.30)):
        agreed.add(length(0.25), place)
        apart.add(length(value), place)
    assert agreed.length is not None
    assert apart.length is not None
    assert apart.length.value_m == pytest.approx(np.sqrt(0.25 * 0.30))
    assert relative_sd(apart.length) > 3 * relative_sd(agreed.length)


def test_an_outline_that_flickers_widens_its_own_place() -> None:
    calm, restless = TrackLength(), TrackLength()
    for k in range(10):
        calm.add(length(0.25), HERE)
        restless.add(length(0.25 * (1.1 if k % 2 else 0.9)), HERE)
    assert calm.length is not None
    assert restless.length is not None
    assert relative_sd(restless.length) > 1.5 * relative_sd(calm.length)


def test_a_known_scale_is_not_added() -> None:
    known = TrackLength()
    known.add(length(0.25, OWN_SD), HERE, scale_known=True)
    assert known.length is not None
    assert relative_sd(known.length) == pytest.approx(OWN_SD)


def test_lower_bounds_count_until_the_whole_fruit_is_seen() -> None:
    known = TrackLength()
    for value in (0.10, 0.18, 0.14):
        known.add(length(value), HERE, partial=True)
    assert (known.length, known.at_least_m) == (None, 0.18)
    known.add(length(0.25), HERE)
    assert known.length is not None
    assert known.length.value_m == pytest.approx(0.25)


def test_a_tube_goes_before_raw_lengths_which_are_another_thing() -> None:
    known = TrackLength()
    raw = Length(0.21, LengthKind.SURFACE_ARC, 0.20, 0.24, LengthDefinition.CENTRELINE)
    known.add(raw, HERE)
    known.add(length(0.25), HERE)
    known.add(raw, HERE)
    assert known.length is not None
    assert known.length.value_m == pytest.approx(0.25)
    assert (known.frames, known.kind) == (1, LengthDefinition.THREAD)


def test_a_length_without_an_interval_is_unsure() -> None:
    known = TrackLength()
    known.add(Length(0.25, LengthDefinition.THREAD), HERE)
    assert known.length is not None
    assert relative_sd(known.length) == pytest.approx(0.08, rel=0.01)
