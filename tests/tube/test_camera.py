from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.tube.camera import (
    Distortion,
    align_depth_to_color,
    color_sources,
    distort,
    scale_error,
    undistort,
)

# Of the size that a D455's colour stream has, and larger.
COEFFICIENTS = (-0.056, 0.067, 0.0008, -0.0007, -0.021)


PIXELS = [(u, v) for u in (0.0, 200.5, 640.0, 1279.0) for v in (0.0, 333.25, 719.0)]


def sdk_lens(model: Distortion) -> tuple[Any, Any]:
    rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)
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
    assert scale_error(910, 640) == pytest.approx(0.421875)


SHIFT_M = (0.015, 0.0, 0.0)


DEPTH_K = np.array([[160.0, 0, 160], [0, 160, 90], [0, 0, 1]])


COLOR_K = np.array([[240.0, 0, 160], [0, 240, 90], [0, 0, 1]])


def one_pixel(u: int, v: int, z_m: float) -> NDArray[np.float32]:
    depth = np.zeros((180, 320), np.float32)
    depth[v, u] = z_m
    return depth


def box(image: NDArray[np.float32]) -> tuple[int, int, int, int]:
    ys, xs = np.nonzero(image)
    return int(xs.min()), int(xs.max()), int(ys.min()), int(ys.max())


def test_one_pixel_covers_its_footprint() -> None:
    # Its corners (179.5, 99.5) and (180.5, 100.5) lie at x/z = 19.5/160 and 20.5/160, y/z =
    # 9.5/160 and 10.5/160; the shift adds 0.015/0.5 = 0.03 to x/z. In colour pixels x runs from
    # 240 (19.5/160 + 0.03) + 160 = 196.45 to 197.95, y from 104.25 to 105.75: the pixels whose
    # centres are nearest to these are 196 to 198 and 104 to 106.
    aligned = align_depth_to_color(
        one_pixel(180, 100, 0.5), DEPTH_K, COLOR_K, (320, 180), np.eye(3), SHIFT_M
    )
    assert box(aligned) == (196, 198, 104, 106)
    assert np.unique(aligned).tolist() == [0.0, 0.5]


def test_nearest_depth_wins() -> None:
    # x_color = 240 (u - 160)/160 + 240 * 0.015/z + 160: at 0.6 m the shift is 6 px, at 0.3 m 12;
    # u = 184 at 0.6 m and u = 180 at 0.3 m both land on 202.
    depth = one_pixel(184, 90, 0.6) + one_pixel(180, 90, 0.3)
    aligned = align_depth_to_color(depth, DEPTH_K, COLOR_K, (320, 180), np.eye(3), SHIFT_M)
    assert aligned[90, 202] == np.float32(0.3)
    flipped = align_depth_to_color(
        depth[:, ::-1].copy(),
        np.array([[160.0, 0, 159], [0, 160, 90], [0, 0, 1]]),
        np.array([[240.0, 0, 159], [0, 240, 90], [0, 0, 1]]),
        (320, 180),
        np.eye(3),
        [-0.015, 0, 0],
    )
    assert flipped[90, 319 - 202] == np.float32(0.3)


def test_rotation_is_applied_rows_first() -> None:
    # A quarter turn about the optical axis takes +x to +y: 20 px to the right become 30 below.
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    aligned = align_depth_to_color(
        one_pixel(180, 90, 0.5), DEPTH_K, COLOR_K, (320, 180), turn, (0, 0, 0)
    )
    # The turned footprint's corners swap in x, so the SDK's rule of top left to bottom right
    # leaves no pixel; a tenth of a degree, as cameras have, must keep it.
    assert not aligned.any()
    small = np.deg2rad(1.0)
    turn = np.array(
        [[np.cos(small), -np.sin(small), 0], [np.sin(small), np.cos(small), 0], [0, 0, 1]]
    )
    aligned = align_depth_to_color(
        one_pixel(240, 90, 0.5), DEPTH_K, COLOR_K, (320, 180), turn, (0, 0, 0)
    )
    # y = 240 * (80/160) sin 1° = 2.09 px below the middle.
    x0, x1, y0, y1 = box(aligned)
    assert (x0 + x1) / 2 == pytest.approx(280, abs=0.6)
    assert (y0 + y1) / 2 == pytest.approx(92.1, abs=0.6)


