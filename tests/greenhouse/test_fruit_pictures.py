from __future__ import annotations

import base64
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision_greenhouse.fruit_pictures import (
    PICTURE_FILES,
    as_data_url,
    class_color,
    depth_picture,
    mask_outline,
    ruler_m,
    scale_bar,
)
from cucumbervision_greenhouse.settings import Units

CAMERA = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)


def decoded(url: str) -> Any:
    head, code = url.split(",", 1)
    assert head == "data:image/jpeg;base64"
    return cv2.imdecode(np.frombuffer(base64.b64decode(code), np.uint8), cv2.IMREAD_COLOR_RGB)


def test_a_wide_picture_is_shrunk_and_a_small_one_stays() -> None:
    color = np.zeros((300, 600, 3), np.uint8)
    color[:, 300:] = 200, 40, 20
    assert decoded(as_data_url(color, 200)).shape == (100, 200, 3)
    whole = decoded(as_data_url(color))
    assert whole.shape == color.shape
    assert np.abs(whole[150, 450].astype(int) - (200, 40, 20)).max() < 12


def test_depth_gets_colours_and_its_range_in_the_viewer_s_unit() -> None:
    depth = np.linspace(0.4, 0.8, 480 * 640).reshape(480, 640).astype(np.float32)
    depth[:10] = 0
    picture, words = depth_picture(depth, Units("cm"))
    assert picture.shape == (480, 640, 3)
    assert len(np.unique(picture[20:].reshape(-1, 3), axis=0)) > 50
    assert "cm" in words
    assert "in" in depth_picture(depth, Units("in"))[1]


def test_an_outline_goes_around_each_part_of_a_mask() -> None:
    mask = np.zeros((40, 60), bool)
    mask[5:15, 10:30] = True
    mask[20:30, 40:50] = True
    first, second = sorted(
        (np.array(line).reshape(-1, 2) for line in mask_outline(mask)), key=lambda p: p[:, 0].min()
    )
    assert first.min(axis=0).tolist() == pytest.approx([10, 5], abs=1)
    assert first.max(axis=0).tolist() == pytest.approx([29, 14], abs=1)
    assert second.max(axis=0).tolist() == pytest.approx([49, 29], abs=1)


def test_a_bar_and_a_ruler_follow_the_distance() -> None:
    bars = [scale_bar(CAMERA, at_m, Units("cm")) for at_m in (0.5, 1.0)]
    assert [bar and bar["px"] for bar in bars] == [120.0, 60.0]
    inches = scale_bar(CAMERA, 0.5, Units("in"))
    assert inches is not None
    assert inches["label"].startswith("4 in at 20 in")
    assert scale_bar(CAMERA, None, Units("cm")) is None
    # 0.3 m apart across the view at 0.6 m is 300 px; 0.4 m farther at one end makes it 0.5 m.
    depth = np.full((480, 640), 0.6, np.float32)
    wall = Capture(np.zeros((480, 640, 3), np.uint8), depth, CAMERA, "wall")
    assert ruler_m(wall, (170, 240), (470, 240)) == pytest.approx(0.3, abs=1e-6)
    step = depth.copy()
    step[:, 330:] = 1.0
    across = ruler_m(replace(wall, depth_m=step), (320, 240), (500, 240))
    assert across == pytest.approx(0.5, abs=1e-6)  # x: 0 and 0.3 m, z: 0.6 and 1.0 m
    step[:, 330:] = 0
    assert ruler_m(replace(wall, depth_m=step), (320, 240), (500, 240)) is None


def test_classes_are_green_and_the_others_not() -> None:
    colors = [class_color(name) for name in ("class I", "class II", "class III")]
    assert len(set(colors)) == 3
    assert all(int(c[3:5], 16) > max(int(c[1:3], 16), int(c[5:], 16)) for c in colors)
    assert class_color("too long") != class_color("too short")


def test_the_element_of_both_applications_has_its_files() -> None:
    assert {path.name for path in PICTURE_FILES.glob("picture.*")} == {
        "picture.css",
        "picture.html",
        "picture.js",
    }
