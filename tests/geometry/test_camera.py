from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cucumbervision.geometry.camera import (
    Distortion,
    distort,
    scale_error,
    scale_error_tilted,
    undistort,
)

# Of the size that a D455's colour stream has, and larger.
COEFFICIENTS = (-0.056, 0.067, 0.0008, -0.0007, -0.021)
PIXELS = [(u, v) for u in (0.0, 200.5, 640.0, 1279.0) for v in (0.0, 333.25, 719.0)]


def sdk_lens(model: Distortion) -> tuple[Any, Any]:
    rs = pytest.importorskip("pyrealsense2")
    lens = rs.intrinsics()
    lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = 1280, 720, 910, 911, 645, 366
    lens.model, lens.coeffs = getattr(rs.distortion, model.value), list(COEFFICIENTS)
    return rs, lens


@pytest.mark.parametrize("model", [Distortion.BROWN_CONRADY, Distortion.INVERSE_BROWN_CONRADY])
def test_rays_are_the_sdks(model: Distortion) -> None:
    rs, lens = sdk_lens(model)
    for u, v in PIXELS:
        expected = rs.rs2_deproject_pixel_to_point(lens, [u, v], 1.0)
        x, y = undistort(np.array((u - 645) / 910), np.array((v - 366) / 911), model, COEFFICIENTS)
        assert (float(x), float(y)) == pytest.approx(tuple(expected[:2]), abs=2e-6)


@pytest.mark.parametrize("model", [Distortion.BROWN_CONRADY, Distortion.INVERSE_BROWN_CONRADY])
def test_projection_is_the_sdks(model: Distortion) -> None:
    rs, lens = sdk_lens(model)
    for x, y in ((-0.6, -0.35), (0.0, 0.0), (0.3, -0.1), (0.65, 0.38)):
        u, v = rs.rs2_project_point_to_pixel(lens, [x, y, 1.0])
        dx, dy = distort(np.array(x), np.array(y), model, COEFFICIENTS)
        # A ten-thousandth of a pixel is what single precision leaves at 1280 pixels.
        assert float(dx) * 910 + 645 == pytest.approx(u, abs=2e-4)
        assert float(dy) * 911 + 366 == pytest.approx(v, abs=2e-4)


@pytest.mark.parametrize("model", list(Distortion))
def test_undistort_undoes_distort(model: Distortion) -> None:
    x, y = np.meshgrid(np.linspace(-0.7, 0.7, 15), np.linspace(-0.4, 0.4, 9))
    back = undistort(*distort(x, y, model, COEFFICIENTS), model, COEFFICIENTS)
    np.testing.assert_allclose(back, (x, y), atol=1e-6)


def test_scale_error_by_hand() -> None:
    # k = 910/640; at 60 degrees L'/L = sqrt(k²/4 + 3/4).
    k = 910 / 640
    assert scale_error(910, 640) == pytest.approx(0.421875)
    assert scale_error_tilted(910, 640, 0) == pytest.approx(0.421875)
    assert scale_error_tilted(910, 640, 60) == pytest.approx((k * k / 4 + 0.75) ** 0.5 - 1)