def test_color_lens_is_applied() -> None:
    # At x/z = 0.5, y = 0, k1 = 0.1: x/z becomes 0.5 (1 + 0.1 * 0.25) = 0.5125, 3 px farther out.
    lens = (Distortion.BROWN_CONRADY, (0.1, 0.0, 0.0, 0.0, 0.0))
    args = (one_pixel(240, 90, 0.5), DEPTH_K, COLOR_K, (320, 180), np.eye(3), (0, 0, 0))
    plain = box(align_depth_to_color(*args))
    bent = box(align_depth_to_color(*args, color_lens=lens))
    assert (bent[0] + bent[1] - plain[0] - plain[1]) / 2 == pytest.approx(3.0, abs=0.5)
    # The depth lens bends the ray inwards instead: 0.4881 (1 + 0.1 * 0.4881²) = 0.5, and
    # 240 (0.4881 - 0.5) = -2.9 px.
    bent = box(align_depth_to_color(*args, depth_lens=lens))
    assert (bent[0] + bent[1] - plain[0] - plain[1]) / 2 == pytest.approx(-2.9, abs=0.6)


def test_what_leaves_the_picture_or_lies_behind_is_left_out() -> None:
    args = (DEPTH_K, COLOR_K, (320, 180), np.eye(3))
    assert not align_depth_to_color(one_pixel(319, 90, 0.5), *args, (0.5, 0, 0)).any()
    assert not align_depth_to_color(one_pixel(160, 90, 0.5), *args, (0, 0, -0.6)).any()
    assert not align_depth_to_color(np.zeros((180, 320), np.float32), *args, (0, 0, 0)).any()


@pytest.mark.parametrize(
    ("model", "coefficients", "expected"),
    [
        # By hand at (0.3, 0.2), r² = 0.13: x + 2 p1 x y + p2 (r² + 2 x²) and its mirror image.
        (Distortion.BROWN_CONRADY, (0, 0, 0.01, 0, 0), (0.3 + 0.0012, 0.2 + 0.0021)),
        (Distortion.BROWN_CONRADY, (0, 0, 0, 0.01, 0), (0.3 + 0.0031, 0.2 + 0.0012)),
        # The radial factor 1.13 first: the SDK's two other models take x and y times it.
        (Distortion.BROWN_CONRADY, (1, 0, 0, 0.01, 0), (0.339 + 0.0031, 0.226 + 0.0012)),
        (
            Distortion.INVERSE_BROWN_CONRADY,
            (1, 0, 0, 0.01, 0),
            (0.339 + 0.01 * (0.13 + 2 * 0.339**2), 0.226 + 0.02 * 0.339 * 0.226),
        ),
        (
            Distortion.MODIFIED_BROWN_CONRADY,
            (1, 0, 0.01, 0, 0),
            (0.339 + 0.02 * 0.339 * 0.226, 0.226 + 0.01 * (0.13 + 2 * 0.226**2)),
        ),
    ],
)
def test_each_term_of_the_lens_by_hand(
    model: Distortion, coefficients: tuple[float, ...], expected: tuple[float, float]
) -> None:
    seen = distort(np.array(0.3), np.array(0.2), model, coefficients)
    assert tuple(float(s) for s in seen) == pytest.approx(expected, abs=1e-12)


def test_each_colour_pixel_names_the_depth_pixel_that_it_reads() -> None:
    # Camera pixels of 0.1 rad; the colour camera is 5 cm to the left: 1 m away half a pixel.
    k = [[10, 0, 2], [0, 10, 1], [0, 0, 1]]
    depth = np.zeros((3, 5), np.float32)
    depth[1, 1], depth[1, 2] = 1.0, 0.5
    sources = color_sources(depth, k, k, (5, 3), np.eye(3), [0.05, 0, 0])
    # The farther one covers columns 1 and 2, the nearer one, moved by a whole pixel, 3 and 4.
    assert (sources[1] == [-1, 6, 6, 7, 7]).all()
    # The nearer one of two that cover the same columns stays, whichever comes first.
    depth[1, 1], depth[1, 2] = 0.5, 1.0
    sources = color_sources(depth, k, k, (5, 3), np.eye(3), [0.05, 0, 0])
    assert (sources[1] == [-1, -1, 6, 6, -1]).all()
    assert (color_sources(0 * depth, k, k, (5, 3), np.eye(3), [0, 0, 0]) == -1).all()
