from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from cucumbervision.perception.masks import decode_rle, encode_rle

MASKS = st.tuples(st.integers(1, 12), st.integers(1, 60)).flatmap(lambda size: arrays(bool, size))


@given(MASKS)
def test_what_is_written_reads_back(mask: NDArray[np.bool_]) -> None:
    assert np.array_equal(decode_rle(encode_rle(mask), *mask.shape), mask)


def test_the_characters_are_pycocotools_own() -> None:
    coder = pytest.importorskip("pycocotools.mask")
    rng = np.random.default_rng(7)
    masks = [rng.random((40, 70)) < share for share in (0.0, 0.02, 0.5, 0.98, 1.0)]
    # Runs of thousands of pixels, and ones much shorter than the last but one.
    masks.append(np.zeros((300, 400), bool))
    masks[-1][20:220, 100:102] = masks[-1][250:252, 300] = True
    for mask in masks:
        theirs = coder.encode(np.asfortranarray(mask.astype(np.uint8)))
        assert encode_rle(mask) == theirs["counts"].decode("ascii")
