from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from cucumbervision.arrays import Array32
from cucumbervision.capture.intrinsics import (
    Distortion,
    Intrinsics,
    Stream,
    align_depth_to_color,
    check_intrinsics,
    color_sources,
    distort,
    is_off_centre,
    undistort,
)
from cucumbervision.errors import IntrinsicsError

COLOR = Intrinsics(1280, 720, 910.5, 909.8, 645.2, 366.1)
DEPTH = Intrinsics(1280, 720, 640.0, 640.0, 641.3, 358.7, stream=Stream.DEPTH)
LENS = (-0.056, 0.067, 0.0008, -0.0007, -0.021)


@pytest.mark.parametrize(
    ("size", "percent"),
    [
        # Half the height: f ought to be twice as large, so lengths come out twice as long.
        ((640, 360), r"\+100 %"),
        # 720/480 - 1; the sides are cropped, the height tells the scale.
        ((640, 480), r"\+50 %"),
        # 720/1080 - 1
        ((1920, 1080), r"-33 %"),
    ],
)
def test_another_size_is_refused(size: tuple[int, int], percent: str) -> None:
    given = Intrinsics(*size, 600.0, 600.0, size[0] / 2, size[1] / 2)
    with pytest.raises(IntrinsicsError, match=rf"the picture is 1280x720.*about {percent}"):
        check_intrinsics(given, 1280, 720)


def test_another_size_with_the_captures_own_at_hand() -> None:
    given = Intrinsics(640, 480, 616.0, 616.0, 320.0, 240.0)
    # 910.5 / 616 - 1
    with pytest.raises(IntrinsicsError, match=r"come out \+48 % wrong"):
        check_intrinsics(given, 1280, 720, color=COLOR)


@pytest.mark.parametrize("model", [Distortion.BROWN_CONRADY, Distortion.INVERSE_BROWN_CONRADY])
def test_rays_and_projection_through_a_lens_are_the_sdks(model: Distortion) -> None:
    rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)
    lens = rs.intrinsics()
    lens.width, lens.height = 1280, 720
    lens.fx, lens.fy, lens.ppx, lens.ppy = 910.5, 909.8, 645.2, 366.1
    lens.model, lens.coeffs = getattr(rs.distortion, model.value), list(LENS)
    camera = replace(COLOR, distortion=model, coefficients=LENS)
    for pixel in product((0.0, 200.5, 640.0, 1279.0), (0.0, 333.25, 719.0)):
        expected = rs.rs2_deproject_pixel_to_point(lens, [*pixel], 1.0)
        assert [float(r) for r in camera.rays(*pixel)] == pytest.approx(expected[:2], abs=2e-6)
    for x, y in ((-0.6, -0.35), (0.0, 0.0), (0.3, -0.1), (0.65, 0.38)):
        expected = rs.rs2_project_point_to_pixel(lens, [x, y, 1.0])
        # A ten-thousandth of a pixel is what single precision leaves at 1280 pixels.
        assert camera.project([[x, y, 1.0]])[0] == pytest.approx(expected, abs=2e-4)


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ((1280, 720, 0.0, 600.0, 640.0, 360.0), "do not describe a camera"),
        ((1280, 720, 600.0, -600.0, 640.0, 360.0), "do not describe a camera"),
        ((1280, 720, float("nan"), 600.0, 640.0, 360.0), "do not describe a camera"),
        ((1280, 0, 600.0, 600.0, 640.0, 360.0), "1280x0 is not a picture"),
    ],
)
def test_senseless_numbers(
    numbers: tuple[int, int, float, float, float, float], words: str
) -> None:
    with pytest.raises(IntrinsicsError, match=words):
        Intrinsics(*numbers)


@pytest.mark.parametrize(("cx", "cy"), [(-1.0, 24.0), (65.0, 24.0), (32.0, 49.0)])
def test_a_principal_point_outside_the_picture_is_refused(cx: float, cy: float) -> None:
    with pytest.raises(IntrinsicsError, match=r"^k\.json: the principal point .* outside"):
        check_intrinsics(Intrinsics(64, 48, 60.0, 60.0, cx, cy), 64, 48, source="k.json")


