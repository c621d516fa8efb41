from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.crops import EndCrop, EndLook
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision.methods import intervals
from cucumbervision.methods.flags import Flag, flag_remarks
from cucumbervision.methods.intervals import (
    LOOKED,
    PERCEIVED,
    REAL_SD,
    Band,
    IntervalModel,
    IntervalModels,
    Trees,
)
from cucumbervision.methods.result import (
    Choice,
    Fruit,
    Measurement,
    MethodName,
    Reason,
    Selector,
    TubeFit,
)
from cucumbervision.methods.selector import choose, end_doubts, measure_fruit, with_end_looks
from cucumbervision_lab.scenes.bodies import arc_tube, rotation
from cucumbervision_lab.scenes.scene import Scene, render

LONG, COMPACT = np.array([0.0, 0.0, 100.0, 20.0]), np.array([0.0, 0.0, 100.0, 60.0])


def failed(method: MethodName) -> Measurement:
    return Measurement(method, reason=Reason.TOO_FEW_BINS)


def good(*methods: MethodName) -> dict[str, Measurement]:
    return {m: Measurement(m, 0.1 * k) for k, m in enumerate(methods, start=1)}


ALL = good(MethodName.M1, MethodName.M2, MethodName.M3, MethodName.M4, MethodName.M5)


@pytest.mark.parametrize(
    ("points", "box", "expected", "choice"),
    [
        (100, LONG, MethodName.M5, Choice.DENSE_MASK),
        (99, LONG, MethodName.M3, Choice.SPARSE_MASK),
        (None, LONG, MethodName.M1, Choice.ELONGATED_BOX),
        (None, LONG[[1, 0, 3, 2]], MethodName.M1, Choice.ELONGATED_BOX),  # hanging
        (None, np.array([0.0, 0, 36, 20]), MethodName.M1, Choice.ELONGATED_BOX),  # exactly 1.8
        (None, COMPACT, MethodName.M2, Choice.COMPACT_BOX),
        (None, COMPACT + np.array([200.0, 0, 200, 0]), MethodName.M2, Choice.COMPACT_BOX),
    ],
)
def test_decisions(
    points: int | None, box: NDArray[np.float64], expected: MethodName, choice: Choice
) -> None:
    chosen, why, path = choose(ALL, points, box)
    assert chosen is ALL[expected]
    assert why is choice
    assert path == ()


def test_the_tube_comes_first_where_it_was_fitted() -> None:
    chosen, _, _ = choose({**ALL, MethodName.M6: Measurement(MethodName.M6, 0.3)}, 500, LONG)
    assert chosen is not None
    assert chosen.method is MethodName.M6
    paper, _, _ = choose(
        {**ALL, MethodName.M6: Measurement(MethodName.M6, 0.3)}, 500, LONG, Selector.PAPER
    )
    assert paper is ALL[MethodName.M5]


def test_m4_that_stands_on_m3_does_not_jump_the_queue() -> None:
    borrowed = Measurement(
        MethodName.M4, 0.2, fallback=("M4:endpoint-missing",), measured_by=MethodName.M3
    )
    chosen, _, path = choose(
        {**ALL, MethodName.M5: failed(MethodName.M5), MethodName.M4: borrowed}, 500, LONG
    )
    assert chosen is ALL[MethodName.M3]
    assert path == ("M5:too-few-bins",)


def test_a_mask_that_gives_nothing_leads_to_the_box_methods() -> None:
    results = {m: failed(m) for m in (MethodName.M3, MethodName.M4, MethodName.M5)} | good(
        MethodName.M1, MethodName.M2
    )
    assert choose(results, 500, LONG)[0] is results[MethodName.M1]
    assert choose(results, 500, COMPACT)[0] is results[MethodName.M2]


def test_m1_and_m2_stand_in_for_each_other() -> None:
    results: dict[str, Measurement] = good(MethodName.M2) | {MethodName.M1: failed(MethodName.M1)}
    chosen, _, path = choose(results, None, LONG)
    assert chosen is results[MethodName.M2]
    assert path == ("M1:too-few-bins",)


