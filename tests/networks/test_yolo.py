from __future__ import annotations

import logging

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.constant_network import constant_network as network

from cucumbervision.errors import CucumberVisionError, ModelError
from cucumbervision.fruit.instance import Instance
from cucumbervision.networks.yolo import (
    SIZES_KEY,
    RowKind,
    YoloDetector,
    choose_raw,
    choose_rows,
    fit,
    merge_sizes,
    parse_input_sizes,
    raw_of,
    row_kind,
)

onnx = pytest.importorskip("onnx")

PICTURE = np.zeros((32, 64, 3), np.uint8)  # lies in 64x64 with 16 grey rows above and below


def chosen(*rows: list[float]) -> np.ndarray:
    """Lay rows out as the end-to-end head does, filled up with empty ones."""
    out = np.zeros((1, 300, len(rows[0])), np.float32)
    out[0, : len(rows)] = rows
    return out


FREE = (1, 3, "height", "width")
CUCUMBER = {"names": {0: "cucumber", 1: "leaf"}, "stride": 32, "imgsz": [64, 64]}
DETECT = CUCUMBER | {"task": "detect", "end2end": True}


@pytest.mark.parametrize("runtime", ["onnxruntime", "openvino"])
def test_end_to_end_segments(runtime: str) -> None:
    pytest.importorskip(runtime)
    coefficients = [0.0] * 32
    coefficients[3] = 2.0
    prototypes = np.full((1, 32, 16, 16), -1.0)
    prototypes[0, 3, :, :8] = 1.0
    rows = chosen([8, 20, 40, 30, 0.75, 1, *coefficients], [0, 16, 4, 20, 0.15, 0, *coefficients])
    props = CUCUMBER | {"task": "segment", "end2end": True}
    detector = YoloDetector(network(rows, prototypes, props=props), runtime)
    (fruit,) = detector.detect(PICTURE)
    assert (fruit.class_name, fruit.confidence, fruit.mask) == ("leaf", 0.75, None)
    # The picture is not scaled: 16 rows come off, and half a pixel for the centres.
    assert fruit.box.tolist() == [7.5, 3.5, 39.5, 13.5]
    # The prototype's edge is at column 32; the box cuts the rest.
    expected = np.zeros((32, 64), bool)
    expected[4:14, 8:32] = True
    assert fruit.detector_mask is not None
    assert np.array_equal(fruit.detector_mask, expected)


def test_pose_gives_keypoints_in_the_picture() -> None:
    points = [[8 + 8 * i, 24, 0.1 * i] for i in range(5)]
    rows = chosen([4, 20, 48, 30, 0.9, 0, *np.ravel(points)])
    props = CUCUMBER | {"task": "pose", "end2end": True, "kpt_shape": [5, 3]}
    (fruit,) = YoloDetector(network(rows, props=props)).detect(PICTURE)
    assert fruit.keypoints is not None
    expected = [[7.5 + 8 * i, 7.5, 0.1 * i] for i in range(5)]
    assert np.allclose(fruit.keypoints, expected, atol=1e-6)


def test_foreign_pose_gives_boxes_and_says_so(caplog: pytest.LogCaptureFixture) -> None:
    rows = chosen([4, 20, 48, 30, 0.9, 0, *[1.0] * 51])
    props = {"names": {0: "person"}, "task": "pose", "end2end": True, "kpt_shape": [17, 3]}
    with caplog.at_level(logging.WARNING, "cucumbervision"):
        detector = YoloDetector(network(rows, props=props))
    assert "it gives 17 keypoints" in caplog.text
    assert detector.detect(PICTURE)[0].keypoints is None


@pytest.mark.parametrize(("one_to_one", "count"), [(False, 1), (True, 2)])
def test_raw_head_is_suppressed_unless_one_to_one(one_to_one: bool, count: int) -> None:
    output = np.zeros((1, 6, 84), np.float32)
    output[0, :, 5] = [24, 32, 16, 8, 0.2, 0.9]
    output[0, :, 6] = [24, 32, 16, 8, 0.1, 0.8]
    props: dict[str, object] = CUCUMBER | {"task": "detect", "end2end": False}
    props |= {"one2one": True} if one_to_one else {}
    found = YoloDetector(network(output, props=props)).detect(PICTURE)
    assert len(found) == count
    assert found[0].class_name == "leaf"
    assert found[0].box.tolist() == [15.5, 11.5, 31.5, 19.5]
    assert found[0].detector_mask is None


