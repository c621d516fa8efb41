from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.capture.intrinsics import Intrinsics, Stream, check_intrinsics, is_off_centre
from cucumbervision.errors import IntrinsicsError
from cucumbervision.tube.camera import Distortion

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
def test_rays_through_a_lens_are_the_sdks(model: Distortion) -> None:
    rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)
    lens = rs.intrinsics()
    lens.width, lens.height = 1280, 720
    lens.fx, lens.fy, lens.ppx, lens.ppy = 910.5, 909.8, 645.2, 366.1
    lens.model, lens.coeffs = getattr(rs.distortion, model.value), list(LENS)
    camera = Intrinsics(1280, 720, 910.5, 909.8, 645.2, 366.1, distortion=model, coefficients=LENS)
    for pixel in ([0.0, 0.0], [1279.0, 719.0], [300.5, 500.25]):
        expected = rs.rs2_deproject_pixel_to_point(lens, pixel, 1.0)
        assert [float(r) for r in camera.rays(*pixel)] == pytest.approx(expected[:2], abs=2e-6)


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


def test_projection_undoes_deprojection() -> None:
    camera = Intrinsics(
        1280, 720, 910.0, 905.0, 640.0, 350.0,
        distortion=Distortion.BROWN_CONRADY, coefficients=(0.1, -0.05, 0.001, 0.002, 0.0),
    )  # fmt: skip
    u, v = np.array([100.0, 640.0, 1200.0]), np.array([80.0, 350.0, 700.0])
    x, y = camera.rays(u, v)
    z = np.array([0.4, 0.5, 0.6])
    pixels = camera.project(np.stack([x * z, y * z, z], axis=1))
    assert pixels == pytest.approx(np.stack([u, v], axis=1), abs=1e-3)


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
