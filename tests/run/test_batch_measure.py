"""`measure` on arrays, masks and detectors of one's own."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.capsules import capsule_capture, lying

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import CaptureError, DepthError, InstancesError, IntrinsicsError
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.methods.flags import Flag
from cucumbervision.methods.result import Fruit, LengthDefinition
from cucumbervision.run.batch import measure

CAMERA_1280 = Intrinsics(1280, 720, 924.0, 924.0, 639.5, 359.5)


@pytest.fixture(scope="module")
def bench() -> Capture:
    return next(iter(open_source(example_captures() / "simulated-bench"))).load()


@pytest.fixture(scope="module")
def lengths_m(bench: Capture) -> list[float]:
    return values(measure(bench, instances="dataset").fruit)


def values(fruit: Sequence[Fruit]) -> list[float]:
    return [one.length.value_m for one in fruit if one.length is not None]


def test_arrays_measure_as_the_capture_does(bench: Capture, lengths_m: list[float]) -> None:
    matrix = bench.intrinsics.matrix
    in_mm = np.rint(bench.depth_m * 1000).astype(np.uint16)
    in_float = np.where(bench.depth_m > 0, bench.depth_m, np.nan).astype(np.float64)
    as_numbers = [255 * mask.astype(np.uint8) for mask in bench.masks]
    for depth in (in_mm, in_float):
        found = measure(bench.color, depth, matrix, masks=as_numbers)
        assert values(found.fruit) == pytest.approx(lengths_m, abs=1e-4)
        assert found.captures[0].models == ()  # masks that are given are of no network or plug-in
    tenths = measure(
        bench.color, 10 * in_mm, bench.intrinsics, masks=bench.masks, depth_unit_m=1e-4
    )
    assert values(tenths.fruit) == pytest.approx(lengths_m, abs=1e-4)


def test_any_callable_is_a_detector(bench: Capture, lengths_m: list[float]) -> None:
    names: list[str] = []

    def second(capture: Capture) -> list[Instance]:
        names.append(capture.name)
        return [Instance.of_mask(capture.masks[1], MaskSource.DETECTOR)]

    found = measure([bench, replace(bench, name="again")], instances=second)
    assert sorted(names) == ["again", "simulated-bench"]
    (model,) = (model for model in found.captures[0].models if "package" in model)
    assert model["kind"] == "detector"
    assert str(model["name"]).endswith("second")
    # Its masks are measured as they are, pale and reddish ends included.
    assert values(found.fruit) == pytest.approx([lengths_m[1]] * 2)
    assert found.fruit[0].mask_source is MaskSource.DETECTOR


def test_a_detectors_error_is_the_captures_failure(bench: Capture) -> None:
    def broken(_: Capture) -> list[Instance]:
        raise InstancesError("no fruit today", remedy="wait")

    found = measure(bench, instances=broken)
    assert (len(found), found.failures[0].error) == (0, "InstancesError")


def test_every_length_has_its_interval(bench: Capture) -> None:
    (fruit, *_) = measure(bench, instances="dataset").fruit
    keys = {"M1", "M2", "M3", "M4", "M5", "M6", "M6 thread", "M6 chord"}
    assert set(fruit.lengths) == keys - {"M4"}  # without keypoints
    assert fruit.lengths["M6"] == fruit.length
    assert fruit.traits is not None
    tube = fruit.traits.lengths
    for key, kind in (("M6 thread", LengthDefinition.THREAD), ("M6 chord", LengthDefinition.CHORD)):
        length = fruit.lengths[key]
        assert (length.value_m, length.kind, length.interval_of) == (tube.of(kind), kind, kind)
    # An interval that spans more than a factor of four is left out.
    known = {key for key, length in fruit.lengths.items() if length.low_m is not None}
    assert known >= {"M3", "M5", "M6", "M6 thread", "M6 chord"}


def test_what_is_missing_or_too_much_is_said(bench: Capture) -> None:
    with pytest.raises(CaptureError, match=r"give measure\(color, depth, intrinsics\)"):
        measure(bench.color)
    with pytest.raises(CaptureError, match="sizes differ"):
        measure(bench.color, bench.depth_m[:100], bench.intrinsics, masks=bench.masks)
    with pytest.raises(InstancesError, match="no pixel"):
        measure(bench.color, bench.depth_m, bench.intrinsics, masks=[0 * bench.masks[0]])


def test_masks_and_boxes_that_do_not_fit_are_named_and_the_others_measured() -> None:
    capture = capsule_capture(lying(0.16))
    mask = capture.masks[0]
    good = Instance.of_mask(mask)
    small = Instance.of_mask(mask[::2, ::2])
    nowhere = replace(good, box=np.array([700.0, 10, 800, 40]))
    unknown = replace(good, box=np.array([np.nan, 10, 800, 40]))
    unsure = replace(good, confidence=np.nan)
    found = measure(capture, instances=[small, nowhere, good, unknown, unsure])
    assert values(found.fruit) == pytest.approx([0.16], abs=0.002)
    told = [failure.message for failure in found.failures]
    assert len(told) == 4
    assert "instance 1: the mask is 320x180, the picture 640x360" in told[0]
    assert "instance 2: the box [700, 10, 800, 40] has no area inside" in told[1]
    assert "instance 4: the box [nan, 10, 800, 40] is not finite" in told[2]
    assert "instance 5: the confidence is nan" in told[3]


def test_a_box_beyond_the_picture_is_cut_and_flagged() -> None:
    capture = capsule_capture(lying(0.16))
    wide = replace(Instance.of_mask(capture.masks[0]), box=np.array([-40.0, 100, 400, 220]))
    (fruit,) = measure(capture, instances=[wide]).fruit
    assert fruit.instance.box.tolist() == [-0.5, 100, 400, 220]
    assert Flag.BOX_CLIPPED in fruit.flags


def test_classes_choose_what_is_measured() -> None:
    capture = capsule_capture(lying(0.16, down_m=-0.05), lying(0.14, down_m=0.06))
    pair = [Instance.of_mask(mask) for mask in capture.masks]
    labelled = [replace(pair[0], class_name="Cucumber "), replace(pair[1], class_name="leaf")]
    assert len(measure(capture, instances=labelled).fruit) == 2
    results = measure(capture, instances=labelled, classes="cucumber")
    assert values(results.fruit) == pytest.approx([0.16], abs=0.002)
    assert results.captures[0].left_out == {"leaf": 1}


def test_a_file_that_names_none_of_the_captures_is_a_failure(tmp_path: Path) -> None:
    path = tmp_path / "labels.json"
    path.write_text(json.dumps([{"file_name": "other.png", "bbox": [1, 1, 5, 5]}]))
    (failure,) = measure(capsule_capture(lying(0.16)), instances=path).failures
    assert failure.error == "InstancesError"
    assert "names none of the captures (capsules); it names other.png" in failure.message


def halved(capture: Capture) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return capture.color[::2, ::2], capture.depth_m[::2, ::2], capture.masks[0][::2, ::2]


def test_a_matrix_of_the_unscaled_picture_is_refused() -> None:
    capture = capsule_capture(lying(0.16), camera=CAMERA_1280)
    color, depth_m, mask = halved(capture)
    matrix = CAMERA_1280.matrix
    with pytest.raises(IntrinsicsError, match=r"2 times as large as 640x360.*-50 % wrong"):
        measure(color, depth_m, matrix, masks=[mask])
    matrix[:2] /= 2
    (fruit,) = measure(color, depth_m, matrix, masks=[mask]).fruit
    assert fruit.length is not None
    assert fruit.length.value_m == pytest.approx(0.16, abs=0.002)


def test_a_cut_out_with_the_matrix_of_the_whole_is_doubted() -> None:
    capture = capsule_capture(lying(0.16, tilt_deg=35))
    part = slice(80, 280), slice(160, 560)
    color, depth_m, mask = (
        array[part] for array in (capture.color, capture.depth_m, capture.masks[0])
    )
    matrix = capture.intrinsics.matrix
    (fruit,) = measure(color, depth_m, matrix, masks=[mask]).fruit
    assert Flag.PRINCIPAL_POINT in fruit.flags


@pytest.mark.parametrize(
    ("depth", "words"),
    [
        (lambda depth_m: np.rint(depth_m * 255).astype(np.uint8), "depth has 8 bits"),
        (lambda depth_m: depth_m * 1000, "declared in metres, but 100 %.*0.001 m"),
        (lambda depth_m: depth_m > 0.5, "depth has 8 bits .bool"),
        (lambda depth_m: np.rint(depth_m).astype(np.uint16), "declared in millimetres, but"),
    ],
)
def test_depth_that_is_no_metres_is_refused(
    depth: Callable[[np.ndarray], np.ndarray], words: str
) -> None:
    capture = capsule_capture(lying(0.16, distance_m=0.9), wall_m=1.4)
    with pytest.raises(DepthError, match=words):
        measure(capture.color, depth(capture.depth_m), capture.intrinsics, masks=capture.masks)