def test_export_without_metadata_still_works() -> None:
    output = np.zeros((1, 5, 84), np.float32)
    output[0, :, 0] = [24, 32, 16, 8, 0.9]
    (fruit,) = YoloDetector(network(output)).detect(PICTURE)
    assert fruit.class_name == "0"


def test_embedded_suppression_is_read_as_rows() -> None:
    rows = chosen([8, 20, 40, 30, 0.75, 1])
    props = CUCUMBER | {"task": "detect", "end2end": False, "args": {"nms": True}}
    assert len(YoloDetector(network(rows, props=props)).detect(PICTURE)) == 1


def test_free_size_pads_to_the_stride_only() -> None:
    # 32x64 at imgsz 64 needs no padding, so the box comes back as it is.
    rows = chosen([8, 20, 40, 30, 0.75, 1])
    (fruit,) = YoloDetector(network(rows, props=DETECT, shape=FREE)).detect(PICTURE)
    assert fruit.box.tolist() == [7.5, 19.5, 39.5, 29.5]


@pytest.mark.parametrize("side_px", [4128, 10**9])
def test_an_input_of_gigabytes_is_refused(side_px: int) -> None:
    rows = chosen([8, 20, 40, 30, 0.75, 1])
    props = DETECT | {"imgsz": [64, side_px]}
    with pytest.raises(ModelError, match="pixels"):
        YoloDetector(network(rows, props=props, shape=FREE))


def test_an_input_size_scales_the_picture_and_is_told() -> None:
    # The network sees this box whatever the size: at 128 px it is half as large in the picture.
    rows = chosen([8, 4, 40, 12, 0.8, 0])
    free = network(rows, props=DETECT, shape=FREE)
    (own,) = YoloDetector(free).detect(PICTURE)
    (large,) = YoloDetector(free, input_sizes=(128,)).detect(PICTURE)
    assert (own.box.tolist(), own.input_size_px) == ([7.5, 3.5, 39.5, 11.5], 64)
    assert (large.box.tolist(), large.input_size_px) == ([3.5, 1.5, 19.5, 5.5], 128)


def test_a_file_says_at_which_sizes_it_is_run_where_nobody_asks() -> None:
    rows = chosen([8, 4, 40, 12, 0.8, 0])
    props = DETECT | {SIZES_KEY: "128,64"}
    free = network(rows, props=props, shape=FREE)
    found = YoloDetector(free).detect(PICTURE)
    assert sorted(one.input_size_px or 0 for one in found) == [64, 128]
    (asked,) = YoloDetector(free, input_sizes=(96,)).detect(PICTURE)
    assert asked.input_size_px == 96
    with pytest.raises(CucumberVisionError, match="'650' is not an input size"):
        YoloDetector(network(rows, props=props | {SIZES_KEY: "650"}, shape=FREE))


def test_what_two_sizes_find_alike_is_found_once() -> None:
    # Beyond the input at either size: the whole picture.
    rows = chosen([0, 0, 900, 900, 0.8, 0], [0, 0, 900, 900, 0.6, 1])
    free = network(rows, props=DETECT, shape=FREE)
    found = YoloDetector(free, input_sizes=(64, 128)).detect(PICTURE)
    assert [one.class_name for one in found] == ["cucumber", "leaf"]
    assert [one.confidence for one in found] == pytest.approx([0.8, 0.6])


def test_what_one_of_two_sizes_finds_must_be_twice_as_sure() -> None:
    # At 128 px the box is another, half as large: each is found by one size.
    rows = chosen([8, 4, 40, 12, 0.8, 0])
    free = network(rows, props=DETECT, shape=FREE)
    both = YoloDetector(free, confidence=0.3, input_sizes=(64, 128)).detect(PICTURE)
    assert [one.confidence for one in both] == pytest.approx([0.4, 0.4])
    assert YoloDetector(free, confidence=0.45, input_sizes=(64, 128)).detect(PICTURE) == ()


