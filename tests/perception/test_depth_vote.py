from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.errors import ModelError
from cucumbervision.instances.instance import Instance
from cucumbervision.instances.masks import box_of_mask
from cucumbervision.perception.depth_vote import (
    FEATURES,
    DepthShape,
    DepthVote,
    _half_width_px,
    depth_shape,
    read_depth_vote,
    with_depth_votes,
)
from cucumbervision.perception.networks import each_fruit_once

FOCAL_PX = 600.0
BEHIND_M = 0.8
CUCUMBER = DepthShape(0.034, 0.16, 0.02, 0.35)


def upright_tube(
    width_m: float, length_m: float, distance_m: float, height: int = 480, width: int = 640
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """A cylinder that hangs in front of a wall, seen from far away: its mask and the depth."""
    scale = FOCAL_PX / distance_m
    rows, columns = np.indices((height, width), float)
    across_m, along_m = (columns - width / 2) / scale, (rows - height / 2) / scale
    mask = (np.abs(across_m) < width_m / 2) & (np.abs(along_m) < length_m / 2)
    surface = distance_m - np.sqrt(np.maximum((width_m / 2) ** 2 - across_m**2, 0))
    return mask, np.where(mask, surface, BEHIND_M).astype(np.float32)


def test_shape_of_a_hanging_cylinder() -> None:
    mask, depth_m = upright_tube(0.04, 0.20, 0.5)
    shape = depth_shape(mask, depth_m, FOCAL_PX)
    assert shape is not None
    # Its front half lies 0 to 2 cm nearer than its axis: by pi / 4 of the radius in the mean.
    nearer = 1 - 0.04 / 2 * np.pi / 4 / 0.5
    assert shape.width_m == pytest.approx(0.04 * nearer, rel=0.03)
    assert shape.length_m == pytest.approx(0.20 * nearer, rel=0.03)
    assert shape.far_share == 0
    # The standard deviation of 1 - sqrt(1 - x^2) about its value in the middle, over the width.
    x = np.linspace(-1, 1, 2001)
    assert shape.relief == pytest.approx(np.std(1 - np.sqrt(1 - x**2)), abs=0.03)


@pytest.mark.parametrize("count", [1, 2, 3, 20, 21, 100])
def test_a_slices_half_width_is_numpys_percentile(count: int) -> None:
    side_px = np.random.default_rng(count).uniform(0, 40, count)
    assert _half_width_px(side_px) == pytest.approx(np.percentile(side_px, 95), rel=1e-12)


def test_readings_behind_the_body_are_counted() -> None:
    mask, depth_m = upright_tube(0.04, 0.20, 0.5)
    depth_m[240:] = np.where(mask[240:], BEHIND_M, depth_m[240:])
    shape = depth_shape(mask, depth_m, FOCAL_PX)
    assert shape is not None
    assert shape.far_share == pytest.approx(0.5, abs=0.02)


def test_too_little_depth_gives_no_shape() -> None:
    mask, depth_m = upright_tube(0.04, 0.20, 0.5)
    few = np.where(np.arange(depth_m.size).reshape(depth_m.shape) % 25 == 0, depth_m, 0)
    assert depth_shape(mask, few.astype(np.float32), FOCAL_PX) is None
    assert depth_shape(np.zeros_like(mask), depth_m, FOCAL_PX) is None


@pytest.mark.parametrize(
    "other",
    [
        replace(CUCUMBER, width_m=0.30, length_m=1.2),  # a strip of wall
        replace(CUCUMBER, width_m=0.02, length_m=0.02),  # a flower
        replace(CUCUMBER, width_m=0.11, length_m=0.12),  # a leaf
        replace(CUCUMBER, far_share=0.6),  # a gap between leaves
        replace(CUCUMBER, far_share=0.3, relief=2.0),
    ],
)
def test_another_size_or_surface_counts_against_a_detection(other: DepthShape) -> None:
    vote = read_depth_vote(Path("src/cucumbervision/perception/depth_vote.json"))
    assert vote.probability(0.1, other) < 0.5 < vote.probability(0.1, CUCUMBER)


def test_the_probability_is_the_logistic_function_of_the_weighted_features() -> None:
    weights = dict.fromkeys(FEATURES, 0.0) | {"constant": 1.0, "far_share": -2.0}
    vote = DepthVote(tuple(weights.values()), 10)
    # 1 - 2 x 0.75 = -0.5
    shape = replace(CUCUMBER, far_share=0.75)
    assert vote.probability(0.5, shape) == pytest.approx(1 / (1 + np.exp(0.5)))


def test_depth_lifts_a_weak_detection_and_lowers_a_wall() -> None:
    mask, depth_m = upright_tube(0.036, 0.17, 0.45)
    wall = np.zeros_like(mask)
    wall[20:460, 20:160] = True
    bare = np.zeros_like(mask)
    bare[20:460, 600:630] = True
    depth_m[:, 600:] = 0
    found = [
        Instance(box_of_mask(one), confidence, detector_mask=one)
        for one, confidence in ((mask, 0.08), (wall, 0.15), (bare, 0.3))
    ]
    fruit, strip, unseen = with_depth_votes(found, depth_m, FOCAL_PX)
    assert fruit is not None
    assert strip is not None
    assert fruit.confidence > 0.2
    assert strip.confidence < 0.05
    assert unseen is None
    both = each_fruit_once(found, None, depth_m, focal_px=FOCAL_PX)
    # Without depth the detector's own confidence counts.
    assert [one.confidence for one in both] == sorted([0.3, fruit.confidence], reverse=True)
    assert [one.confidence for one in each_fruit_once(found, None, depth_m)] == [0.3]


@pytest.mark.parametrize("text", ["{", json.dumps({"weights": [1.0], "detections": 3}), "[]"])
def test_a_damaged_file_is_named(tmp_path: Path, text: str) -> None:
    file = tmp_path / "depth_vote.json"
    file.write_text(text)
    with pytest.raises(ModelError, match=r"depth_vote\.json"):
        read_depth_vote(file)
