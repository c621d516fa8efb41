"""For the tests and for the docstrings' examples."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec

import numpy as np
import pytest

# The pages import Streamlit as they load, so that without it there is nothing to collect.
collect_ignore_glob = [] if find_spec("streamlit") else ["src/cucumbervision/dashboard/*"]
# The examples of these compute with torch.
if not find_spec("torch"):
    training = "src/cucumbervision_lab/training"
    collect_ignore_glob += [f"{training}/ends.py", f"{training}/points.py"]


@pytest.fixture(autouse=True)
def _plain_numbers() -> Iterator[None]:
    """Print arrays as NumPy does, whatever a library that was imported has set."""
    with np.printoptions(formatter=None, linewidth=75, precision=8, suppress=False):
        yield
