"""Captures to read and to write."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.tube.camera import Distortion


@pytest.fixture
def capture() -> Capture:
    """A small capture in which no two parts are alike."""
    rng = np.random.default_rng(3)
    mask = np.zeros((48, 64), bool)
    mask[20:30, 10:50] = True
    return Capture(
        rng.integers(0, 256, (48, 64, 3), dtype=np.uint8),
        (rng.integers(300, 900, (48, 64)) * 0.001).astype(np.float32),
        Intrinsics(
            64,
            48,
            60.5,
            60.25,
            31.5,
            24.5,
            distortion=Distortion.INVERSE_BROWN_CONRADY,
            coefficients=(0.1, -0.05, 0.001, -0.002, 0.01),
        ),
        name="row3_left_2",
        frame=17,
        burst_frame=2,
        burst_size=5,
        masks=(mask, ~mask),
        stop=Stop(row="3", side="left", position_m=4.5, step=2),
        timestamp_s=1_700_000_000.25,
        simulated=True,
        source="made here",
        provenance={"camera": "D435", "serial": "1234"},
    )


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real captures; tests that need it are skipped without it."""
    folder = os.environ.get("CUCUMBERVISION_DATA", "")
    if not folder or not Path(folder).is_dir():
        pytest.skip("CUCUMBERVISION_DATA names no folder of real captures")
    return Path(folder)
