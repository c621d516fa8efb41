"""Poses of drawn bodies, whose ends and axes are known."""

from __future__ import annotations

import json
from dataclasses import replace

import jsonschema
import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import TypeAdapter

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.instance import Instance
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision.methods.flags import Flag
from cucumbervision.methods.result import Fruit, FruitPose, MethodName, Part
from cucumbervision.methods.selector import measure_fruit
from cucumbervision_lab.scenes.bodies import Tube, arc_tube, rotation
from cucumbervision_lab.scenes.scene import Scene, render

LENS = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
# 20 cm long; its stem end up and to the right, tilted away from the camera.
BODY = arc_tube(0.20, 0.02).moved(rotation(roll_deg=-60, tilt_deg=20), (0.02, 0.01, 0.5))


def seen(body: Tube, leaf: tuple[slice, slice] | None = None) -> tuple[Capture, Instance]:
    """Return a capture of a body, and the fruit with its true keypoints."""
    drawn = render(Scene.of(body, backdrop_m=0.9), LENS)
    depth, mask = drawn.depth_m.astype(np.float32), drawn.mask(0)
    if leaf is not None:
        depth[leaf], mask[leaf] = 0.35, False
    points = LENS.project(np.linspace(body.poles_m[0], body.poles_m[1], 5))
    keypoints = np.column_stack([points, np.ones(5)])
    blank = np.zeros((480, 640, 3), np.uint8)
    return Capture(blank, depth, LENS, "drawn"), Instance(
        box_of_mask(mask), mask=mask, keypoints=keypoints
    )


def pose_of(fruit: Fruit) -> FruitPose:
    assert fruit.pose is not None
    return fruit.pose


def test_the_ends_the_axis_and_the_place_to_cut_of_a_known_body() -> None:
    pose = pose_of(measure_fruit(*seen(BODY), cut_beyond_m=0.03))
    blossom, stem = BODY.poles_m
    out = (stem - blossom) / 0.20
    assert pose.stem_m == pytest.approx(stem, abs=0.001)
    assert pose.blossom_m == pytest.approx(blossom, abs=0.001)
    assert pose.centre_m == pytest.approx((stem + blossom) / 2, abs=0.001)
    assert pose.axis_m[[0, -1]] == pytest.approx(np.stack([stem, blossom]), abs=0.001)
    assert pose.radius_m[16] == pytest.approx(0.02, abs=0.0005)
    assert np.degrees(np.arccos(pose.direction @ out)) < 1.0
    assert pose.cut_m == pytest.approx(stem + 0.03 * out, abs=0.002)
    assert (pose.frame, pose.covered) == ("camera_color_optical_frame", ())


def test_every_method_measures_from_the_stem() -> None:
    fruit = measure_fruit(*seen(BODY))
    stem = BODY.poles_m[1]
    lines = {m: one.path_m for m, one in fruit.measurements.items() if one.path_m is not None}
    assert {MethodName.M3, MethodName.M4, MethodName.M5, MethodName.M6} <= set(lines)
    for line in lines.values():
        first, last = np.linalg.norm(line[[0, -1]] - stem, axis=1)
        assert first < last
    assert fruit.fit is not None
    assert fruit.fit.traits.axis_m[0] == pytest.approx(stem, abs=0.001)


def test_keypoints_tell_the_stem_as_surely_as_they_are() -> None:
    capture, instance = seen(BODY)
    assert instance.keypoints is not None
    swapped = replace(instance, keypoints=instance.keypoints[::-1], end_confidence=0.8)
    pose = pose_of(measure_fruit(capture, swapped))
    assert pose.stem_m == pytest.approx(BODY.poles_m[0], abs=0.001)
    assert pose.stem_confidence == pytest.approx(0.8)


