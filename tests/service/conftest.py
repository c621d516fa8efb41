"""The measurer of a service, and a capture to send to it."""

from __future__ import annotations

import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.run.measurer import Measurer
from cucumbervision.run.options import MeasureOptions


@pytest.fixture(scope="module")
def bench() -> Capture:
    return next(iter(open_source(example_captures() / "simulated-bench"))).load()


@pytest.fixture
def measurer() -> Measurer:
    return Measurer(MeasureOptions(instances="dataset"))
