from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision.methods import intervals
from cucumbervision.methods.flags import Flag
from cucumbervision.methods.intervals import (
    LARGEST_SPREAD,
    LEAST_SPREAD,
    REAL_SD,
    Band,
    IntervalModel,
    IntervalModels,
    Trees,
    feature_groups,
    mask_features,
    shipped_interval_models,
)
from cucumbervision.methods.result import (
    Fruit,
    IntervalBasis,
    Length,
    LengthDefinition,
    LengthKind,
    MethodName,
)
from cucumbervision.methods.selector import measure_fruit
from cucumbervision_lab.evaluate.benchmark import RAW_FEATURES, TUBE_FEATURES
from cucumbervision_lab.scenes.bodies import arc_tube, rotation
from cucumbervision_lab.scenes.scene import Scene, render
from cucumbervision_lab.train.end_look import LOOK_FEATURES


def even(key: str, percent: float) -> IntervalModel:
    spread = Trees(np.log(percent / 100))
    return IntervalModel(key, 0.9, (), spread, spread, {"": Band(1.0, 1.0, 100)})


def half(percent: float, more_sd: float = REAL_SD) -> float:
    """What one side of such an interval is, relative, on a real fruit."""
    return float(np.hypot(percent / 100, 1.644854 * more_sd))


MODELS = IntervalModels(
    0.9, {key: even(key, p) for key, p in (("M1", 20), ("M6", 1), ("M6 thread", 2))}, 100
)


@pytest.fixture(scope="module")
def seen() -> tuple[Capture, Instance]:
    """A drawn fruit, 20 cm along its axis, half a metre away."""
    camera = Intrinsics(1280, 720, 910.0, 910.0, 640.0, 360.0)
    tube = arc_tube(0.2, 0.018, 0.4).moved(rotation(10), (0, 0, 0.5))
    scene = render(Scene.of(tube, backdrop_m=0.9), camera)
    mask = scene.mask(0)
    color = np.zeros((720, 1280, 3), np.uint8)
    capture = Capture(color, scene.depth_m.astype(np.float32), camera, "drawn")
    return capture, Instance(box_of_mask(mask), mask=mask, mask_source=MaskSource.DATASET)


def length_of(
    seen: tuple[Capture, Instance],
    definition: LengthDefinition = LengthDefinition.THREAD,
    *,
    known: bool = True,
    models: IntervalModels = MODELS,
) -> Length:
    fruit = measured(seen, models, definition=definition, scale_known=known)
    assert fruit.length is not None
    return fruit.length


def measured(
    seen: tuple[Capture, Instance], models: IntervalModels = MODELS, **options: Any
) -> Fruit:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(intervals, "shipped_interval_models", lambda: models)
        return measure_fruit(*seen, **options)


def test_what_is_expected_to_be_missing_moves_the_interval() -> None:
    below, above = Trees(np.log(0.1)), Trees(np.log(0.05))
    bands = {"": Band(1.0, 4.0, 500)}
    model = IntervalModel("M6", 0.9, (), below, above, bands, missing="log_missing")
    # log(true / measured) is expected at 0.3, and lies from 4 x 0.05 below to 0.1 above.
    lower, upper = model.interval(0.2, {"log_missing": 0.3})
    assert (lower, upper) == pytest.approx((0.2 * np.exp(0.1), 0.2 * np.exp(0.4)))
    assert model.interval(0.2, {}) == pytest.approx((0.2 * np.exp(-0.2), 0.2 * np.exp(0.1)))


@pytest.mark.parametrize(
    ("definition", "percent"), [(LengthDefinition.CENTRELINE, 1.0), (LengthDefinition.THREAD, 2.0)]
)
def test_a_tubes_interval_is_about_the_length_that_was_asked(
    seen: tuple[Capture, Instance], definition: LengthDefinition, percent: float
) -> None:
    length = length_of(seen, definition)
    assert length.interval_of is length.kind is definition
    assert length.basis is IntervalBasis.SIMULATED
    assert length.high_m == pytest.approx(length.value_m * np.exp(half(percent)))
    assert length.low_m == pytest.approx(length.value_m * np.exp(-half(percent)))


