"""Detections of a picture merged, with the votes of a pose network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper
from tests.constant_network import constant_network, registry_of

from cucumbervision.arrays import Array32
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import ModelError
from cucumbervision.fruit.crops import (
    END_PX,
    HEIGHT_PX,
    PLANES,
    WIDTH_PX,
    EndCrop,
    FruitCrop,
    fruit_crop,
)
from cucumbervision.fruit.instance import UNKNOWN_ORDER, Instance
from cucumbervision.fruit.masks import box_of_mask, mask_iou
from cucumbervision.networks import DETECTOR_SIZES_PX
from cucumbervision.networks.find import (
    EndLooker,
    FruitLook,
    FruitLooker,
    NetworkLoader,
    PictureLooks,
    each_fruit_once,
    looked_at,
    refined,
)
from cucumbervision.networks.registry import file_sha256, load_registry


def fruit_at(x: float, confidence: float, width: float = 10.0) -> Instance:
    return Instance(np.array([x, 0.0, x + width, 40.0]), confidence)


def test_the_pose_network_has_a_say_in_what_is_a_fruit() -> None:
    detected = [fruit_at(0, 0.4), fruit_at(20, 0.4), fruit_at(40, 0.2), fruit_at(60, 0.9)]
    posed = [fruit_at(0, 0.6), fruit_at(40, 0.8), fruit_at(80, 0.9)]
    fruit = each_fruit_once(detected, posed, confidence=0.3, looks=2)
    # (2 x 0.9 + 0) / 3, (2 x 0.4 + 0.6) / 3 and (2 x 0.2 + 0.8) / 3; the second has 0.27 only, and
    # what the pose network alone sees is none.
    assert [(instance.box[0], round(instance.confidence, 3)) for instance in fruit] == [
        (60, 0.6),
        (0, 0.467),
        (40, 0.4),
    ]
    without = each_fruit_once(detected, None, confidence=0.3)
    assert [instance.confidence for instance in without] == [0.9, 0.4, 0.4]
    # A pose network that sees nothing says so.
    assert [instance.confidence for instance in each_fruit_once(detected, [])] == [0.45]


def test_a_pose_votes_for_one_detection_only() -> None:
    twice = [fruit_at(0, 0.8), fruit_at(1, 0.6, width=9)]
    fruit = each_fruit_once(twice, [fruit_at(0, 1.0)], confidence=0.31)
    assert [instance.confidence for instance in fruit] == [0.9]


def look_network(path: Path, side: int = END_PX) -> Path:
    """Write a network whose first eight outputs are the crop's mean and whose last its rows' sum.

    The last is the mean of the upper half of the first plane, which mirroring changes.
    """
    shapes = {"crops": ("n", PLANES, side, side), "shapes": ("n", 2)}
    inputs = [helper.make_tensor_value_info(k, TensorProto.FLOAT, v) for k, v in shapes.items()]
    ends = [("starts", [0, 0]), ("stops", [1, side // 2]), ("axes", [1, 2])]
    constants = [helper.make_tensor(k, TensorProto.INT64, [2], v) for k, v in ends]
    nodes = [
        helper.make_node("Slice", ["crops", "starts", "stops", "axes"], ["upper"]),
        helper.make_node("ReduceMean", ["upper"], ["mean"], axes=[1, 2, 3], keepdims=0),
        helper.make_node("ReduceMean", ["shapes"], ["shape"], axes=[1], keepdims=0),
        helper.make_node("Unsqueeze", ["mean", "last"], ["a"]),
        helper.make_node("Unsqueeze", ["shape", "last"], ["b"]),
        helper.make_node("Concat", ["a", *["b"] * 7, "a"], ["looks"], axis=1),
    ]
    constants.append(helper.make_tensor("last", TensorProto.INT64, [1], [1]))
    out = [helper.make_tensor_value_info("looks", TensorProto.FLOAT, ("n", 9))]
    model = helper.make_model(
        helper.make_graph(nodes, "g", inputs, out, constants),
        opset_imports=[helper.make_opsetid("", 17)],
        ir_version=9,
    )
    onnx.save(model, path)
    return path


def test_all_ends_are_one_batch_and_each_is_the_mean_with_its_mirror_image(tmp_path: Path) -> None:
    looker = EndLooker(look_network(tmp_path / "look.onnx"))
    batches: list[int] = []
    network = looker._network
    compute = network.compute

    def counted(feeds: dict[str, Array32]) -> list[Array32]:
        batches.append(len(feeds["crops"]))
        return compute(feeds)

    looker._network = replace(network, compute=counted)
    planes = np.zeros((END_PX, END_PX, PLANES), np.uint8)
    planes[: END_PX // 2, :, 0] = 255  # the upper half: the mean of it and its mirror is a half
    looks = looker.look([EndCrop(planes, (1.0, 3.0)), EndCrop(0 * planes, (0.0, 0.0))])
    assert batches == [4]
    first, second = looks
    expected = looked_at(np.array([0.5, *[2.0] * 7, 0.5]))
    assert first.stem == pytest.approx(expected.stem, abs=1e-6)
    assert first.covered == pytest.approx(expected.covered, abs=1e-6)
    assert second.stem == pytest.approx(0.5)
    assert looker.look([]) == []
    assert batches == [4]


def test_quantiles_never_cross_and_probabilities_are_one_together() -> None:
    look = looked_at(np.array([3.0, -1.0, 0.5, 1.0, -2.0, 0.0, 0.5, 4.0, 0.0]))
    assert list(look.missing) == sorted(look.missing)
    assert look.true + look.covered + look.running_on == pytest.approx(1.0)
    assert look.missing[-1] == pytest.approx(0.02 * np.sinh(4.0))


def test_another_network_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="not crops of ends"):
        EndLooker(load_registry().resolve("cucumber-fruit")["network"])
    with pytest.raises(ModelError, match="train classifier look"):
        EndLooker(look_network(tmp_path / "look.onnx", side=32))


PICTURE = np.full((64, 64, 3), 90, np.uint8)


def pose_network(path: Path) -> Path:
    """Finds one fruit whatever it sees, its points ordered by place."""
    rows = np.zeros((1, 300, 21), np.float32)
    line = np.column_stack([np.linspace(10, 54, 5), np.full(5, 32), np.ones(5)])
    rows[0, 0] = [8, 24, 56, 40, 0.9, 0, *line.ravel()]
    props = {"names": {0: "cucumber"}, "end2end": True, "kpt_shape": [5, 3], "task": "pose"}
    path.write_bytes(constant_network(rows, props={**props, "keypoint_order": "place"}))
    return path


def test_the_registrys_network_that_looks_at_fruit_goes_with_points_by_place(
    tmp_path: Path,
) -> None:
    pose = pose_network(tmp_path / "pose.onnx")
    fruit = load_registry().resolve("cucumber-fruit")["network"]
    loader = NetworkLoader(registry_of(tmp_path, pose=pose, fruit=fruit), runtime="onnxruntime")
    assert loader.stem_looker() is None
    (found,) = loader.yolo("tiny-pose").detect(PICTURE)
    # Points by place are of either direction until the picture is asked.
    assert found.end_confidence == UNKNOWN_ORDER
    stem_looker = loader.stem_looker()
    assert stem_looker is not None
    assert stem_looker is loader.fruit_looker()
    assert [(m["name"], m["task"], m["sha256"]) for m in loader.models] == [
        ("tiny-pose", "pose", file_sha256(pose)),
        ("tiny-fruit", "fruit", file_sha256(fruit)),
    ]


def test_without_a_network_that_looks_at_fruit_nobody_knows_the_ends(tmp_path: Path) -> None:
    pose = pose_network(tmp_path / "own.onnx")
    loader = NetworkLoader(registry_of(tmp_path), runtime="onnxruntime")
    (found,) = loader.pose(pose).detect(PICTURE)
    assert found.end_confidence == UNKNOWN_ORDER
    assert loader.stem_looker() is None
    assert [m["name"] for m in loader.models] == ["own.onnx"]


def test_ends_are_looked_at_by_the_registrys_network_loaded_with_the_first_crops(
    tmp_path: Path,
) -> None:
    assert NetworkLoader(registry_of(tmp_path)).look_at_ends is None
    loader = NetworkLoader(runtime="onnxruntime")
    look = loader.look_at_ends
    assert look is not None
    assert loader.models == []
    crop = EndCrop(np.full((END_PX, END_PX, PLANES), 90, np.uint8), (2.0, 3.0))
    first, again = look([crop]), look([crop])
    assert first == again
    assert [model["name"] for model in loader.models] == ["cucumber-look"]


def test_a_registry_without_detector(tmp_path: Path) -> None:
    loader = NetworkLoader(registry_of(tmp_path))
    with pytest.raises(ModelError, match="without a cucumber detector"):
        loader.detectors()


def test_the_shipped_detector_runs_at_the_sizes_that_the_documentation_names() -> None:
    # An export without sizes once replaced it, and no test noticed.
    detector = NetworkLoader().yolo("cucumber-seg")
    assert detector.looks == len(DETECTOR_SIZES_PX) == 2
    page = Path(__file__).parents[2].joinpath("docs/models.md").read_text(encoding="utf-8")
    first, second = DETECTOR_SIZES_PX
    assert f"The detector runs twice, at {first} and at {second} pixels" in page


MASK = np.zeros((120, 320), bool)
MASK[50:70, 60:260] = True
POINTS = np.column_stack([np.linspace(40, 215, 5), np.full(5, 55.5), np.linspace(0.1, 0.9, 5)])


def _crop() -> FruitCrop:
    crop = fruit_crop(np.zeros((120, 320, 3), np.uint8), None, MASK, None)
    assert crop is not None
    return crop


def _look(shown: slice, stem_last: float = 3.0) -> FruitLook:
    """Return a look that draws the columns of a slice of the fruit."""
    crop = _crop()
    columns = crop.to_crop(np.array([[shown.start - 0.5, 59.5], [shown.stop - 0.5, 59.5]]))[:, 0]
    low, high = np.sort(columns)
    outline = np.full((HEIGHT_PX, WIDTH_PX), -4.0, np.float32)
    half = 10 / crop.step_px
    rows = np.abs(np.arange(HEIGHT_PX) - (HEIGHT_PX - 1) / 2) < half
    inside = (np.arange(WIDTH_PX) > low) & (np.arange(WIDTH_PX) < high)
    outline[np.ix_(rows, inside)] = 4.0
    return FruitLook(outline, POINTS, fruit=2.0, stem_last=stem_last)


def _instance() -> Instance:
    return Instance(box_of_mask(MASK), 0.8, detector_mask=MASK, input_size_px=640)


def test_the_outline_is_that_of_the_look() -> None:
    shorter = np.zeros_like(MASK)
    shorter[50:70, 60:220] = True
    answer = refined(_instance(), _crop(), _look(slice(60, 220)))
    assert answer.detector_mask is not None
    assert mask_iou(answer.detector_mask, shorter) > 0.95


def test_an_outline_that_differs_much_is_not_taken() -> None:
    answer = refined(_instance(), _crop(), _look(slice(60, 160)))  # half of the detector's
    assert answer.detector_mask is MASK


@pytest.mark.parametrize("stem_last", [2.0, -2.0])
def test_keypoints_run_from_the_blossom_end_to_the_stem_end(stem_last: float) -> None:
    answer = refined(_instance(), _crop(), _look(slice(60, 260), stem_last))
    points = answer.keypoints
    assert points is not None
    expected = _crop().to_picture(POINTS[:, :2])
    ordered = expected if stem_last > 0 else expected[::-1]
    np.testing.assert_allclose(points[:, :2], ordered)
    # The most visible of them is the last of the crop.
    assert points[:, 2].argmax() == (4 if stem_last > 0 else 0)
    assert answer.end_confidence == pytest.approx(1 / (1 + np.exp(-2)))


def test_a_network_of_other_crops_is_refused() -> None:
    ends = load_registry().resolve("cucumber-look")["network"]
    with pytest.raises(ModelError, match="not crops of fruit"):
        FruitLooker(ends)


class GreenLooker(FruitLooker):
    """Outlines what is green, with the same points whatever it sees."""

    def __init__(self) -> None:
        self.shown: list[int] = []

    def look(self, crops: Sequence[FruitCrop], *, once: bool = False) -> list[FruitLook]:
        assert not once
        self.shown += [len(crops)] * bool(crops)
        greener = [crop.planes[..., 1] / 255.0 - crop.planes[..., 0] / 255.0 for crop in crops]
        return [FruitLook((40 * g - 4).astype(np.float32), POINTS, 2.0, 3.0) for g in greener]


def test_nothing_to_look_at_gives_nothing_and_fruit_without_mask_stay() -> None:
    looker = GreenLooker()
    color = np.full((120, 320, 3), 90, np.uint8)
    bare = replace(_instance(), detector_mask=None)
    assert looker.look([]) == []
    assert PictureLooks(looker, color).refine([bare]) == (bare,)


def test_fruit_get_the_networks_outlines_and_neighbours_keep_their_pixels() -> None:
    looker = GreenLooker()
    color = np.full((120, 320, 3), 200, np.uint8)
    color[MASK] = 40, 120, 45
    coarse, neighbour = np.zeros_like(MASK), np.zeros_like(MASK)
    coarse[46:74, 54:240] = True
    neighbour[46:74, 240:300] = True
    pair = [
        replace(_instance(), detector_mask=mask, box=box_of_mask(mask))
        for mask in (coarse, neighbour)
    ]
    first, second = PictureLooks(looker, color).refine(pair)
    assert first.detector_mask is not None
    visible = MASK & ~neighbour
    assert mask_iou(first.detector_mask, visible) > 0.95
    # Of the neighbour, the green part is too little to take it for an outline of the same fruit.
    assert second.detector_mask is neighbour


def test_what_a_crop_shows_changes_the_confidence() -> None:
    looker = GreenLooker()
    color = np.full((120, 320, 3), 200, np.uint8)
    bare = replace(_instance(), detector_mask=None)
    shown, unseen = PictureLooks(looker, color).rescore([_instance(), bare])
    # The network's log-odds are 2, those that change nothing 1: 0.4 more for the detector's.
    assert np.log(shown.confidence / (1 - shown.confidence)) == pytest.approx(np.log(4) + 0.4)
    assert unseen is bare


def test_each_mask_is_looked_at_once() -> None:
    looker = GreenLooker()
    color = np.full((120, 320, 3), 200, np.uint8)
    color[MASK] = 40, 120, 45
    looks = PictureLooks(looker, color)
    (rescored,) = looks.rescore([_instance()])
    joined = replace(rescored, detector_mask=MASK | np.roll(MASK, 3, axis=1))
    first, second = looks.refine([rescored, joined])
    assert looker.shown == [1, 1]
    assert first.detector_mask is not None
    assert second.detector_mask is not None
    # Another picture is another look.
    PictureLooks(looker, color).refine([rescored])
    assert looker.shown == [1, 1, 1]


def test_a_crop_and_the_turned_one_get_the_same_outline_and_opposite_stem_ends() -> None:
    looker = NetworkLoader(runtime="onnxruntime").fruit_looker()
    assert looker is not None
    capture = next(iter(open_source(example_captures()))).load()
    mask = next(mask for mask in capture.masks if mask.any())
    crop = fruit_crop(capture.color, capture.depth_m, mask, capture.intrinsics.fx_px)
    assert crop is not None
    turned = replace(crop, planes=crop.planes[::-1, ::-1])
    ahead, back = looker.look([crop, turned])
    alone = looker.look([crop], once=True)[0]
    assert abs(alone.stem_last - ahead.stem_last) > 1e-3
    np.testing.assert_allclose(back.outline[::-1, ::-1], ahead.outline, atol=1e-4)
    middle = np.array([(WIDTH_PX - 1) / 2, (HEIGHT_PX - 1) / 2])
    np.testing.assert_allclose(
        back.points[::-1, :2] - middle, middle - ahead.points[:, :2], atol=1e-2
    )
    np.testing.assert_allclose(back.points[::-1, 2], ahead.points[:, 2], atol=1e-4)
    assert back.stem_last == pytest.approx(-ahead.stem_last, abs=1e-4)
    assert back.fruit == pytest.approx(ahead.fruit, abs=1e-4)


@pytest.mark.parametrize("right", [False, True])
def test_points_by_place_are_ordered_by_the_look_and_others_stay(
    monkeypatch: pytest.MonkeyPatch, right: bool
) -> None:
    looker = GreenLooker()
    stem = _crop().to_picture(POINTS[[-1 if right else 0], :2])[0]
    look = _look(slice(60, 260), 3.0 if right else -3.0)
    monkeypatch.setattr(looker, "look", lambda crops, once: [look] * len(crops))
    line = np.column_stack([np.linspace(62, 258, 5), np.full(5, 59.5), np.linspace(0.2, 1, 5)])
    by_place = replace(_instance(), keypoints=line, end_confidence=UNKNOWN_ORDER)
    back = replace(by_place, keypoints=line[::-1], detector_mask=None, mask=MASK)
    known, bare = replace(by_place, end_confidence=0.8), _instance()
    color = np.full((120, 320, 3), 200, np.uint8)
    ordered = PictureLooks(looker, color).order([by_place, known, back, bare])
    assert ordered[1] is known
    assert ordered[3] is bare
    assert ordered[2].detector_mask is None
    for instance in (ordered[0], ordered[2]):
        assert instance.keypoints is not None
        last = instance.keypoints[-1]
        assert abs(last[0] - stem[0]) < 30
        assert last[2] == (1.0 if last[0] > 160 else 0.2)  # visibilities go with the points
        assert instance.end_confidence == pytest.approx(1 / (1 + np.exp(-3)))
    assert PictureLooks(looker, color).order([]) == ()


def test_keypoints_are_the_looks_and_no_pose_network_is_loaded(tmp_path: Path) -> None:
    shipped = load_registry()
    files = {task: shipped.resolve(f"cucumber-{name}")["network"] for task, name in OWN.items()}
    pose = pose_network(tmp_path / "pose.onnx")
    registry = registry_of(tmp_path, **files, pose=pose)
    loader = NetworkLoader(registry, runtime="onnxruntime", input_sizes=(640,))
    detectors = loader.detectors()
    assert [model["name"] for model in loader.models] == ["tiny-segment", "tiny-fruit"]
    assert detectors.gives_keypoints
    assert loader.stem_looker() is None  # the look orders its points itself
    capture = next(iter(open_source(example_captures()))).load()
    found = detectors.find(capture.color, capture.depth_m, capture.intrinsics.fx_px)
    assert found
    assert all(instance.keypoints is not None for instance in found)
    given = NetworkLoader(registry, runtime="onnxruntime")
    given.detectors(pose=pose)
    assert "fruit" not in {model["task"] for model in given.models}
    assert given.stem_looker() is not None


OWN = {"segment": "seg", "fruit": "fruit"}
