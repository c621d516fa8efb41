from __future__ import annotations

import cv2
import numpy as np
import pytest

from cucumbervision.arrays import Array32
from cucumbervision.networks.sam import mask_from_logits, prepare_picture, rows_needed, scaled_size


@pytest.mark.parametrize("size", [(576, 1024), (720, 1280), (300, 400)])
def test_red_is_first_and_normalised_by_its_own_spread(size: tuple[int, int]) -> None:
    picture = np.full((*size, 3), (200, 100, 50), np.uint8)
    height, width = scaled_size(*size)
    inside = prepare_picture(picture)[0, :, :height, :width]
    by_hand = [(200 - 123.675) / 58.395, (100 - 116.28) / 57.12, (50 - 103.53) / 57.375]
    for plane, value in zip(inside, by_hand, strict=True):
        np.testing.assert_allclose(plane, value, atol=1e-5)


def test_shrinking_smooths_as_pillow_does() -> None:
    # To half: a triangle four pixels wide on each, 1/8, 3/8, 3/8, 1/8.
    picture = np.zeros((2, 2048, 3), np.uint8)
    picture[:, 1000] = 255
    row = prepare_picture(picture)[0, 0, 0] * 58.395 + 123.675
    np.testing.assert_allclose(row[498:502], [0, 32, 96, 0], atol=1e-3)


def test_a_sliver_is_smoothed_along_its_length() -> None:
    # Two rows stay two, but 2048 columns become 1024: the comb of single pixels turns grey.
    picture = np.zeros((2, 2048, 3), np.uint8)
    picture[:, ::2] = 255
    row = prepare_picture(picture)[0, 0, 0, 1:-1] * 58.395 + 123.675
    np.testing.assert_allclose(row, 128, atol=1e-3)


def two_steps(logits: Array32, height: int, width: int) -> Array32:
    """SAM's own way: the whole square to 1024, without the padding, to the picture's size."""
    rows, columns = scaled_size(height, width)
    square = cv2.resize(logits, (1024, 1024), interpolation=cv2.INTER_LINEAR)
    cut = np.ascontiguousarray(square[:rows, :columns])
    return np.asarray(cv2.resize(cut, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


@pytest.mark.parametrize("size", [(720, 1280), (480, 640), (640, 480), (101, 37), (1500, 2000)])
@pytest.mark.parametrize("shift", [0.0, -2.0])
def test_masks_equal_the_two_steps(size: tuple[int, int], shift: float) -> None:
    rng = np.random.default_rng(7)
    blobs = cv2.GaussianBlur(rng.normal(size=(256, 256)), (0, 0), 9).astype(np.float32)
    logits = np.asarray(blobs / blobs.std() + shift, np.float32)
    wanted = two_steps(logits, *size)
    sure = np.abs(wanted) > 1e-3
    assert sure.mean() > 0.99
    assert np.array_equal(mask_from_logits(logits, *size)[sure], (wanted > 0)[sure])


@pytest.mark.parametrize("size", [(720, 1280), (480, 848), (101, 370)])
def test_padding_rows_may_be_left_out(size: tuple[int, int]) -> None:
    rows = rows_needed(*size)
    assert rows % 16 == 0
    assert 0 <= rows - scaled_size(*size)[0] < 16
    # Everything below the picture's own rows is nought.
    assert not prepare_picture(np.full((*size, 3), 200, np.uint8))[:, :, rows:].any()
    blobs = cv2.GaussianBlur(np.random.default_rng(7).normal(size=(256, 256)), (0, 0), 9)
    logits = np.asarray(blobs / blobs.std(), np.float32)
    logits[rows // 4 :] = logits[rows // 4 - 1]
    whole, short = mask_from_logits(logits, *size), mask_from_logits(logits[: rows // 4], *size)
    assert np.array_equal(whole, short)
    assert whole[-1].any()
