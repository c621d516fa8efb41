"""For the tests and for the docstrings' examples."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest


@pytest.fixture(autouse=True)
def _plain_numbers() -> Iterator[None]:
    """Print arrays as NumPy does, whatever a library that was imported has set."""
    with np.printoptions(formatter=None, linewidth=75, precision=8, suppress=False):
        yield
