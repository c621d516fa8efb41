from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cucumbervision_lab.benchmark.cases import (
    CAMERA,
    PAPER_THREADS_CM,
    build_fruit,
    nearest_m,
    paper_cases,
    simulate,
    stress_cases,
    validation_cases,
)


def test_the_same_case_is_always_the_same() -> None:
    case = stress_cases(1, first=5)[0]
    one, other = (simulate(case) for _ in range(2))
    assert (one.capture.depth_m == other.capture.depth_m).all()
    assert one.depth_scale == other.depth_scale


def test_fruit_are_as_long_as_their_cases_say() -> None:
    for case in (*paper_cases(7), *validation_cases()):
        assert build_fruit(case).thread_m == pytest.approx(case.length_m, rel=0.004)
    for case in stress_cases(5):
        assert build_fruit(case).centreline_m == pytest.approx(case.length_m, rel=1e-4)
    assert [c.length_m * 100 for c in paper_cases(7)] == pytest.approx(PAPER_THREADS_CM)


def test_whole_fruit_fit_into_the_picture() -> None:
    assert nearest_m(0.2, 0) == pytest.approx(0.2 * 910.22 / (0.86 * 1280))
    cut = [
        simulate(case, frames=1).truth.cut_off for case in (*validation_cases(), *stress_cases(10))
    ]
    assert sum(cut) <= 1
    assert CAMERA.width == 1280


def test_hiding_leaves_hide_about_what_was_asked() -> None:
    hidden = [c for c in stress_cases(60) if c.hidden_share > 0.1][:8]
    for case in hidden:
        assert simulate(case, frames=1).truth.hidden_share == pytest.approx(
            case.hidden_share, abs=0.2
        )


def test_the_nearest_distance_leaves_room_about_a_tilted_fruit() -> None:
    # By hand: 20 cm upright and tilted by 30 degrees are 17.3 cm high, and 5 cm nearer at one end.
    upright = 0.2 * np.cos(np.pi / 6) * 910.39 / (0.86 * 720) + 0.05
    assert nearest_m(0.2, 90, 30) == pytest.approx(upright)
    assert nearest_m(0.2, 90, -30) == pytest.approx(upright)


def test_sun_and_wet_leaves_cost_readings_and_hide_no_fruit() -> None:
    plain = replace(stress_cases(1, first=7)[0], condition="plain", hidden_share=0.0)
    fill = {}
    for condition in ("plain", "sun", "wet"):
        taken = simulate(replace(plain, condition=condition), frames=2)
        fill[condition] = (taken.capture.depth_m[taken.truth.visible] > 0).mean()
        assert taken.truth.visible.sum() == simulate(plain, frames=1).truth.visible.sum()
    assert fill["plain"] - fill["sun"] == pytest.approx(0.1, abs=0.05)
    assert fill["plain"] - fill["wet"] == pytest.approx(0.3, abs=0.08)


def test_a_case_keeps_its_fruit_whatever_is_measured_of_it() -> None:
    first, again = paper_cases(8)[0], paper_cases(8)[7]
    assert first.fruit == again.fruit
    np.testing.assert_array_equal(build_fruit(first).axis_m, build_fruit(again).axis_m)
    assert first.distance_m != again.distance_m
    assert {case.hidden_share for case in paper_cases()} == {0.0}


def test_colours_are_painted_only_where_networks_look() -> None:
    case = paper_cases(1)[0]
    black, painted = simulate(case, frames=1), simulate(case, frames=1, paint=True)
    assert not black.capture.color.any()
    np.testing.assert_array_equal(black.capture.depth_m, painted.capture.depth_m)
    fruit = painted.capture.color[painted.truth.visible].astype(float).mean(axis=0)
    # Cucumbers are green in any light.
    assert fruit[1] > max(fruit[0], fruit[2])