def test_nothing_measured_tells_every_attempt() -> None:
    chosen, _, path = choose({m: failed(m) for m in (MethodName.M1, MethodName.M2)}, None, COMPACT)
    assert chosen is None
    assert path == ("M2:too-few-bins", "M1:too-few-bins")


@pytest.fixture
def plate(camera: Intrinsics) -> Capture:
    depth = np.zeros((720, 1280), np.float32)
    depth[340:380, 440:840] = 0.455
    return Capture(np.zeros((720, 1280, 3), np.uint8), depth, camera, "plate")


BOX = np.array([439.5, 339.5, 839.5, 379.5])


def test_a_fruit_with_hardly_any_depth_has_no_length(plate: Capture) -> None:
    beside = measure_fruit(plate, Instance(np.array([9.5, 9.5, 209.5, 49.5])))
    assert (beside.selected, beside.fallback) == (None, ("M1:no-depth", "M2:no-depth"))
    mask = plate.depth_m > 0
    for columns, is_measured in ((48, True), (36, False), (0, False)):
        plate.depth_m[:, 440 + columns : 840] = 0
        fruit = measure_fruit(plate, Instance(BOX, mask=mask, mask_source=MaskSource.SAM))
        assert (fruit.length is None) is (fruit.reason is Choice.NO_DEPTH) is not is_measured


def test_paper_counts_only_sams_or_the_data_sets_mask(plate: Capture) -> None:
    own = plate.depth_m > 0
    detected = Instance(BOX, detector_mask=own, mask_failure="mask-small")
    paper = measure_fruit(plate, detected, selector=Selector.PAPER)
    assert paper.selected is not None
    assert paper.selected.method is MethodName.M1
    assert paper.reason == Choice.ELONGATED_BOX
    assert paper.flags[0] == "sam-mask-small"
    best = measure_fruit(plate, detected, selector=Selector.BEST)
    assert best.selected is not None
    assert best.selected.method is MethodName.M6
    assert best.mask_source is MaskSource.DETECTOR
    assert best.flags == ("sam-mask-small", "detector-mask")
    sam = replace(detected, mask=own, mask_source=MaskSource.SAM, mask_failure="")
    assert measure_fruit(plate, sam, selector=Selector.PAPER).reason == Choice.DENSE_MASK


def test_points_are_counted_before_the_gate(plate: Capture) -> None:
    mask = np.zeros((720, 1280), bool)
    mask[340:345, 440:460] = True  # 100 pixels
    depth = plate.depth_m.copy()
    depth[340:342, 440:460] = 0.6  # 40 of them beyond the gate
    fruit = measure_fruit(
        replace(plate, depth_m=depth), Instance(BOX, mask=mask, mask_source=MaskSource.SAM)
    )
    assert fruit.reason == Choice.DENSE_MASK
    assert fruit.fallback[:2] == ("M6:too-few-points", "M5:too-few-points")
    assert fruit.selected is not None
    assert fruit.selected.method is MethodName.M3


@pytest.mark.parametrize(
    ("box", "cut"),
    [
        ((-0.5, 100.0, 200.0, 140.0), True),
        ((0.5, 100.0, 200.0, 140.0), False),
        ((1100.0, 100.0, 1279.5, 140.0), True),
        ((100.0, 600.0, 140.0, 719.5), True),
        ((100.0, 600.0, 140.0, 718.0), False),
    ],
)
def test_a_box_at_the_pictures_edge_is_flagged(
    plate: Capture, box: tuple[float, ...], cut: bool
) -> None:
    fruit = measure_fruit(plate, Instance(np.array(box)))
    assert ("cut-by-frame" in fruit.flags) is cut


def test_a_mask_at_the_pictures_edge_is_measured_and_flagged(plate: Capture) -> None:
    depth = np.full_like(plate.depth_m, 0.455)
    mask = np.zeros((720, 1280), bool)
    mask[340:380, :400] = True
    box = np.array([-0.5, 339.5, 399.5, 379.5])
    fruit = measure_fruit(replace(plate, depth_m=depth), Instance(box, mask=mask))
    assert "cut-by-frame" in fruit.flags
    assert fruit.selected is not None
    assert fruit.selected.fit is not None
    assert not all(fruit.selected.fit.ends_seen)
    assert "end-hidden" in fruit.flags
    assert fruit.selected.length_m == pytest.approx(0.2, rel=0.08)


