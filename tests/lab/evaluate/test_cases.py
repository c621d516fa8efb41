from __future__ import annotations

from dataclasses import replace

import pytest

from cucumbervision_lab.evaluate.cases import (
    PAPER_THREADS_CM,
    build_fruit,
    paper_cases,
    simulate,
    stress_cases,
    validation_cases,
)


def test_fruit_are_as_long_as_their_cases_say() -> None:
    for case in (*paper_cases(7), *validation_cases()):
        assert build_fruit(case).thread_m == pytest.approx(case.length_m, rel=0.004)
    for case in stress_cases(5):
        assert build_fruit(case).centreline_m == pytest.approx(case.length_m, rel=1e-4)
    assert [c.length_m * 100 for c in paper_cases(7)] == pytest.approx(PAPER_THREADS_CM)


def test_hiding_leaves_hide_about_what_was_asked() -> None:
    hidden = [c for c in stress_cases(60) if c.hidden_share > 0.1][:8]
    for case in hidden:
        assert simulate(case, frames=1).truth.hidden_share == pytest.approx(
            case.hidden_share, abs=0.2
        )


def test_sun_and_wet_leaves_cost_readings_and_hide_no_fruit() -> None:
    plain = replace(stress_cases(1, first=7)[0], condition="plain", hidden_share=0.0)
    fill = {}
    for condition in ("plain", "sun", "wet"):
        taken = simulate(replace(plain, condition=condition), frames=2)
        fill[condition] = (taken.capture.depth_m[taken.truth.visible] > 0).mean()
        assert taken.truth.visible.sum() == simulate(plain, frames=1).truth.visible.sum()
    assert fill["plain"] - fill["sun"] == pytest.approx(0.1, abs=0.05)
    assert fill["plain"] - fill["wet"] == pytest.approx(0.3, abs=0.08)