def test_an_unknown_scale_is_in_it(seen: tuple[Capture, Instance]) -> None:
    length = length_of(seen, LengthDefinition.CENTRELINE, known=False)
    more_sd = float(np.hypot(REAL_SD, 0.01))
    assert length.low_m == pytest.approx(length.value_m * np.exp(-half(1.0, more_sd)), rel=1e-5)


def test_a_length_without_a_model_has_no_interval(seen: tuple[Capture, Instance]) -> None:
    length = length_of(seen, LengthDefinition.CHORD)
    assert (length.low_m, length.interval_of, length.basis) == (None, None, None)


def test_a_raw_lengths_interval_is_about_the_centreline(seen: tuple[Capture, Instance]) -> None:
    capture, instance = seen
    boxed = replace(instance, mask=None, mask_source=None)
    length = length_of((capture, boxed))
    assert (length.kind, length.interval_of) == (LengthKind.BOX_CHORD, LengthDefinition.CENTRELINE)
    assert length.high_m == pytest.approx(length.value_m * np.exp(half(20.0)))


def test_an_interval_holds_what_was_measured(seen: tuple[Capture, Instance]) -> None:
    """Half of a metre away, and said to lack as much as that number: 3 % about exp(0.5)."""
    spread = Trees(np.log(0.03))
    bands = {"": Band(1.0, 1.0, 500)}
    model = IntervalModel("M6", 0.9, (), spread, spread, bands, missing="distance_m")
    length = length_of(
        seen, LengthDefinition.CENTRELINE, models=IntervalModels(0.9, {"M6": model}, 100)
    )
    assert length.low_m == length.value_m
    assert length.high_m is not None
    half_width = float(np.hypot(0.03, 1.6449 * REAL_SD))
    # The axis lies a radius, 18 mm, behind the surface that is half a metre away.
    longer = np.log(length.high_m / length.value_m) - half_width
    assert longer == pytest.approx(0.5, abs=0.03)


def test_spreads_have_limits() -> None:
    """Trees that predict nearly no error, or a huge one, are not believed beyond the limits."""
    narrow, wide = Trees(np.log(1e-9)), Trees(np.log(1e9))
    model = IntervalModel("M6", 0.9, ("tilt",), narrow, wide, {"": Band(1.0, 1.0, 100)})
    assert model.spreads({"tilt": 0.3}) == (LEAST_SPREAD, LARGEST_SPREAD)


def test_an_interval_that_says_nothing_is_left_out_and_flagged(
    seen: tuple[Capture, Instance],
) -> None:
    definition = LengthDefinition.CENTRELINE
    # exp(2 x 0.75) is a factor of 4.5, exp(2 x 0.60) one of 3.3.
    for percent, flagged in ((75, True), (60, False)):
        models = IntervalModels(0.9, {"M6": even("M6", percent)}, 100)
        fruit = measured(seen, models, definition=definition, scale_known=True)
        assert fruit.length is not None
        assert (fruit.length.low_m is None) is flagged
        assert (Flag.INTERVAL_TOO_WIDE in fruit.flags) is flagged


def test_a_group_too_small_to_have_a_band_takes_that_of_the_next_larger_one() -> None:
    edges = (("perceived", (0.5,)), ("tilt", (0.3, 0.6)))
    bands = {"": Band(1.0, 1.0, 900), "1": Band(2.0, 2.0, 90), "1-2": Band(4.0, 4.0, 60)}
    model = IntervalModel("M6", 0.9, (), Trees(-4.6), Trees(-4.6), bands, edges)
    assert feature_groups(edges, {"perceived": 1.0, "tilt": 0.5}) == ["1-1", "1", ""]
    quantiles = [
        model.band({"perceived": perceived, "tilt": tilt}).low_quantile
        for perceived, tilt in ((0.0, 0.9), (1.0, 0.5), (1.0, 0.9))
    ]
    assert quantiles == [1.0, 2.0, 4.0]