def test_gravity_decides_where_the_fruit_hangs_and_not_where_it_lies() -> None:
    capture, instance = seen(BODY)
    assert instance.keypoints is not None
    unsure = replace(instance, keypoints=instance.keypoints[::-1], end_confidence=0.6)
    hangs = replace(capture, gravity=(0.0, 1.0, 0.0))
    pose = pose_of(measure_fruit(hangs, unsure))
    # The axis rises by sin 60 cos 20 of its length: 6 x 0.814 against the log-odds of 0.6.
    odds = 6 * np.sin(np.pi / 3) * np.cos(np.pi / 9) - np.log(0.6 / 0.4)
    assert pose.stem_m == pytest.approx(BODY.poles_m[1], abs=0.001)
    assert pose.stem_confidence == pytest.approx(1 / (1 + np.exp(-odds)), abs=0.003)
    blossom, stem = BODY.poles_m
    across = np.cross(stem - blossom, [0.0, 0.0, 1.0])
    lies = replace(capture, gravity=tuple((across / np.linalg.norm(across)).tolist()))
    pose = pose_of(measure_fruit(lies, unsure))
    assert pose.stem_m == pytest.approx(blossom, abs=0.001)
    assert pose.stem_confidence == pytest.approx(0.6, abs=0.01)
    # What gravity makes sure is not flagged, whatever the keypoints alone would say.
    flagged = [Flag.ENDS_UNSURE in measure_fruit(one, unsure).flags for one in (hangs, lies)]
    assert flagged == [False, True]


def test_without_any_sign_the_upper_end_is_taken_and_called_unsure() -> None:
    capture, instance = seen(BODY)
    pose = pose_of(measure_fruit(capture, replace(instance, keypoints=None)))
    assert pose.stem_m == pytest.approx(BODY.poles_m[1], abs=0.001)
    assert pose.stem_confidence == 0.5


def pixels(point_m: NDArray[np.float64], reach: int) -> tuple[slice, slice]:
    u, v = np.rint(LENS.project(point_m[None])[0]).astype(int).tolist()
    return slice(v - reach, v + reach), slice(u - reach, u + reach)


def test_nothing_is_cut_where_the_stem_is_out_of_sight() -> None:
    pose = pose_of(measure_fruit(*seen(BODY, pixels(BODY.poles_m[1], 40))))
    assert Part.STEM in pose.covered
    assert Part.BLOSSOM not in pose.covered
    assert pose.cut_m is None
    assert pose.cut_covariance_m2 is None


def test_a_leaf_before_the_place_to_cut_is_said() -> None:
    blossom, stem = BODY.poles_m
    place = stem + 0.06 * (stem - blossom) / 0.20
    capture, instance = seen(BODY, pixels(place, 8))
    assert Part.CUT in pose_of(measure_fruit(capture, instance, cut_beyond_m=0.06)).covered
    assert Part.CUT not in pose_of(measure_fruit(capture, instance, cut_beyond_m=0.02)).covered


def test_the_covariance_holds_the_depth_scale_along_the_view() -> None:
    capture, instance = seen(BODY)
    known = pose_of(measure_fruit(capture, instance, scale_known=True))
    unknown = pose_of(measure_fruit(capture, instance))
    assert known.cut_covariance_m2 is not None
    assert unknown.cut_covariance_m2 is not None
    assert unknown.cut_m is not None
    assert unknown.cut_covariance_m2 - known.cut_covariance_m2 == pytest.approx(
        0.01**2 * np.outer(unknown.cut_m, unknown.cut_m)
    )
    assert (np.linalg.eigvalsh(known.cut_covariance_m2) > 0.001**2).all()
    # Across, a peduncle that turns aside by 15 degrees counts 2 cm beyond.
    far = pose_of(measure_fruit(capture, instance, scale_known=True, cut_beyond_m=0.04))
    assert far.cut_covariance_m2 is not None
    assert np.trace(far.cut_covariance_m2) > 2 * np.trace(known.cut_covariance_m2)


def test_a_fruit_without_a_tube_has_no_pose() -> None:
    assert measure_fruit(*seen(BODY), methods=[MethodName.M5]).pose is None


def test_json_is_what_its_schema_says() -> None:
    pose = pose_of(measure_fruit(*seen(BODY)))
    schema = TypeAdapter(FruitPose).json_schema(mode="serialization")
    values = json.loads(json.dumps(pose.as_json()))
    jsonschema.validate(values, schema)
    assert values["stem_m"] == np.round(pose.stem_m, 5).tolist()
    assert len(values["axis_m"]) == len(values["radius_m"]) == 33
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**values, "stem_m": [0.0, 1.0]}, schema)