@pytest.mark.parametrize(
    ("size", "words"),
    [
        # The matrix of 1280x720: f is right for that size, so twice too large for 640x360.
        ((640, 360), r"1280x720, 2 times as large as 640x360.*about -50 % wrong"),
        # 1280/848 is 1.51, 720/480 is 1.5; 1 / 1.505 - 1.
        ((848, 480), r"1\.5 times as large as 848x480.*about -34 % wrong"),
        # 1280/1920, two thirds.
        ((1920, 1080), r"0\.67 times as large as 1920x1080.*about \+50 % wrong"),
    ],
)
def test_a_matrix_of_another_size_is_told_by_its_principal_point(
    size: tuple[int, int], words: str
) -> None:
    edited = Intrinsics(*size, 910.0, 910.0, 640.0, 360.0)
    with pytest.raises(IntrinsicsError, match=rf"k\.json: the principal point .*{words}"):
        check_intrinsics(edited, *size, source="k.json")


@pytest.mark.parametrize(
    "camera",
    [
        # As calibrated: D435, D415, Kinect v1, Azure Kinect, an iPhone.
        Intrinsics(1280, 720, 927.2, 927.4, 651.3, 349.6),
        Intrinsics(640, 480, 617.3, 617.0, 313.9, 238.1),
        Intrinsics(640, 480, 525.0, 525.0, 318.6, 255.3),
        Intrinsics(1920, 1080, 918.1, 917.9, 957.0, 552.1),
        Intrinsics(1920, 1440, 1592.0, 1592.0, 952.4, 722.1),
    ],
)
def test_calibrated_cameras_are_not_doubted(camera: Intrinsics) -> None:
    assert check_intrinsics(camera, *camera.size) is camera
    assert not is_off_centre(camera)


def test_a_cut_out_is_doubted_and_not_refused() -> None:
    cut_out = Intrinsics(400, 300, 910.5, 909.8, 345.2, 96.1)
    assert check_intrinsics(cut_out, 400, 300) is cut_out
    assert is_off_centre(cut_out)


@pytest.mark.parametrize("model", list(Distortion))
def test_undistort_undoes_distort(model: Distortion) -> None:
    x, y = np.meshgrid(np.linspace(-0.7, 0.7, 15), np.linspace(-0.4, 0.4, 9))
    back = undistort(*distort(x, y, model, LENS), model, LENS)
    np.testing.assert_allclose(back, (x, y), atol=1e-6)


SHIFT_M = (0.015, 0.0, 0.0)
DEPTH_SMALL = Intrinsics(320, 180, 160.0, 160.0, 160.0, 90.0)
COLOR_SMALL = Intrinsics(320, 180, 240.0, 240.0, 160.0, 90.0)


def one_pixel(u: int, v: int, z_m: float) -> Array32:
    depth = np.zeros((180, 320), np.float32)
    depth[v, u] = z_m
    return depth


def box(image: Array32) -> tuple[int, int, int, int]:
    ys, xs = np.nonzero(image)
    return int(xs.min()), int(xs.max()), int(ys.min()), int(ys.max())


def test_one_pixel_covers_its_footprint() -> None:
    # Its corners (179.5, 99.5) and (180.5, 100.5) lie at x/z = 19.5/160 and 20.5/160, y/z =
    # 9.5/160 and 10.5/160; the shift adds 0.015/0.5 = 0.03 to x/z. In colour pixels x runs from
    # 240 (19.5/160 + 0.03) + 160 = 196.45 to 197.95, y from 104.25 to 105.75: the pixels whose
    # centres are nearest to these are 196 to 198 and 104 to 106.
    aligned = align_depth_to_color(
        one_pixel(180, 100, 0.5), DEPTH_SMALL, COLOR_SMALL, np.eye(3), SHIFT_M
    )
    assert box(aligned) == (196, 198, 104, 106)
    assert np.unique(aligned).tolist() == [0.0, 0.5]