def test_a_network_of_one_size_refuses_another() -> None:
    fixed = network(chosen([8, 20, 40, 30, 0.8, 0]), props=CUCUMBER | {"end2end": True})
    assert len(YoloDetector(fixed, input_sizes=(64,)).detect(PICTURE)) == 1
    with pytest.raises(ModelError, match="takes 64x64 only, not 128"):
        YoloDetector(fixed, input_sizes=(128,))


def test_box_on_the_grey_border_is_left_out() -> None:
    rows = chosen([8, 0, 40, 15, 0.75, 1])
    assert YoloDetector(network(rows, props=DETECT)).detect(PICTURE) == ()


@pytest.mark.parametrize(
    ("graph", "fault"),
    [
        (network(np.zeros((1, 1000))), "its outputs are output0 1x1000"),
        (network(np.zeros((1, 6, 5)), props={"task": "obb"}), "its task is 'obb'"),
        (network(np.zeros((1, 9, 84)), props=CUCUMBER), "the output 9x84 is no detect head"),
        (network(np.zeros((1, 5, 84)), shape=(4, 3, 64, 64)), "it takes 4 pictures at once"),
        (network(np.zeros((1, 5, 84)), shape=(1, 1, 64, 64)), "its inputs are images 1x1x64x64"),
        (network(np.zeros((1, 5, 84)), props={"names": "__import__('os')"}), "'names': "),
        (network(np.zeros((1, 20, 84)), props={"task": "pose", "kpt_shape": 5}), "'kpt_shape': "),
    ],
)
def test_other_networks_are_refused(graph: bytes, fault: str) -> None:
    with pytest.raises(ModelError, match=fault):
        YoloDetector(graph)


# 64x64 pixels are 64 + 16 + 4 cells of strides 8, 16 and 32.
def of_yolov5(box: list[float], objectness: float, score: float, *extras: float) -> np.ndarray:
    """Lay one detection out as YOLOv5 does: three rows for each of 84 cells."""
    rows = np.zeros((1, 3 * 84, 6 + len(extras)), np.float32)
    rows[0, 100] = [*box, objectness, score, *extras]
    return rows


@pytest.mark.parametrize("props", [{}, {"names": {0: "cucumber"}, "stride": 32}])
def test_rows_of_yolov5_with_one_class_are_centres_and_objectness(props: dict[str, object]) -> None:
    detector = YoloDetector(network(of_yolov5([24, 25, 32, 10], 0.8, 0.9), props=props))
    (fruit,) = detector.detect(PICTURE)
    assert fruit.confidence == pytest.approx(0.72)
    assert fruit.box.tolist() == [7.5, 3.5, 39.5, 13.5]


def test_rows_of_another_detector_are_refused_and_not_read_as_boxes() -> None:
    # RT-DETR with two classes: centre and size as shares of the picture, and two scores.
    rows = np.tile([0.4, 0.5, 0.5, 0.2, 0.05, 0.9], (1, 300, 1))
    names = {"names": {0: "leaf", 1: "cucumber"}}
    detector = YoloDetector(network(rows, props=names))
    with pytest.raises(ModelError, match="its rows are not x1, y1, x2, y2, score, class"):
        detector.detect(PICTURE)
    with pytest.raises(ModelError, match="300x5 is no detect head of 1 classes"):
        YoloDetector(network(rows[..., :5], props={"names": {0: "cucumber"}}))


@pytest.mark.parametrize("stride", [0, -32, 1.5, "'a'", 4096])
def test_a_stride_that_is_none_is_refused(stride: object) -> None:
    with pytest.raises(ModelError, match="'stride': "):
        YoloDetector(network(np.zeros((1, 6, 84)), props=CUCUMBER | {"stride": stride}))


