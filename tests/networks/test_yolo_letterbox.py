from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cucumbervision.networks.yolo import fit

ONE = np.ones(1, np.float32)  # the weight of a single prototype

sides = st.integers(1, 1500)


def test_wide_picture_by_hand() -> None:
    # 1280x720 to 640x640: gain 1/2, 360 rows, 280 spare, 140 above.
    box = fit(720, 1280, (640, 640))
    picture = np.full((720, 1280, 3), 200, np.uint8)
    out = box.apply(picture)
    assert out.shape == (640, 640, 3)
    assert (out[140:500] == 200).all()
    assert (out[:140] == 114).all()
    assert (out[500:] == 114).all()


def test_rounded_sides_have_gains_of_their_own() -> None:
    # 427x640 to 320: gain 1/2, 213.5 rows become 214, so rows scale by 214/427.
    box = fit(427, 640, (320, 320))
    assert box.inner_height == 214
    corner = box.points_back(np.array([320.0, box.top_px + 214.0]))
    assert corner.tolist() == pytest.approx([639.5, 426.5])


@given(sides, sides, st.sampled_from([320, 640]))
@settings(max_examples=50, deadline=None)
def test_corners_come_back_exactly(height: int, width: int, size: int) -> None:
    box = fit(height, width, (size, size))
    corners = np.array(
        [[box.left_px, box.top_px], [box.left_px + box.inner_width, box.top_px + box.inner_height]]
    )
    expected = [[-0.5, -0.5], [width - 0.5, height - 0.5]]
    assert np.allclose(box.points_back(corners), expected, atol=1e-9)


def test_mask_of_a_half_plane_lies_where_its_edge_is() -> None:
    # 640x320 into 320x320 (gain 1/2, 80 grey rows): a prototype pixel is 8 picture pixels.
    # Logits rise by 1 a prototype column and are 0 between columns 19 and 20 (column edge 20),
    # which is picture column edge 160.
    box = fit(320, 640, (320, 320))
    logits = np.tile(np.arange(80) - 19.5, (80, 1)).astype(np.float32)
    mask = box.mask_back(logits[None], ONE, np.array([-0.5, -0.5, 639.5, 319.5]))
    assert mask.shape == (320, 640)
    assert not mask[:, :160].any()
    assert mask[:, 160:].all()


def test_grey_rows_lend_nothing_to_the_mask() -> None:
    # 64x32 into 64x64: 16 grey rows above and below, four prototype rows each. They are set, the
    # picture's own are not.
    box = fit(32, 64, (64, 64))
    logits = np.full((16, 16), -1, np.float32)
    logits[:4] = logits[12:] = 9
    assert not box.mask_back(logits[None], ONE, np.array([-0.5, -0.5, 63.5, 31.5])).any()
