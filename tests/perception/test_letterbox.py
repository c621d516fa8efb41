from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cucumbervision.perception.letterbox import fit

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


def test_odd_padding_puts_the_smaller_half_first() -> None:
    # 5x10 to 10x10: no resizing, five spare rows: two above, three below.
    box = fit(5, 10, (10, 10))
    assert (box.top, box.inner_height) == (2, 5)


def test_rounded_sides_have_gains_of_their_own() -> None:
    # 427x640 to 320: gain 1/2, 213.5 rows become 214, so rows scale by 214/427.
    box = fit(427, 640, (320, 320))
    assert box.inner_height == 214
    corner = box.points_back(np.array([320.0, box.top + 214.0]))
    assert corner.tolist() == pytest.approx([639.5, 426.5])


def test_minimal_padding_reaches_the_next_stride() -> None:
    # 300x640 to 640: 300 rows, the next multiple of 32 is 320.
    box = fit(300, 640, (640, 640), minimal=True)
    assert (box.input_height, box.input_width, box.top) == (320, 640, 10)


def test_boxes_and_points_are_clipped_to_the_picture() -> None:
    box = fit(100, 100, (200, 200))
    back = box.boxes_back(np.array([[-10.0, 20, 500, 300]]))
    assert back.tolist() == [[-0.5, 9.5, 99.5, 99.5]]
    assert box.points_back(np.empty((0, 2))).shape == (0, 2)


@given(sides, sides, st.sampled_from([320, 640]))
@settings(max_examples=50, deadline=None)
def test_corners_come_back_exactly(height: int, width: int, size: int) -> None:
    box = fit(height, width, (size, size))
    corners = np.array(
        [
            [box.left, box.top],
            [box.left + box.inner_width, box.top + box.inner_height],
        ]
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


def test_mask_is_cut_by_its_box() -> None:
    box = fit(64, 64, (64, 64))
    # Edges from the corner: 10 to 20 and 30 to 33, so those pixels and no others.
    mask = box.mask_back(np.ones((1, 16, 16), np.float32), ONE, np.array([9.5, 29.5, 19.5, 32.5]))
    ys, xs = np.nonzero(mask)
    assert (xs.min(), xs.max(), ys.min(), ys.max()) == (10, 19, 30, 32)
    assert mask.sum() == 30


def test_grey_rows_lend_nothing_to_the_mask() -> None:
    # 64x32 into 64x64: 16 grey rows above and below, four prototype rows each. They are set, the
    # picture's own are not.
    box = fit(32, 64, (64, 64))
    logits = np.full((16, 16), -1, np.float32)
    logits[:4] = logits[12:] = 9
    assert not box.mask_back(logits[None], ONE, np.array([-0.5, -0.5, 63.5, 31.5])).any()


def test_prototypes_are_weighted_and_summed() -> None:
    # 2 - 3 < 0 on the left, where the second prototype is 1; 2 > 0 elsewhere.
    box = fit(64, 64, (64, 64))
    prototypes = np.ones((2, 16, 16), np.float32)
    prototypes[1, :, 8:] = -1
    edges = np.array([-0.5, -0.5, 63.5, 63.5])
    mask = box.mask_back(prototypes, np.array([2, -3], np.float32), edges)
    assert mask[:, 40:].all()
    assert not mask[:, :28].any()
