from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("streamlit")

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.mask_codes import encode_rle
from cucumbervision_greenhouse.pages.fruit import point_cloud
from cucumbervision_greenhouse.store.records import FruitRow

CAMERA = Intrinsics(80, 60, 100.0, 100.0, 39.5, 29.5)


@pytest.fixture
def plane() -> tuple[Capture, FruitRow]:
    """A fruit of 10 by 20 pixels, half a metre away, before a wall a metre away."""
    color = np.full((60, 80, 3), (10, 120, 30), np.uint8)
    depth_m = np.full((60, 80), 1.0, np.float32)
    mask = np.zeros((60, 80), bool)
    mask[20:40, 30:40] = True
    depth_m[mask] = 0.5
    depth_m[25, 35] = 0.0  # no reading
    record = FruitRow(1, mask=encode_rle(mask), stem_x_m=0.0, stem_y_m=-0.05, stem_z_m=0.5)
    return Capture(color, depth_m, CAMERA, name="a"), record


def test_one_reading_far_behind_does_not_make_the_fruit_small(
    plane: tuple[Capture, FruitRow],
) -> None:
    capture, record = plane
    near = point_cloud(capture, record)
    depth_m = capture.depth_m.copy()
    depth_m[30, 35] = 4.0
    far = point_cloud(replace(capture, depth_m=depth_m), record)
    assert near is not None
    assert far is not None
    zoom = [deck.initial_view_state.zoom for deck in (near, far)]
    assert zoom[0] == pytest.approx(zoom[1], abs=0.1)
    marks = near.layers[1].data
    assert [mark["color"] for mark in marks] == [(240, 228, 66)]  # the stem end alone is known


def test_without_mask_or_depth_there_is_nothing(plane: tuple[Capture, FruitRow]) -> None:
    capture, record = plane
    assert point_cloud(capture, record.with_(mask=None)) is None
    assert point_cloud(replace(capture, depth_m=np.zeros_like(capture.depth_m)), record) is None