def test_seen_endpoints_log_m4_beside_the_choice(plate: Capture) -> None:
    keypoints = np.array([[u, 360.0, 1.0] for u in (450, 550, 640, 730, 830)])
    mask = plate.depth_m > 0
    instance = Instance(BOX, mask=mask, mask_source=MaskSource.SAM, keypoints=keypoints)
    fruit = measure_fruit(plate, instance)
    assert fruit.selected is not None
    assert fruit.selected.method is MethodName.M6
    assert fruit.measurements[MethodName.M4].length_m == pytest.approx(0.19, rel=1e-4)


BLOSSOM, STEM = 40, 240  # the keypoints' outermost columns: 200 px apart


def line(visibility: tuple[float, ...] = (1, 1, 1, 1, 1)) -> NDArray[np.float64]:
    u = np.linspace(BLOSSOM, STEM, 5)
    return np.column_stack([u, np.full(5, 60.0), visibility])


def bar(left: int, right: int) -> NDArray[np.bool_]:
    mask = np.zeros((120, 320), bool)
    mask[50:71, left : right + 1] = True
    return mask


def end_flags(mask: NDArray[np.bool_] | None, keypoints: NDArray[np.float64]) -> tuple[str, ...]:
    *hidden, disagree = end_doubts(mask, keypoints)
    return ("end-hidden",) * any(hidden) + ("ends-disagree",) * disagree


@pytest.mark.parametrize(
    ("left", "right", "flags"),
    [
        (40, 240, ()),
        (59, 240, ()),  # ends 19 of 200 px before the keypoint
        (61, 240, ("end-hidden",)),
        (40, 219, ("end-hidden",)),
        (150, 240, ("end-hidden",)),  # nothing at all near the blossom end
        (21, 259, ()),
        (19, 240, ("ends-disagree",)),
        (40, 261, ("ends-disagree",)),
        (61, 261, ("end-hidden", "ends-disagree")),
    ],
)
def test_mask_against_keypoints(left: int, right: int, flags: tuple[str, ...]) -> None:
    assert end_flags(bar(left, right), line()) == flags
    # The same the other way round, and upright.
    mirrored = line()[::-1]
    assert end_flags(bar(left, right), mirrored) == flags
    upright = line()[:, [1, 0, 2]]
    assert end_flags(bar(left, right).T, upright) == flags


@pytest.mark.parametrize(
    ("visibility", "flags"),
    [
        ((0.4, 1, 1, 1, 0.4), ()),
        ((0.39, 1, 1, 1, 1), ("end-hidden",)),
        ((1, 1, 1, 1, 0.2), ("end-hidden",)),
        ((0, 0, 0, 0, 0), ()),  # labelled nowhere: nothing is known
    ],
)
def test_visibility_of_the_ends(visibility: tuple[float, ...], flags: tuple[str, ...]) -> None:
    assert end_flags(bar(40, 240), line(visibility)) == flags
    assert end_flags(None, line(visibility)) == flags


def test_keypoints_on_one_spot_are_no_line() -> None:
    spot = np.column_stack([np.full((5, 2), 60.0), np.ones(5)])
    assert end_flags(bar(40, 240), spot) == ()


def test_a_hook_is_judged_by_its_own_end() -> None:
    # A half circle of 100 px radius: the other end lies ahead of neither.
    y, x = np.indices((260, 260))
    far = np.hypot(x - 130, y - 130)
    mask = (np.abs(far - 100) <= 12) & (y <= 130)
    angle = np.linspace(0, np.pi, 5)
    points = np.column_stack([130 + 100 * np.cos(angle), 130 - 100 * np.sin(angle), np.ones(5)])
    assert end_flags(mask, points) == ()
    assert end_flags(mask & (y <= 85), points) == ("end-hidden",)