def test_a_networks_mask_tells_more_of_itself_than_a_given_one() -> None:
    def telling(source: MaskSource | None, *flags: Flag) -> set[str]:
        return {name for name, value in mask_features(source, flags, 0.0).items() if value}

    assert telling(MaskSource.SAM, Flag.END_HIDDEN) == {"perceived", "goes_on"}
    assert telling(MaskSource.SAM, Flag.ENDS_DISAGREE) == {"perceived", "ends_disagree"}
    cut = telling(MaskSource.DETECTOR, Flag.ENDS_DISAGREE, Flag.CUT_BY_FRAME)
    assert cut == {"perceived", "own_mask", "cut", "goes_on"}
    assert telling(None) == {"perceived"}
    assert telling(MaskSource.DATASET, Flag.END_HIDDEN, Flag.ENDS_DISAGREE) == set()
    assert telling(MaskSource.DATASET, Flag.DEPTH_UNALIGNED) == {"no_depth"}


def test_a_sure_detection_has_a_higher_certainty_up_to_99_percent() -> None:
    certainties = [mask_features(MaskSource.SAM, (), c)["certainty"] for c in (0.0, 0.9, 0.99, 1.0)]
    assert certainties == pytest.approx([0.0, np.log(10), np.log(100), np.log(100)])
    assert mask_features(MaskSource.DATASET, (), 1.0)["certainty"] == 0.0


def test_a_fruit_that_the_pictures_edge_cuts_has_no_interval(
    seen: tuple[Capture, Instance],
) -> None:
    capture, instance = seen
    assert instance.mask is not None
    mask = instance.mask.copy()
    mask[:, : int(instance.box[[0, 2]].mean())] = False
    mask[int(instance.box[[1, 3]].mean()), int(instance.box[2]) :] = True  # on to the edge
    fruit = measured((capture, replace(instance, mask=mask)))
    assert Flag.CUT_BY_FRAME in fruit.flags
    assert fruit.length is not None
    assert fruit.length.value_m > 0
    assert (fruit.length.low_m, fruit.length.high_m) == (None, None)
    assert Flag.INTERVAL_TOO_WIDE not in fruit.flags


def test_what_networks_draw_has_models_of_its_own(seen: tuple[Capture, Instance]) -> None:
    capture, instance = seen
    models = IntervalModels(0.9, {k: even(k, p) for k, p in (("M6", 1), ("M6 perceived", 3))}, 100)
    for source, percent in ((MaskSource.DATASET, 1.0), (MaskSource.SAM, 3.0)):
        fruit = (capture, replace(instance, mask_source=source))
        length = length_of(fruit, LengthDefinition.CENTRELINE, models=models)
        assert length.high_m == pytest.approx(length.value_m * np.exp(half(percent)))


def test_the_shipped_models_know_every_method() -> None:
    shipped = shipped_interval_models()
    assert shipped.level == 0.9
    keys = [*map(str, MethodName), "M6 thread", "M6 chord"]
    keys_known = {key + behind for key in keys for behind in ("", " perceived")}
    looked = {f"{key} perceived looked" for key in keys if key.startswith("M6")}
    assert set(shipped.models) == keys_known | looked
    for key, model in shipped.models.items():
        names: tuple[str, ...] = TUBE_FEATURES if key.startswith("M6") else RAW_FEATURES
        names = LOOK_FEATURES if key in looked else names
        assert model.features == names
        assert model.bands[""].count >= 250
    # A good fruit at half a metre, both ends seen: a centimetre or so on 25 cm.
    values = dict.fromkeys(TUBE_FEATURES, 0.0) | {
        "log_sd": np.log(0.003), "log_outline": np.log(0.4), "distance_m": 0.5,
        "log_pixels": np.log(0.5), "hidden": 0.0,
    }  # fmt: skip
    lower, upper = shipped.models["M6"].interval(0.25, values)
    assert 0.22 < lower < 0.25 < upper < 0.28
