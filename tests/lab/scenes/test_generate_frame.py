import numpy as np
import pytest

from cucumbervision.tube.shape import polyline_length
from cucumbervision_lab.scenes.generate import Frame, FrameOptions, draw_frame, extras_of
from cucumbervision_lab.scenes.textures import load_assets

SMALL = FrameOptions(width=320, height=180, depth=False)
SENSED = FrameOptions(width=320, height=180)
ASSETS = load_assets(None)


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return [draw_frame(5, index, SMALL, ASSETS) for index in range(4)]


def test_the_same_seed_draws_the_same_pixels(frames: list[Frame]) -> None:
    again = draw_frame(5, 2, SMALL, ASSETS)
    np.testing.assert_array_equal(again.color, frames[2].color)
    assert again.depth_m is None
    assert not np.array_equal(draw_frame(6, 2, SMALL, ASSETS).color, again.color)


def test_with_depth_the_colours_are_the_same(frames: list[Frame]) -> None:
    sensed = draw_frame(5, 3, SENSED, ASSETS)
    np.testing.assert_array_equal(sensed.color, frames[3].color)
    np.testing.assert_array_equal(draw_frame(5, 3, SENSED, ASSETS).depth_m, sensed.depth_m)


def test_the_sensor_reads_what_is_there_to_a_few_millimetres() -> None:
    # The sensor's windows are pixels of a D435's 1280 x 720: no smaller picture would do.
    frame = draw_frame(5, 2, FrameOptions(), ASSETS)
    assert frame.depth_m is not None
    errors, filled = [], []
    for truth in frame.truth:
        if truth.visible.sum() > 2000:
            seen = truth.visible & (frame.depth_m > 0)
            errors.append(np.median(frame.depth_m[seen] - frame.exact_m[seen]))
            filled.append(seen.sum() / truth.visible.sum())
    assert len(errors) >= 3
    assert np.median(np.abs(errors)) < 0.005
    assert np.median(filled) > 0.9


def test_extras_hold_the_axis_and_its_length(frames: list[Frame]) -> None:
    for frame in frames:
        for truth in frame.truth:
            extras = extras_of(truth)
            axis = np.array(extras["axis_m"])
            # 41 points of a gentle bend lose next to nothing of its length.
            assert polyline_length(axis) == pytest.approx(extras["centreline_m"], rel=2e-3)
            assert max(extras["radius_m"]) == pytest.approx(truth.radius_m.max(), rel=0.03)
            assert 0 <= extras["tilt_deg"] <= 90
            ends = frame.camera.project(axis[[0, -1]])
            np.testing.assert_allclose(ends, truth.keypoints_px[[0, 4]], atol=0.05)
