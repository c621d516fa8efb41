from __future__ import annotations

import numpy as np
import pytest

from cucumbervision_lab.evaluate.measure_case import disturb_mask, draw_disturbance


def disc(radius_px: float) -> np.ndarray[tuple[int, int], np.dtype[np.bool_]]:
    v, u = np.mgrid[0:200, 0:200]
    return np.asarray(np.hypot(u - 100, v - 100) <= radius_px)


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
