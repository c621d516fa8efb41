from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from cucumbervision.perception.masks import Rle, encode_rle

masks = hnp.arrays(bool, hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=40))


@settings(deadline=None, max_examples=80)
@given(masks)
def test_decoding_gives_the_mask_back(mask: NDArray[np.bool_]) -> None:
    code = Rle.of(mask)
    assert (code.decode() == mask).all()
    assert code.area_px == mask.sum()


@settings(deadline=None, max_examples=40)
@given(masks)
def test_the_string_is_pycocotools_own(mask: NDArray[np.bool_]) -> None:
    coco = pytest.importorskip("pycocotools.mask")
    wanted = coco.encode(np.asfortranarray(mask.astype(np.uint8)))["counts"]
    assert encode_rle(mask) == wanted.decode()


@settings(deadline=None, max_examples=5)
@given(st.integers(0, 2**32 - 1))
def test_long_runs(seed: int) -> None:
    # Differences of several characters, positive and negative.
    rng = np.random.default_rng(seed)
    mask = np.zeros((720, 1280), bool)
    for x, y, w, h in rng.integers(0, (1000, 500, 280, 220), (4, 4)):
        mask[y : y + h, x : x + w] ^= True
    assert (Rle.of(mask).decode() == mask).all()
