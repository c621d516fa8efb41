from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.methods.traits import tube_traits
from cucumbervision_lab.scenes.bodies import arc_tube, bent_tube, rotation


def test_traits_of_a_drawn_fruit_are_its_truth() -> None:
    tube = arc_tube(0.24, 0.02, 0.25, neck=0.3).moved(rotation(30, 40, 70), (0.05, 0.0, 0.6))
    traits = tube_traits(tube.centres_m, tube.radii_m)
    assert traits.lengths.centreline_m == pytest.approx(tube.centreline_m, rel=1e-6)
    assert traits.lengths.chord_m == pytest.approx(tube.chord_m, rel=1e-6)
    assert traits.lengths.thread_m == pytest.approx(tube.thread_m, rel=2e-3)
    assert traits.diameter_max_m == pytest.approx(0.04, rel=1e-3)
    np.testing.assert_allclose(traits.axis_m[[0, -1]], tube.poles_m, atol=1e-9)


def test_means_and_volume_of_a_capsule_by_hand() -> None:
    tube = arc_tube(0.20, 0.02)
    traits = tube_traits(tube.centres_m, tube.radii_m)
    volume = np.pi * 0.02**2 * 0.16 + 4 / 3 * np.pi * 0.02**3
    # Half an ellipse's mean height is pi/4 of its peak: both ends together 4 cm of such.
    mean = (0.04 * 0.16 + np.pi / 4 * 0.04 * 0.04) / 0.20
    assert traits.volume_m3 == pytest.approx(volume, rel=2e-3)
    assert traits.diameter_mean_m == pytest.approx(mean, rel=3e-3)


def test_tilt_is_the_chords_angle_to_the_picture() -> None:
    for tilt in (0.0, 25.0, -60.0):
        tube = arc_tube(0.20, 0.02).moved(rotation(10, tilt), (0, 0, 0.6))
        traits = tube_traits(tube.centres_m, tube.radii_m)
        assert traits.tilt_deg == pytest.approx(abs(tilt), abs=1e-6)


@pytest.mark.parametrize(
    ("tilt_deg", "end_m", "hides"),
    [(30, 0.005, False), (50, 0.005, True), (-50, 0.005, True), (50, 0.02, False)],
)
def test_a_spindle_that_points_away_may_hide_an_end(
    tilt_deg: float, end_m: float, hides: bool
) -> None:
    # Straight, 1 cm thick at the ends and 4 cm in the middle: its sides slope by 8.5 degrees, and
    # perspective adds some 5, to 30 + 14 or 50 + 14 degrees. An even bar hides nothing.
    radii = np.interp(np.linspace(-1, 1, 401), [-1, 0, 1], [end_m, 0.02, end_m])
    tube = bent_tube(0.20, radii, 0 * radii).moved(rotation(0, tilt_deg), (0, 0, 0.6))
    assert tube_traits(tube.centres_m, tube.radii_m).may_hide_an_end is hides


def test_inner_arc_for_each_10_cm_of_chord() -> None:
    tube = arc_tube(0.30, 0.015, 0.15)
    traits = tube_traits(tube.centres_m, tube.radii_m)
    angle = (0.30 - 0.03) / 0.15 / 2
    rise = 0.135 - (0.15 * np.cos(angle) - 0.015 * np.sin(angle))
    assert traits.inner_arc_m == pytest.approx(rise, abs=1e-4)
    assert traits.inner_arc_mm_per_10cm == pytest.approx(100 * rise / tube.chord_m, rel=2e-3)


def test_radii_below_nothing_are_no_body() -> None:
    x = np.linspace(0, 0.1, 50)
    radii = np.linspace(0.02, -0.01, 50)
    traits = tube_traits(np.stack([x, 0 * x, 0 * x + 0.5], axis=1), radii)
    assert np.isfinite([traits.lengths.thread_m, traits.volume_m3]).all()
    assert (traits.diameter_m >= 0).all()