def test_a_row_says_that_an_end_is_hidden_once() -> None:
    # Half of a fruit behind a leaf: the depth ends with the mask, the keypoints go on.
    depth = np.zeros((720, 1280), np.float32)
    depth[340:381, 440:641] = 0.5
    camera = Intrinsics(1280, 720, 910.0, 910.0, 640.0, 360.0)
    capture = Capture(np.zeros((720, 1280, 3), np.uint8), depth, camera, "leaf")
    keypoints = np.array([[u, 360.0, 1.0] for u in (440, 540, 640, 740, 840)])
    box = np.array([439.5, 339.5, 640.5, 380.5])
    instance = Instance(box, mask=depth > 0, mask_source=MaskSource.SAM)
    methods = (MethodName.M3, MethodName.M5)
    assert "end-hidden" not in measure_fruit(capture, instance, methods).flags
    hinted = measure_fruit(capture, replace(instance, keypoints=keypoints), methods)
    assert hinted.flags.count("end-hidden") == 1
    both = measure_fruit(capture, replace(instance, keypoints=keypoints))
    assert both.flags.count("end-hidden") == 1


TRUE = EndLook(0.98, 0.01, 0.01, (-0.01, -0.004, 0.0, 0.004, 0.01), 0.5)
COVERED = EndLook(0.15, 0.84, 0.01, (0.0, 0.1, 0.2, 0.3, 0.5), 0.5)
STEM_LOOK = replace(TRUE, stem=1.0)

_M6 = "M6" + PERCEIVED


def model(key: str, spread: float, low: float = 1.0) -> IntervalModel:
    """An interval that is narrow below and wide above where an end is covered."""
    bands = {"": Band(1.0, 1.0, 500), "0": Band(1.0, 1.0, 500), "1": Band(low, 1.0, 9)}
    trees = Trees(np.log(spread))
    return IntervalModel(key, 0.9, (), trees, trees, bands, (("covered", (0.5,)),))


MODELS = IntervalModels(
    0.9, {_M6: model(_M6, 0.2), _M6 + LOOKED: model(_M6 + LOOKED, 0.02, 20.0)}, 500
)


@pytest.fixture(scope="module")
def capture() -> tuple[Capture, Instance, Instance]:
    """Two drawn fruit of 16 cm, one upright and one lying, half a metre away."""
    camera = Intrinsics(1280, 720, 910.0, 910.0, 640.0, 360.0)
    upright = arc_tube(0.16, 0.018, 0.4).moved(rotation(roll_deg=90), (-0.15, 0, 0.5))
    lying = arc_tube(0.16, 0.018, 0.4).moved(rotation(5), (0.1, 0, 0.5))
    # No depth is read beyond the fruit, so that it does not show their ends to be open.
    scene = render(Scene.of(upright, lying), camera)
    fruit = [
        Instance(box_of_mask(scene.mask(k)), mask=scene.mask(k), mask_source=MaskSource.DETECTOR)
        for k in (0, 1)
    ]
    color = np.zeros((720, 1280, 3), np.uint8)
    return Capture(color, scene.depth_m.astype(np.float32), camera, "drawn"), fruit[0], fruit[1]


