from __future__ import annotations

import numpy as np
import pytest

from cucumbervision_lab.scenes.bodies import arc_tube, random_fruit


@pytest.mark.parametrize("length_m", [0.069, 0.1472, 0.2570, 0.38])
def test_random_fruit_have_the_length_asked_and_a_believable_thickness(length_m: float) -> None:
    rng = np.random.default_rng(7)
    low, high = {0.069: (1.1, 1.7), 0.1472: (1.4, 2.2), 0.2570: (1.9, 2.7), 0.38: (1.9, 2.7)}[
        length_m
    ]
    for _ in range(20):
        fruit = random_fruit(rng, length_m)
        assert fruit.centreline_m == pytest.approx(length_m, abs=1e-9)
        assert low < 100 * fruit.radii_m.max() < high
        assert fruit.chord_m <= fruit.centreline_m
        assert fruit.centreline_m <= fruit.thread_m < 1.25 * fruit.centreline_m
        slope = np.abs(np.diff(fruit.radii_m)) / np.linalg.norm(np.diff(fruit.centres_m, axis=0))
        assert slope.max() < 1.0


@pytest.mark.parametrize("bend_radius_m", [0.15, 0.40])
def test_a_bent_tube_by_hand(bend_radius_m: float) -> None:
    r, length = 0.018, 0.26
    tube = arc_tube(length, r, bend_radius_m)
    angle = (length - 2 * r) / bend_radius_m
    assert tube.thread_m == pytest.approx((bend_radius_m + r) * angle + 2 * r, rel=2e-4)
    # The poles lie r further along the tangents, which stand at half the angle to the chord.
    chord = 2 * bend_radius_m * np.sin(angle / 2) + 2 * r * np.cos(angle / 2)
    assert tube.chord_m == pytest.approx(chord, rel=1e-4)
