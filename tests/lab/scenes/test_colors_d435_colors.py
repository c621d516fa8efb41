"""Colours of a D435: greyer leaves, other each time, the same for the same seed."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision_lab.scenes.colors import d435_colors


def canopy() -> NDArray[np.uint8]:
    """Return green noise about a leaf's colour."""
    rng = np.random.default_rng(0)
    return np.clip(rng.normal((70, 150, 50), 25, (90, 160, 3)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("seed", range(8))
def test_leaves_lose_most_of_their_green(seed: int) -> None:
    # Green over red and blue: 90 before. The six captures' mean colour, Lab 47, -2, 9, has about 3.
    before, after = canopy(), d435_colors(canopy(), np.random.default_rng(seed))
    red, green, blue = after.reshape(-1, 3).mean(0)
    assert after.shape == before.shape
    assert after.dtype == np.uint8
    assert green - (red + blue) / 2 < 45