@pytest.fixture(autouse=True)
def _models(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(intervals, "shipped_interval_models", lambda: MODELS)


def measured(capture: Capture, *instances: Instance) -> list[Fruit]:
    return [measure_fruit(capture, one, (MethodName.M6,), scale_known=True) for one in instances]


def fit_of(fruit: Fruit) -> TubeFit:
    assert fruit.fit is not None
    return fruit.fit


class Looker:
    """Says of the crops in order what it was told to, and counts its batches."""

    def __init__(self, *looks: EndLook) -> None:
        self.looks, self.batches = looks, []  # type: ignore[var-annotated]

    def __call__(self, crops: Sequence[EndCrop]) -> list[EndLook]:
        self.batches.append(len(crops))
        return list(self.looks[: len(crops)])


def test_all_ends_of_a_capture_are_one_batch(capture: tuple[Capture, Instance, Instance]) -> None:
    picture, *instances = capture
    look = Looker(TRUE, STEM_LOOK, COVERED, TRUE)
    first, second = with_end_looks(picture, measured(picture, *instances), look)
    assert look.batches == [4]
    assert fit_of(first).looks == (TRUE, STEM_LOOK)
    assert fit_of(second).looks == (COVERED, TRUE)
    assert first.measurements[MethodName.M6] is first.selected


def test_the_interval_depends_on_the_look(capture: tuple[Capture, Instance, Instance]) -> None:
    picture, upright, _ = capture
    before = measured(picture, upright)
    assert before[0].length is not None
    value = before[0].length.value_m
    assert before[0].length.high_m == pytest.approx(value * np.exp(np.hypot(0.2, 1.6449 * REAL_SD)))
    for end, spread in ((TRUE, 0.02), (COVERED, 20 * 0.02)):
        (after,) = with_end_looks(picture, before, Looker(TRUE, end), scale_known=True)
        assert after.length is not None
        assert after.length.value_m == value
        expected = np.hypot(spread, 1.6449 * REAL_SD)
        assert after.length.high_m == pytest.approx(value * np.exp(expected), rel=1e-3)
        narrow = np.hypot(0.02, 1.6449 * REAL_SD)
        assert after.length.low_m == pytest.approx(value * np.exp(-narrow), rel=1e-3)


def test_a_doubtful_end_is_named_by_its_place(capture: tuple[Capture, Instance, Instance]) -> None:
    picture, upright, lying = capture
    fruit = measured(picture, upright, lying)
    places = []
    for one in fruit:
        ends = picture.intrinsics.project(fit_of(one).traits.axis_m[[0, -1]])
        places.append(ends[0] - ends[1])
    for looks, expected in (((COVERED, TRUE), 1), ((TRUE, COVERED), -1)):
        found = with_end_looks(picture, fruit, Looker(*looks, *looks))
        down, across = expected * places[0][1], expected * places[1][0]
        assert (Flag.LOWER_END in found[0].flags) is bool(down > 0)
        assert (Flag.UPPER_END in found[0].flags) is bool(down < 0)
        assert (Flag.RIGHT_END in found[1].flags) is bool(across > 0)
        assert (Flag.LEFT_END in found[1].flags) is bool(across < 0)
    remarks = flag_remarks("lower-end-doubtful ends-unsure")
    assert remarks == "the lower end may go on behind what covers it"


def test_what_is_a_lower_bound_already_is_not_doubted_again(
    capture: tuple[Capture, Instance, Instance],
) -> None:
    picture, upright, _ = capture
    fruit = [one.flagged(Flag.END_HIDDEN) for one in measured(picture, upright)]
    (found,) = with_end_looks(picture, fruit, Looker(COVERED, COVERED))
    assert found.flags == fruit[0].flags


def test_an_interval_that_was_too_wide_is_given_where_the_look_narrows_it(
    capture: tuple[Capture, Instance, Instance], monkeypatch: pytest.MonkeyPatch
) -> None:
    picture, upright, _ = capture
    wide = IntervalModels(0.9, {**MODELS.models, _M6: model(_M6, 0.99)}, 500)
    monkeypatch.setattr(intervals, "shipped_interval_models", lambda: wide)
    before = measured(picture, upright)
    assert Flag.INTERVAL_TOO_WIDE in before[0].flags
    (found,) = with_end_looks(picture, before, Looker(TRUE, TRUE))
    assert Flag.INTERVAL_TOO_WIDE not in found.flags
    assert found.length is not None
    assert found.length.high_m is not None


@pytest.mark.parametrize("source", [MaskSource.DATASET, MaskSource.HAND])
def test_masks_that_no_network_drew_are_not_looked_at(
    capture: tuple[Capture, Instance, Instance], source: MaskSource
) -> None:
    picture, upright, _ = capture
    fruit = measured(picture, replace(upright, mask_source=source))
    look = Looker(TRUE, TRUE)
    assert with_end_looks(picture, fruit, look) == fruit
    assert look.batches == []
