from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cucumbervision.calibration.corrections import fit_depth_scale
from cucumbervision.capture.intrinsics import Intrinsics


@settings(deadline=None)
@given(scale=st.floats(0.95, 1.05), tilt=st.floats(-1.2, 1.2), far=st.floats(0.4, 1.2))
def test_a_scaled_depth_scales_every_length_wherever_the_bar_lies(
    scale: float, tilt: float, far: float
) -> None:
    camera = Intrinsics(1280, 720, 910.0, 905.0, 640.0, 360.0)
    half = 0.25 * np.array([np.cos(tilt), 0.3, np.sin(tilt)])
    ends = np.array([0.02, 0.01, far]) + np.array([[-1.0], [1.0]]) * half
    pixels = ends[:, :2] / ends[:, 2:] * (910.0, 905.0) + (640.0, 360.0)
    x, y = camera.rays(pixels[:, 0], pixels[:, 1])
    seen = np.stack([x, y, np.ones(2)], axis=1) * (scale * ends[:, 2:])
    true = float(np.linalg.norm(ends[1] - ends[0]))
    read = float(np.linalg.norm(seen[1] - seen[0]))
    assert fit_depth_scale([read] * 3, true).value == pytest.approx(scale, rel=1e-9)


def test_uncertainty_by_hand() -> None:
    found = fit_depth_scale([0.49, 0.50, 0.51], 0.50, pixel_m=0.0005)
    # Ratios 0.98, 1, 1.02: sd 0.02; two ends of 0.7 px of 0.5 mm on 500 mm: 0.00099.
    assert found.value == pytest.approx(1.0)
    assert found.spread == pytest.approx(0.02)
    ends = 2**0.5 * 0.7 * 0.0005 / 0.5
    assert found.standard_error == pytest.approx((0.02**2 / 3 + ends**2) ** 0.5)


@pytest.mark.parametrize("lengths", [[0.5, 0.5], [0.5, 0.5, -0.5]])
def test_too_little_is_refused(lengths: list[float]) -> None:
    with pytest.raises(ValueError, match="3 captures"):
        fit_depth_scale(lengths, 0.5)
