from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision_lab.benchmark.measure_case import (
    disturb_mask,
    draw_disturbance,
    end_shift_px,
    oracle_length_m,
)
from cucumbervision_lab.synthesis.bodies import arc_tube, rotation
from cucumbervision_lab.synthesis.scene import FruitTruth, Scene, truth_of


class NoRounding(np.random.Generator):
    """Chance that always draws the middle of a range."""

    def uniform(self, low: float = 0.0, high: float = 1.0, size: object = None) -> float:  # type: ignore[override]
        return (low + high) / 2


STILL = NoRounding(np.random.PCG64(0))


def fruit(camera: Intrinsics, tilt_deg: float = 0.0) -> FruitTruth:
    tube = arc_tube(0.20, 0.018).moved(rotation(tilt_deg=tilt_deg), (0, 0, 0.5))
    return truth_of(Scene((tube,)), camera)[0]


def test_the_exact_mask_gives_the_true_length(camera: Intrinsics) -> None:
    truth = fruit(camera)
    assert oracle_length_m(truth, truth.visible, camera, STILL) == pytest.approx(0.20)


@pytest.mark.parametrize(("tilt_deg", "rel"), [(0.0, 0.25), (40.0, 0.3)])
def test_both_ends_grow_by_the_outlines_shift(
    camera: Intrinsics, tilt_deg: float, rel: float
) -> None:
    truth = fruit(camera, tilt_deg)
    even = np.full(truth.visible.shape, 3.0, np.float32)
    length = oracle_length_m(truth, disturb_mask(truth.visible, even), camera, STILL)
    by_hand = 2 * 3 * 0.5 / 910 / np.cos(np.deg2rad(tilt_deg))
    assert length - 0.20 == pytest.approx(by_hand, rel=rel)  # the pixel grid: a third of 3 px


def test_an_end_that_the_mask_misses_is_known() -> None:
    exact = np.zeros((20, 60), bool)
    exact[8:13, 10:40] = True
    none = np.zeros_like(exact)
    back, tip = np.array([30.0, 10.0]), np.array([39.5, 10.0])
    assert end_shift_px(exact, none, back, tip) is None
    assert end_shift_px(exact, exact, back, back) is None


def test_rounding_is_drawn_within_half_a_pixel(camera: Intrinsics) -> None:
    truth = fruit(camera)
    errors = [
        oracle_length_m(truth, truth.visible, camera, np.random.default_rng(k)) - 0.20
        for k in range(40)
    ]
    assert np.abs(errors).max() <= 2 * 0.5 * 0.5 / 910 + 1e-9
    assert np.std(errors) > 1e-4


def disc(radius_px: float) -> np.ndarray[tuple[int, int], np.dtype[np.bool_]]:
    v, u = np.mgrid[0:200, 0:200]
    return np.asarray(np.hypot(u - 100, v - 100) <= radius_px)


@pytest.mark.parametrize("shift", [-3.0, 0.0, 3.0])
def test_an_even_shift_changes_the_radius(shift: float) -> None:
    moved = disturb_mask(disc(50), np.full((200, 200), shift, np.float32))
    radius = np.sqrt(moved.sum() / np.pi)
    assert radius == pytest.approx(50 + shift, abs=0.4)


def test_no_shift_changes_nothing() -> None:
    assert (disturb_mask(disc(50), np.zeros((200, 200), np.float32)) == disc(50)).all()


def test_the_outline_moves_by_the_field_where_it_stands() -> None:
    shift = np.zeros((200, 200), np.float32)
    shift[:, 100:] = 4
    moved = disturb_mask(disc(50), shift)
    columns = np.flatnonzero(moved[100])
    assert columns[0] == 50
    assert columns[-1] == 154


def test_the_outline_error_has_the_asked_rms() -> None:
    field = draw_disturbance((200, 200), 1.5, np.random.default_rng(5))
    moved = disturb_mask(disc(60), field)
    rays = np.deg2rad(np.arange(0, 360, 2))
    steps = np.arange(40.0, 80.0, 0.1)
    errors = []
    for ray in rays:
        u = np.rint(100 + steps * np.cos(ray)).astype(int)
        v = np.rint(100 + steps * np.sin(ray)).astype(int)
        errors.append(steps[np.flatnonzero(moved[v, u])[-1]] - 60)
    assert np.std(errors) == pytest.approx(1.5, rel=0.3)
