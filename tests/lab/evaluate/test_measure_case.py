from __future__ import annotations

import sys

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.errors import MissingExtraError
from cucumbervision_lab.evaluate.measure_case import (
    available_baselines,
    disturb_mask,
    draw_disturbance,
    skan_length,
)
from cucumbervision_lab.scenes.bodies import Tube, arc_tube, rotation
from cucumbervision_lab.scenes.scene import Scene, render


def disc(radius_px: float) -> np.ndarray[tuple[int, int], np.dtype[np.bool_]]:
    v, u = np.mgrid[0:200, 0:200]
    return np.asarray(np.hypot(u - 100, v - 100) <= radius_px)


def test_the_outline_moves_by_the_field_where_it_stands() -> None:
    shift = np.zeros((200, 200), np.float32)
    shift[:, 100:] = 4
    moved = disturb_mask(disc(50), shift)
    columns = np.flatnonzero(moved[100])
    assert columns[0] == 50
    assert columns[-1] == 154


def test_the_outline_error_has_the_asked_rms() -> None:
    field = draw_disturbance((200, 200), 1.5, np.random.default_rng(5))
    moved = disturb_mask(disc(60), field)
    rays = np.deg2rad(np.arange(0, 360, 2))
    steps = np.arange(40.0, 80.0, 0.1)
    errors = []
    for ray in rays:
        u = np.rint(100 + steps * np.cos(ray)).astype(int)
        v = np.rint(100 + steps * np.sin(ray)).astype(int)
        errors.append(steps[np.flatnonzero(moved[v, u])[-1]] - 60)
    assert np.std(errors) == pytest.approx(1.5, rel=0.3)


CAMERA = Intrinsics(1280, 720, 900.0, 900.0, 640.0, 360.0)
RADIUS_M = 0.018
DISTANCE_M = 0.5
PIXEL_M = DISTANCE_M / 900.0
# Thinning peels one pixel off straight edges and up to sqrt(2) off diagonal ones each turn. After
# r turns, when the body is down to a line, a diagonal edge at first r from the cap's centre has
# passed it by (sqrt(2) - 1) r, and cuts the axis sqrt(2) times as far: (2 - sqrt(2)) r.
SHORT_M = (2 - np.sqrt(2)) * RADIUS_M

needs_skan = pytest.mark.skipif("skan" not in available_baselines(), reason="no skan")


def view(tube: Tube, **turn: float) -> tuple[NDArray[np.float32], NDArray[np.bool_], Intrinsics]:
    seen = render(Scene.of(tube.moved(rotation(**turn), (0.0, 0.0, DISTANCE_M))), CAMERA)
    return seen.depth_m.astype(np.float32), seen.mask(0), CAMERA


@needs_skan
@pytest.mark.parametrize("roll_deg", [0.0, 22.5, 90.0])
def test_a_skeleton_of_a_straight_fruit_ends_between_cap_centre_and_tip(roll_deg: float) -> None:
    # The silhouette is a stadium, whose medial axis runs from cap centre to cap centre; thinning
    # may leave a spur to the tip, or stop SHORT_M before the cap's centre. Its pixels show the
    # near surface, which is a radius nearer than the axis, so that the length shrinks by
    # (z - r) / z at most. One and a half pixels of rounding at both ends.
    length = skan_length(*view(arc_tube(0.2, RADIUS_M), roll_deg=roll_deg))
    nearer = (DISTANCE_M - RADIUS_M) / DISTANCE_M
    assert length is not None
    assert length > (0.2 - 2 * RADIUS_M - 2 * SHORT_M) * nearer - 3 * PIXEL_M
    assert length < 0.2 * (1 + (RADIUS_M / DISTANCE_M) ** 2) + 3 * PIXEL_M


@needs_skan
def test_a_skeleton_follows_a_bend() -> None:
    # Arc of radius R: the body's arc between the cap centres is 0.30 - 2 r; its chord
    # 2 R sin(arc / 2R) is 5 cm shorter, so whoever measures straight falls below the bound.
    bend_m, arc_m = 0.12, 0.30 - 2 * RADIUS_M
    chord_m = 2 * bend_m * np.sin(arc_m / (2 * bend_m))
    low_m = (arc_m - 2 * SHORT_M) * (DISTANCE_M - RADIUS_M) / DISTANCE_M - 3 * PIXEL_M
    assert low_m > chord_m + 0.015
    length = skan_length(*view(arc_tube(0.30, RADIUS_M, bend_m)))
    assert length is not None
    assert low_m < length < 0.30 + 3 * PIXEL_M


@needs_skan
def test_of_a_fruit_cut_in_two_the_longer_part_counts() -> None:
    # Hidden from 2 to 6 cm right of the middle: left of it 12 cm are seen, right of it 4 cm. What
    # joined the two would read more than the left part's 12 cm.
    depth, mask, camera = view(arc_tube(0.2, RADIUS_M))
    cut = mask.copy()
    cut[:, 640 + round(0.02 / PIXEL_M) : 640 + round(0.06 / PIXEL_M)] = False
    length = skan_length(depth, cut, camera)
    assert length is not None
    assert 0.12 - 2 * RADIUS_M - 2 * SHORT_M < length < 0.12 + 3 * PIXEL_M


@needs_skan
def test_a_skeleton_is_lifted_by_depth() -> None:
    # Tilted by 40 degrees the picture shows cos 40° = 77 % of the length. Lifted, at least the
    # run between the cap centres less the nearer surface and the far cap's hidden part (r sin 40°)
    # must come out.
    length = skan_length(*view(arc_tube(0.2, RADIUS_M), tilt_deg=40.0))
    assert length is not None
    nearer = (DISTANCE_M - RADIUS_M / np.cos(np.deg2rad(40))) / DISTANCE_M
    short = 2 * RADIUS_M + 2 * SHORT_M + RADIUS_M * np.sin(np.deg2rad(40))
    assert length > (0.2 - short) * nearer - 3 * PIXEL_M
    assert length < 0.2 + 3 * PIXEL_M


def test_without_its_package_a_tool_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    mask, depth = np.ones((9, 9), bool), np.ones((9, 9), np.float32)
    monkeypatch.setitem(sys.modules, "skan", None)
    with pytest.raises(MissingExtraError, match=r"cucumbervision\[benchmark\]"):
        skan_length(depth, mask, CAMERA)