@pytest.mark.parametrize(
    ("shape", "classes", "extra", "end_to_end", "expected"),
    [
        # 640x640: 6400 + 1600 + 400 cells.
        ((84, 8400), 80, 0, False, (RowKind.RAW, 80)),
        ((5, 8400), 0, 0, False, (RowKind.RAW, 1)),
        ((37, 8400), 1, 32, False, (RowKind.RAW, 1)),
        ((8400, 6), 2, 0, False, (RowKind.RAW_ROWS, 2)),
        ((8400, 6), 0, 0, False, (RowKind.RAW_ROWS, 2)),
        ((25200, 6), 1, 0, False, (RowKind.OBJECT_ROWS, 1)),
        ((25200, 6), 0, 0, False, (RowKind.OBJECT_ROWS, 1)),
        ((25200, 7), 2, 0, False, (RowKind.OBJECT_ROWS, 2)),
        ((25200, 38), 1, 32, False, (RowKind.OBJECT_ROWS, 1)),
        ((300, 6), 1, 0, True, (RowKind.FINAL, 1)),
        ((300, 6), 80, 0, False, (RowKind.FINAL, 80)),
        ((300, 38), 1, 32, True, (RowKind.FINAL, 1)),
        ((25200, 6), 2, 0, False, None),
        ((8400, 6), 1, 0, False, None),
        ((300, 5), 1, 0, False, None),
        ((300, 4), 0, 0, False, None),
    ],
)
def test_layouts_are_told_apart_by_columns_and_rows(
    shape: tuple[int, int],
    classes: int,
    extra: int,
    end_to_end: bool,
    expected: tuple[RowKind, int] | None,
) -> None:
    kind = row_kind(shape, classes=classes, extra=extra, input_px=(640, 640), end_to_end=end_to_end)
    assert kind == expected


def test_objectness_counts_for_every_class_and_extras_follow() -> None:
    rows = np.array([[5, 6, 4, 2, 0.5, 0.8, 0.2, 7]])
    raw_rows = raw_of(rows, RowKind.OBJECT_ROWS, 2)
    assert raw_rows.ravel() == pytest.approx([5, 6, 4, 2, 0.4, 0.1, 7])


@pytest.mark.parametrize(
    "row",
    [
        [0, 0, 4, 4, 0.9, 0.5],  # a class that is none
        [0, 0, 4, 4, 0.9, -1],
        [0, 0, 4, 4, 1.5, 0],  # a score beyond 1
        [8, 8, 4, 4, 0.9, 0],  # centre and size
    ],
)
def test_final_rows_of_another_kind_are_refused(row: list[float]) -> None:
    with pytest.raises(ModelError, match=r"net\.onnx: its rows are not"):
        choose_rows(np.array([row]), 0.3, source="net.onnx")


def raw(*anchors: tuple[float, ...]) -> np.ndarray:
    return np.array(anchors, np.float32).T


def test_one_to_one_anchor_may_answer_for_two_classes() -> None:
    out = choose_raw(raw((5, 5, 4, 4, 0.5, 0.75)), 2, 0.3, one_to_one=True)
    assert out[:, 4:6].tolist() == [[0.75, 1], [0.5, 0]]


def test_one_to_one_takes_at_most_300() -> None:
    anchors = [(5.0, 5.0, 4.0, 4.0, 0.4 + i * 1e-4) for i in range(400)]
    out = choose_raw(raw(*anchors), 1, 0.3, one_to_one=True)
    assert len(out) == 300
    assert out[-1, 4] == pytest.approx(0.41)


ONE = np.ones(1, np.float32)  # the weight of a single prototype

sides = st.integers(1, 1500)


def test_wide_picture_by_hand() -> None:
    # 1280x720 to 640x640: gain 1/2, 360 rows, 280 spare, 140 above.
    box = fit(720, 1280, (640, 640))
    picture = np.full((720, 1280, 3), 200, np.uint8)
    out = box.apply(picture)
    assert out.shape == (640, 640, 3)
    assert (out[140:500] == 200).all()
    assert (out[:140] == 114).all()
    assert (out[500:] == 114).all()


