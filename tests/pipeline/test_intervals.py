from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.measurement.intervals import (
    RAW_FEATURES,
    TUBE_FEATURES,
    Band,
    IntervalBook,
    IntervalModel,
    shipped_book,
)
from cucumbervision.measurement.result import Fruit, Length, Method
from cucumbervision.measurement.selector import measure_fruit
from cucumbervision.perception.instances import Instance, MaskSource
from cucumbervision.perception.masks import box_of_mask
from cucumbervision.pipeline.intervals import with_simulated_interval
from cucumbervision.pipeline.rows import Cell, fruit_row
from cucumbervision_lab.synthesis.bodies import arc_tube, rotation
from cucumbervision_lab.synthesis.scene import Scene, render

ONE_PERCENT = np.log(0.01)


def even(key: str, percent: float) -> IntervalModel:
    return IntervalModel(key, 0.9, (), (np.log(percent / 100),), {"": Band(0.0, 1.0, 1.0, 100)})


BOOK = IntervalBook(
    0.9, {key: even(key, p) for key, p in (("M1", 20), ("M6", 1), ("M6 thread", 2))}, 100
)


@pytest.fixture
def measured(camera: Intrinsics) -> tuple[Capture, Fruit]:
    tube = arc_tube(0.2, 0.018, 0.4).moved(rotation(10), (0, 0, 0.5))
    scene = render(Scene.of(tube, backdrop_m=0.9), camera)
    mask = scene.mask(0)
    color = np.zeros((720, 1280, 3), np.uint8)
    capture = Capture(color, scene.depth_m.astype(np.float32), camera, "drawn")
    instance = Instance(box_of_mask(mask), mask=mask, mask_source=MaskSource.DATASET)
    return capture, measure_fruit(capture, instance)


def row_of(measured: tuple[Capture, Fruit], length: Length, known: bool = True) -> dict[str, Cell]:
    capture, fruit = measured
    row = fruit_row(capture, 1, fruit, length)
    return with_simulated_interval(row, fruit, length, scale_known=known, book=BOOK)


@pytest.mark.parametrize(("length", "percent"), [(Length.CENTRELINE, 1.0), (Length.THREAD, 2.0)])
def test_a_tubes_interval_is_about_the_length_that_was_asked(
    measured: tuple[Capture, Fruit], length: Length, percent: float
) -> None:
    row = row_of(measured, length)
    assert row["interval_of"] == str(length) == row["length_kind"]
    assert row["interval_basis"] == "simulated"
    by_hand = float(str(row["length_cm"])) * np.exp(percent / 100)
    assert row["interval_high_cm"] == pytest.approx(by_hand, abs=2e-3)


def test_an_unknown_scale_is_in_it(measured: tuple[Capture, Fruit]) -> None:
    row = row_of(measured, Length.CENTRELINE, known=False)
    half = np.hypot(0.01, 1.6449 * 0.01)
    assert row["interval_low_cm"] == pytest.approx(
        float(str(row["length_cm"])) * np.exp(-half), abs=2e-3
    )


def test_a_length_without_a_model_has_no_interval(measured: tuple[Capture, Fruit]) -> None:
    assert row_of(measured, Length.CHORD)["interval_low_cm"] is None


def test_a_raw_lengths_interval_is_about_the_centreline(
    measured: tuple[Capture, Fruit],
) -> None:
    capture, fruit = measured
    boxed = measure_fruit(capture, replace(fruit.instance, mask=None, mask_source=None))
    assert boxed.selected is not None
    assert boxed.selected.method is Method.M1
    row = row_of((capture, boxed), Length.THREAD)
    assert row["interval_of"] == "centreline"
    assert float(str(row["interval_high_cm"])) > float(str(row["length_cm"]))


def test_what_was_not_measured_has_none(measured: tuple[Capture, Fruit]) -> None:
    capture, _ = measured
    nothing = measure_fruit(
        replace(capture, depth_m=np.zeros_like(capture.depth_m)),
        Instance(np.array([9.5, 9.5, 99.5, 29.5])),
    )
    assert row_of((capture, nothing), Length.THREAD)["interval_basis"] is None


def test_an_interval_that_says_nothing_is_left_out_and_flagged(
    measured: tuple[Capture, Fruit],
) -> None:
    capture, fruit = measured
    row = fruit_row(capture, 1, fruit, Length.CENTRELINE)
    guess = IntervalBook(0.9, {"M6": even("M6", 75)}, 100)  # exp(2 x 0.75) is a factor of 4.5
    done = with_simulated_interval(row, fruit, Length.CENTRELINE, scale_known=True, book=guess)
    assert done["interval_low_cm"] is None
    assert done["length_cm"] == row["length_cm"]
    assert "interval-too-wide" in str(done["flags"]).split()
    sure = IntervalBook(0.9, {"M6": even("M6", 60)}, 100)
    done = with_simulated_interval(row, fruit, Length.CENTRELINE, scale_known=True, book=sure)
    assert done["interval_low_cm"] is not None


def test_the_shipped_book_knows_every_method() -> None:
    book = shipped_book()
    assert book.level == 0.9
    assert set(book.models) == {*(str(m) for m in Method), "M6 thread", "M6 chord"}
    for key, model in book.models.items():
        names = TUBE_FEATURES if key.startswith("M6") else RAW_FEATURES
        assert model.features == names
        assert model.bands[""].count >= 500
    # A good fruit at half a metre, both ends seen: a centimetre or so on 25 cm.
    values = dict.fromkeys(TUBE_FEATURES, 0.0) | {
        "log_sd": np.log(0.003), "log_outline": np.log(0.4), "distance_m": 0.5,
        "log_pixels": np.log(0.5), "hidden": 0.0,
    }  # fmt: skip
    low, high = book.models["M6"].interval(0.25, values)
    assert 0.22 < low < 0.25 < high < 0.28