def test_nearest_depth_wins() -> None:
    # x_color = 240 (u - 160)/160 + 240 * 0.015/z + 160: at 0.6 m the shift is 6 px, at 0.3 m 12;
    # u = 184 at 0.6 m and u = 180 at 0.3 m both land on 202.
    depth = one_pixel(184, 90, 0.6) + one_pixel(180, 90, 0.3)
    aligned = align_depth_to_color(depth, DEPTH_SMALL, COLOR_SMALL, np.eye(3), SHIFT_M)
    assert aligned[90, 202] == np.float32(0.3)
    flipped = align_depth_to_color(
        depth[:, ::-1].copy(),
        replace(DEPTH_SMALL, cx_px=159.0),
        replace(COLOR_SMALL, cx_px=159.0),
        np.eye(3),
        [-0.015, 0, 0],
    )
    assert flipped[90, 319 - 202] == np.float32(0.3)


def test_rotation_is_applied_rows_first() -> None:
    # A quarter turn about the optical axis takes +x to +y: 20 px to the right become 30 below.
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    aligned = align_depth_to_color(
        one_pixel(180, 90, 0.5), DEPTH_SMALL, COLOR_SMALL, turn, (0, 0, 0)
    )
    # The turned footprint's corners swap in x, so the SDK's rule of top left to bottom right
    # leaves no pixel; a tenth of a degree, as cameras have, must keep it.
    assert not aligned.any()
    small = np.deg2rad(1.0)
    turn = np.array(
        [[np.cos(small), -np.sin(small), 0], [np.sin(small), np.cos(small), 0], [0, 0, 1]]
    )
    aligned = align_depth_to_color(
        one_pixel(240, 90, 0.5), DEPTH_SMALL, COLOR_SMALL, turn, (0, 0, 0)
    )
    # y = 240 * (80/160) sin 1° = 2.09 px below the middle.
    x0, x1, y0, y1 = box(aligned)
    assert (x0 + x1) / 2 == pytest.approx(280, abs=0.6)
    assert (y0 + y1) / 2 == pytest.approx(92.1, abs=0.6)


def test_color_lens_is_applied() -> None:
    # At x/z = 0.5, y = 0, k1 = 0.1: x/z becomes 0.5 (1 + 0.1 * 0.25) = 0.5125, 3 px farther out.
    lens = {"distortion": Distortion.BROWN_CONRADY, "coefficients": (0.1, 0.0, 0.0, 0.0, 0.0)}
    depth_m, pose = one_pixel(240, 90, 0.5), (np.eye(3), (0, 0, 0))
    plain = box(align_depth_to_color(depth_m, DEPTH_SMALL, COLOR_SMALL, *pose))
    # The depth lens bends the ray inwards instead: 0.4881 (1 + 0.1 * 0.4881²) = 0.5, and
    # 240 (0.4881 - 0.5) = -2.9 px.
    for depth, color, shift_px, off_px in (
        (DEPTH_SMALL, replace(COLOR_SMALL, **lens), 3.0, 0.5),  # type: ignore[arg-type]
        (replace(DEPTH_SMALL, **lens), COLOR_SMALL, -2.9, 0.6),  # type: ignore[arg-type]
    ):
        bent = box(align_depth_to_color(depth_m, depth, color, *pose))
        moved = (bent[0] + bent[1] - plain[0] - plain[1]) / 2
        assert moved == pytest.approx(shift_px, abs=off_px)


def test_what_leaves_the_picture_or_lies_behind_is_left_out() -> None:
    args = (DEPTH_SMALL, COLOR_SMALL, np.eye(3))
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
    k = Intrinsics(5, 3, 10.0, 10.0, 2.0, 1.0)
    depth = np.zeros((3, 5), np.float32)
    depth[1, 1], depth[1, 2] = 1.0, 0.5
    sources = color_sources(depth, k, k, np.eye(3), [0.05, 0, 0])
    # The farther one covers columns 1 and 2, the nearer one, moved by a whole pixel, 3 and 4.
    assert (sources[1] == [-1, 6, 6, 7, 7]).all()
    # The nearer one of two that cover the same columns stays, whichever comes first.
    depth[1, 1], depth[1, 2] = 0.5, 1.0
    sources = color_sources(depth, k, k, np.eye(3), [0.05, 0, 0])
    assert (sources[1] == [-1, -1, 6, 6, -1]).all()
    assert (color_sources(0 * depth, k, k, np.eye(3), [0, 0, 0]) == -1).all()