def test_rounded_sides_have_gains_of_their_own() -> None:
    # 427x640 to 320: gain 1/2, 213.5 rows become 214, so rows scale by 214/427.
    box = fit(427, 640, (320, 320))
    assert box.inner_height == 214
    corner = box.points_back(np.array([320.0, box.top_px + 214.0]))
    assert corner.tolist() == pytest.approx([639.5, 426.5])


@given(sides, sides, st.sampled_from([320, 640]))
@settings(max_examples=50, deadline=None)
def test_corners_come_back_exactly(height: int, width: int, size: int) -> None:
    box = fit(height, width, (size, size))
    corners = np.array(
        [[box.left_px, box.top_px], [box.left_px + box.inner_width, box.top_px + box.inner_height]]
    )
    expected = [[-0.5, -0.5], [width - 0.5, height - 0.5]]
    assert np.allclose(box.points_back(corners), expected, atol=1e-9)


def test_mask_of_a_half_plane_lies_where_its_edge_is() -> None:
    # 640x320 into 320x320 (gain 1/2, 80 grey rows): a prototype pixel is 8 picture pixels.
    # Logits rise by 1 a prototype column and are 0 between columns 19 and 20 (column edge 20),
    # which is picture column edge 160.
    box = fit(320, 640, (320, 320))
    logits = np.tile(np.arange(80) - 19.5, (80, 1)).astype(np.float32)
    mask = box.mask_back(logits[None], ONE, np.array([-0.5, -0.5, 639.5, 319.5]))
    assert mask.shape == (320, 640)
    assert not mask[:, :160].any()
    assert mask[:, 160:].all()


def test_grey_rows_lend_nothing_to_the_mask() -> None:
    # 64x32 into 64x64: 16 grey rows above and below, four prototype rows each. They are set, the
    # picture's own are not.
    box = fit(32, 64, (64, 64))
    logits = np.full((16, 16), -1, np.float32)
    logits[:4] = logits[12:] = 9
    assert not box.mask_back(logits[None], ONE, np.array([-0.5, -0.5, 63.5, 31.5])).any()


def find(left: float, confidence: float, size: int, name: str = "cucumber") -> Instance:
    box = np.array([left, 0, left + 100, 20], np.float64)
    return Instance(box, confidence, class_name=name, input_size_px=size)


def test_the_mask_is_that_of_the_first_size_that_is_half_as_sure_as_the_best() -> None:
    (both,) = merge_sizes([[find(0, 0.45, 640)], [find(0, 0.9, 896)]])
    (weak,) = merge_sizes([[find(0, 0.44, 640)], [find(0, 0.9, 896)]])
    (large,) = merge_sizes([[], [find(0, 0.9, 896)]])
    assert [one.input_size_px for one in (both, weak, large)] == [640, 896, 896]


def test_boxes_that_agree_less_and_other_classes_stay_apart() -> None:
    # 40 px apart: an IoU of 60/140.
    apart = merge_sizes([[find(0, 0.8, 640)], [find(40, 0.6, 896)]])
    assert [one.confidence for one in apart] == pytest.approx([0.4, 0.3])
    leaf = merge_sizes([[find(0, 0.8, 640)], [find(0, 0.6, 896, "leaf")]])
    assert [one.class_name for one in leaf] == ["cucumber", "leaf"]


def test_each_find_joins_the_nearest_of_another_size_and_never_one_of_its_own() -> None:
    merged = merge_sizes([[find(0, 0.9, 640), find(20, 0.8, 640)], [find(22, 0.6, 896)]])
    assert [one.confidence for one in merged] == pytest.approx([0.7, 0.45])
    assert merged[1].box.tolist() == [0, 0, 100, 20]


def test_one_size_stays_as_it_is_and_nothing_gives_nothing() -> None:
    finds = (find(0, 0.9, 640), find(5, 0.8, 640))
    assert merge_sizes([finds]) == finds
    assert merge_sizes([[], []]) == ()


@pytest.mark.parametrize("text", ["650", "0", "-32", "640,", "640;960", "1e3", "4128"])
def test_what_is_no_input_size_is_refused(text: str) -> None:
    with pytest.raises(CucumberVisionError, match="is not an input size"):
        parse_input_sizes(text)
