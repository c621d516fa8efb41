from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.methods.result import Choice, Measurement, MethodName, Reason, Selector
from cucumbervision.methods.selector import choose, measure_fruit

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
