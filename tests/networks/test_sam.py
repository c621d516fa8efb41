"""The embedded network itself on drawn pictures; expected masks are what was drawn."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest

from cucumbervision.arrays import Array32, Mask, Numbers, Pixels
from cucumbervision.errors import ModelError, UnknownModelError
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision.networks.find import open_segmenter
from cucumbervision.networks.runtime import Network
from cucumbervision.networks.sam import (
    PROMPTS,
    Sam,
    mask_from_logits,
    prepare_picture,
    rows_needed,
    scaled_size,
)

Mask = Mask
Picture = Pixels


def drawn(height: int, width: int, *curves: list[tuple[int, int]], thick: int = 30) -> Picture:
    """Draw green tubes on a textured brown ground."""
    rng = np.random.default_rng(11)
    grain = cv2.GaussianBlur(rng.normal(0, 60, (height, width, 3)), (0, 0), 3)
    picture = np.clip(np.array([120, 85, 55]) + grain, 0, 255)
    for curve in curves:
        mask = tube(height, width, curve, thick)
        depth = np.clip(cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5) / thick, 0, 1)
        green = np.array([45, 110, 40]) + 60 * depth[..., None]
        picture[mask] = green[mask]
    return picture.astype(np.uint8)


def tube(height: int, width: int, curve: list[tuple[int, int]], thick: int = 30) -> Mask:
    canvas = np.zeros((height, width), np.uint8)
    cv2.polylines(canvas, [np.array(curve, np.int32)], False, 255, thick)
    return np.asarray(canvas > 0)


def iou(a: Mask | None, b: Mask | None) -> float:
    assert a is not None
    assert b is not None
    return float((a & b).sum() / (a | b).sum())


LEFT = [(80, 120), (150, 150), (220, 160), (300, 150)]
RIGHT = [(480, 100), (500, 200), (490, 300), (460, 380)]


class Remembered:
    """An encoder that looks at each picture once, however many tests show it."""

    def __init__(self, encoder: Network) -> None:
        self.inputs, self.runtime, self._encoder = encoder.inputs, encoder.runtime, encoder
        self._known: dict[bytes, dict[str, Numbers]] = {}

    def run(self, feeds: Mapping[str, Numbers]) -> dict[str, Numbers]:
        key = feeds["image"].tobytes()
        if key not in self._known:
            self._known[key] = dict(self._encoder.run(feeds))
        return self._known[key]


def open_sam(**options: Any) -> Sam:
    opened = open_segmenter("mobile-sam", **options)
    assert isinstance(opened, Sam)
    return opened


def remembering(segmenter: Sam) -> Sam:
    segmenter._encoder = cast(Network, Remembered(segmenter._encoder))
    return segmenter


@pytest.fixture(scope="module")
def segmenter() -> Sam:
    sam = open_sam(runtime="onnxruntime", full_precision=True)
    return remembering(sam)


def test_a_picture_is_encoded_once_and_another_in_its_place_anew(
    segmenter: Sam, monkeypatch: pytest.MonkeyPatch
) -> None:
    encoder, runs = segmenter._encoder, []

    def run(feeds: Mapping[str, Numbers]) -> dict[str, Numbers]:
        runs.append(feeds)
        return encoder.run(feeds)

    monkeypatch.setattr(segmenter, "_encoder", SimpleNamespace(inputs=encoder.inputs, run=run))
    picture = drawn(480, 640, LEFT)
    fruit = [Instance(box_of_mask(tube(480, 640, LEFT)))]
    (first,) = segmenter.segment(picture, fruit)
    (copied,) = segmenter.segment(picture.copy(), fruit)
    assert len(runs) == 1
    assert iou(first.mask, copied.mask) == 1
    picture[:] = drawn(480, 640, RIGHT)
    segmenter.mask_at(picture, 490, 250)
    assert len(runs) == 2
    # The one before is still known, and a few more; the oldest is not.
    (later,) = segmenter.segment(drawn(480, 640, LEFT), fruit)
    assert len(runs) == 2
    assert iou(first.mask, later.mask) == 1
    for grey in (10, 20, 30, 40):
        segmenter.mask_at(np.full((60, 80, 3), grey, np.uint8), 40, 30)
    segmenter.segment(drawn(480, 640, LEFT), fruit)
    assert len(runs) == 7


@pytest.mark.parametrize("size", [(640, 480), (720, 1280)])
def test_a_drawn_fruit_is_found(segmenter: Sam, size: tuple[int, int]) -> None:
    truth = tube(*size, LEFT)
    fruit = Instance(box_of_mask(truth), 0.8, "cucumber", detector_mask=truth)
    (instance,) = segmenter.segment(drawn(*size, LEFT), [fruit])
    assert iou(instance.mask, truth) > 0.9
    assert instance.mask is not None
    assert instance.mask.shape == size
    assert instance.mask.dtype == np.bool_
    assert instance.mask_source is MaskSource.SAM
    assert instance.mask_failure == ""
    assert instance.detector_mask is truth
    assert (instance.confidence, instance.class_name) == (0.8, "cucumber")


def test_several_fruit_equal_one_by_one(segmenter: Sam) -> None:
    picture = drawn(480, 640, LEFT, RIGHT)
    fruit = [Instance(box_of_mask(tube(480, 640, curve))) for curve in (LEFT, RIGHT)]
    # Five prompts do not go into one call of the decoder.
    together = segmenter.segment(picture, [fruit[0], fruit[1], fruit[0], fruit[0], fruit[1]])
    alone = [segmenter.segment(picture, [instance])[0] for instance in fruit]
    for i, k in enumerate([0, 1, 0, 0, 1]):
        assert iou(together[i].mask, alone[k].mask) > 0.9999
    assert iou(alone[1].mask, tube(480, 640, RIGHT)) > 0.9


@pytest.fixture(scope="module")
def as_shipped() -> list[Sam]:
    """One of each runtime, in the precision that users get."""
    pytest.importorskip("openvino")
    runtimes = ("onnxruntime", "openvino")
    return [remembering(open_sam(runtime=runtime)) for runtime in runtimes]


@pytest.mark.parametrize("prompt", PROMPTS)
def test_runtimes_agree(
    prompt: str, as_shipped: list[Sam], monkeypatch: pytest.MonkeyPatch
) -> None:
    picture, fruit = drawn(480, 640, LEFT), Instance(box_of_mask(tube(480, 640, LEFT)))
    instances: list[Instance] = []
    for one in as_shipped:
        monkeypatch.setattr(one, "prompt", prompt)
        instances += one.segment(picture, [fruit])
    assert iou(instances[0].mask, instances[1].mask) > 0.99


def test_parts_of_a_fruit_are_drawn_without_what_parts_them(segmenter: Sam) -> None:
    line = [(100, 200), (520, 200)]
    picture, truth = drawn(480, 640, line, thick=60), tube(480, 640, line, 60)
    before = tube(480, 640, [(310, 0), (310, 479)], 70)
    picture[before] = (200, 60, 60)
    truth &= ~before
    fruit = Instance(box_of_mask(truth), 0.8, detector_mask=truth)
    (instance,) = segmenter.segment(picture, [fruit])
    assert iou(instance.mask, truth) > 0.9
    assert instance.mask is not None
    assert (instance.mask & before).sum() < 0.02 * truth.sum()


def test_no_pixel_is_of_two_fruit(segmenter: Sam) -> None:
    across = [(200, 60), (200, 420)]
    picture = drawn(480, 640, LEFT, across)
    fruit = [
        Instance(box_of_mask(tube(480, 640, curve)), score)
        for curve, score in ((LEFT, 0.8), (across, 0.9))
    ]
    masks = [one.mask for one in segmenter.segment(picture, fruit) if one.mask is not None]
    assert masks
    assert np.sum(masks, axis=0).max() == 1


def test_colour_order_counts(segmenter: Sam) -> None:
    # Red and green swapped: SAM still sees a tube, but not with the same outline.
    picture, fruit = drawn(480, 640, LEFT), Instance(box_of_mask(tube(480, 640, LEFT)))
    (one,), (two,) = (segmenter.segment(p, [fruit]) for p in (picture, picture[..., ::-1]))
    assert one.mask is not None
    assert two.mask is not None
    assert not np.array_equal(one.mask, two.mask)


def test_a_mask_far_beyond_its_box_is_refused() -> None:
    by_point = open_sam(runtime="onnxruntime", prompt="point")
    middle = Instance(np.array([175.5, 140.5, 195.5, 170.5]), detector_mask=tube(480, 640, LEFT))
    (instance,) = by_point.segment(drawn(480, 640, LEFT), [middle])
    assert instance.mask_failure == "mask-off-box"
    assert instance.mask is None
    assert instance.mask_source is None
    assert instance.detector_mask is middle.detector_mask


def test_a_mask_unlike_the_detectors_is_refused(segmenter: Sam) -> None:
    # The detector says: only the left half of the tube is the fruit.
    truth = tube(480, 640, LEFT)
    half = truth.copy()
    half[:, 150:] = False
    fruit = Instance(box_of_mask(truth), detector_mask=half)
    (instance,) = segmenter.segment(drawn(480, 640, LEFT), [fruit])
    assert instance.mask_failure == "mask-off-detector"
    assert instance.mask is None


def test_the_detectors_mask_chooses_among_those_of_sam(
    segmenter: Sam, monkeypatch: pytest.MonkeyPatch
) -> None:
    # SAM offers the fruit with its shadow, and expects more of it than of the fruit alone.
    logits = np.full((2, 256, 256), -8.0, np.float32)
    logits[0, 40:100, 40:120] = 8.0  # a quarter of the picture's 1024 pixels each way
    logits[1, 40:80, 40:120] = 8.0
    answer = logits, np.array([0.9, 0.8], np.float32)
    monkeypatch.setattr(segmenter, "_answers", lambda *_: [answer])
    box = np.array([159.5, 159.5, 479.5, 399.5])
    own = np.zeros((1024, 1024), bool)
    own[165:320, 160:478] = True
    picture = np.zeros((1024, 1024, 3), np.uint8)
    (guided,) = segmenter.segment(picture, [Instance(box, detector_mask=own)])
    (alone,) = segmenter.segment(picture, [Instance(box)])
    fruit = np.zeros((1024, 1024), bool)
    fruit[160:320, 160:480] = True
    assert iou(guided.mask, fruit) > 0.98
    assert iou(alone.mask, fruit) == pytest.approx(40 / 60, abs=0.01)


def test_boxes_with_nothing_of_the_picture_in_them(segmenter: Sam) -> None:
    picture, fruit = drawn(480, 640, LEFT), Instance(box_of_mask(tube(480, 640, LEFT)))
    outside = [[700, 10, 800, 60], [-90, -90, -10, -10], [50, 50, 50, 90]]
    boxes = [Instance(np.array(box, float)) for box in outside]
    *nothing, instance = segmenter.segment(picture, [*boxes, fruit])
    assert {empty.mask_failure for empty in nothing} <= {"mask-off-box", "mask-small"}
    assert all(empty.mask is None for empty in nothing)
    assert iou(instance.mask, tube(480, 640, LEFT)) > 0.9


def test_a_box_that_reaches_out_of_the_picture(segmenter: Sam) -> None:
    cut = [(-60, 200), (60, 210), (200, 240)]
    truth = tube(480, 640, cut)
    box = box_of_mask(truth) - np.array([120.0, 0, 0, 0])
    (instance,) = segmenter.segment(drawn(480, 640, cut), [Instance(box)])
    assert iou(instance.mask, truth) > 0.9


def test_an_earlier_mask_and_failure_are_replaced(segmenter: Sam) -> None:
    truth = tube(480, 640, LEFT)
    old = Instance(
        box_of_mask(truth),
        mask=np.zeros((480, 640), bool),
        mask_source=MaskSource.DATASET,
        mask_failure="mask-small",
    )
    (instance,) = segmenter.segment(drawn(480, 640, LEFT), [old])
    assert iou(instance.mask, truth) > 0.9
    assert (instance.mask_source, instance.mask_failure) == (MaskSource.SAM, "")


def test_wrong_names_are_told() -> None:
    with pytest.raises(ModelError, match=r"no prompt is called 'mask'; choose one of box, box\+po"):
        open_segmenter(prompt="mask")
    with pytest.raises(UnknownModelError, match="'sam3'; choose one of mobile-sam"):
        open_segmenter("sam3")
    with pytest.raises(UnknownModelError, match="cucumber-seg draws no masks; choose one of mob"):
        open_segmenter("cucumber-seg")
    with pytest.raises(ModelError, match="nowhere"):
        Sam({"encoder": Path("nowhere.onnx"), "decoder": Path("nowhere.onnx")})


@pytest.mark.parametrize("size", [(576, 1024), (720, 1280), (300, 400)])
def test_red_is_first_and_normalised_by_its_own_spread(size: tuple[int, int]) -> None:
    picture = np.full((*size, 3), (200, 100, 50), np.uint8)
    height, width = scaled_size(*size)
    inside = prepare_picture(picture)[0, :, :height, :width]
    by_hand = [(200 - 123.675) / 58.395, (100 - 116.28) / 57.12, (50 - 103.53) / 57.375]
    for plane, value in zip(inside, by_hand, strict=True):
        np.testing.assert_allclose(plane, value, atol=1e-5)


def test_shrinking_smooths_as_pillow_does() -> None:
    # To half: a triangle four pixels wide on each, 1/8, 3/8, 3/8, 1/8.
    picture = np.zeros((2, 2048, 3), np.uint8)
    picture[:, 1000] = 255
    row = prepare_picture(picture)[0, 0, 0] * 58.395 + 123.675
    np.testing.assert_allclose(row[498:502], [0, 32, 96, 0], atol=1e-3)


def test_a_sliver_is_smoothed_along_its_length() -> None:
    # Two rows stay two, but 2048 columns become 1024: the comb of single pixels turns grey.
    picture = np.zeros((2, 2048, 3), np.uint8)
    picture[:, ::2] = 255
    row = prepare_picture(picture)[0, 0, 0, 1:-1] * 58.395 + 123.675
    np.testing.assert_allclose(row, 128, atol=1e-3)


def two_steps(logits: Array32, height: int, width: int) -> Array32:
    """SAM's own way: the whole square to 1024, without the padding, to the picture's size."""
    rows, columns = scaled_size(height, width)
    square = cv2.resize(logits, (1024, 1024), interpolation=cv2.INTER_LINEAR)
    cut = np.ascontiguousarray(square[:rows, :columns])
    return np.asarray(cv2.resize(cut, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


@pytest.mark.parametrize("size", [(720, 1280), (480, 640), (640, 480), (101, 37), (1500, 2000)])
@pytest.mark.parametrize("shift", [0.0, -2.0])
def test_masks_equal_the_two_steps(size: tuple[int, int], shift: float) -> None:
    rng = np.random.default_rng(7)
    blobs = cv2.GaussianBlur(rng.normal(size=(256, 256)), (0, 0), 9).astype(np.float32)
    logits = np.asarray(blobs / blobs.std() + shift, np.float32)
    wanted = two_steps(logits, *size)
    sure = np.abs(wanted) > 1e-3
    assert sure.mean() > 0.99
    assert np.array_equal(mask_from_logits(logits, *size)[sure], (wanted > 0)[sure])


@pytest.mark.parametrize("size", [(720, 1280), (480, 848), (101, 370)])
def test_padding_rows_may_be_left_out(size: tuple[int, int]) -> None:
    rows = rows_needed(*size)
    assert rows % 16 == 0
    assert 0 <= rows - scaled_size(*size)[0] < 16
    # Everything below the picture's own rows is nought.
    assert not prepare_picture(np.full((*size, 3), 200, np.uint8))[:, :, rows:].any()
    blobs = cv2.GaussianBlur(np.random.default_rng(7).normal(size=(256, 256)), (0, 0), 9)
    logits = np.asarray(blobs / blobs.std(), np.float32)
    logits[rows // 4 :] = logits[rows // 4 - 1]
    whole, short = mask_from_logits(logits, *size), mask_from_logits(logits[: rows // 4], *size)
    assert np.array_equal(whole, short)
    assert whole[-1].any()
