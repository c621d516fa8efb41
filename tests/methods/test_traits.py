"""Traits of other packages that fail, or do what they should not."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.fruit.instance import Instance
from cucumbervision.methods.flags import Flag
from cucumbervision.methods.result import MethodName
from cucumbervision.methods.traits import TableTrait, tube_traits
from cucumbervision.run.measurer import CaptureResult, Measurer
from cucumbervision.run.options import MeasureOptions, PlugIns
from cucumbervision_lab.scenes.bodies import arc_tube, bent_tube, rotation


def test_traits_of_a_drawn_fruit_are_its_truth() -> None:
    tube = arc_tube(0.24, 0.02, 0.25, neck=0.3).moved(rotation(30, 40, 70), (0.05, 0.0, 0.6))
    traits = tube_traits(tube.centres_m, tube.radii_m)
    assert traits.lengths.centreline_m == pytest.approx(tube.centreline_m, rel=1e-6)
    assert traits.lengths.chord_m == pytest.approx(tube.chord_m, rel=1e-6)
    assert traits.lengths.thread_m == pytest.approx(tube.thread_m, rel=2e-3)
    assert traits.diameter_max_m == pytest.approx(0.04, rel=1e-3)
    np.testing.assert_allclose(traits.axis_m[[0, -1]], tube.poles_m, atol=1e-9)


def test_means_and_volume_of_a_capsule_by_hand() -> None:
    tube = arc_tube(0.20, 0.02)
    traits = tube_traits(tube.centres_m, tube.radii_m)
    volume = np.pi * 0.02**2 * 0.16 + 4 / 3 * np.pi * 0.02**3
    # Half an ellipse's mean height is pi/4 of its peak: both ends together 4 cm of such.
    mean = (0.04 * 0.16 + np.pi / 4 * 0.04 * 0.04) / 0.20
    assert traits.volume_m3 == pytest.approx(volume, rel=2e-3)
    assert traits.diameter_mean_m == pytest.approx(mean, rel=3e-3)


def test_tilt_is_the_chords_angle_to_the_picture() -> None:
    for tilt in (0.0, 25.0, -60.0):
        tube = arc_tube(0.20, 0.02).moved(rotation(10, tilt), (0, 0, 0.6))
        traits = tube_traits(tube.centres_m, tube.radii_m)
        assert traits.tilt_deg == pytest.approx(abs(tilt), abs=1e-6)


@pytest.mark.parametrize(
    ("tilt_deg", "end_m", "hides"),
    [(30, 0.005, False), (50, 0.005, True), (-50, 0.005, True), (50, 0.02, False)],
)
def test_a_spindle_that_points_away_may_hide_an_end(
    tilt_deg: float, end_m: float, hides: bool
) -> None:
    # Straight, 1 cm thick at the ends and 4 cm in the middle: its sides slope by 8.5 degrees, and
    # perspective adds some 5, to 30 + 14 or 50 + 14 degrees. An even bar hides nothing.
    radii = np.interp(np.linspace(-1, 1, 401), [-1, 0, 1], [end_m, 0.02, end_m])
    tube = bent_tube(0.20, radii, 0 * radii).moved(rotation(0, tilt_deg), (0, 0, 0.6))
    assert tube_traits(tube.centres_m, tube.radii_m).may_hide_an_end is hides


def test_inner_arc_for_each_10_cm_of_chord() -> None:
    tube = arc_tube(0.30, 0.015, 0.15)
    traits = tube_traits(tube.centres_m, tube.radii_m)
    angle = (0.30 - 0.03) / 0.15 / 2
    rise = 0.135 - (0.15 * np.cos(angle) - 0.015 * np.sin(angle))
    assert traits.inner_arc_m == pytest.approx(rise, abs=1e-4)
    assert traits.inner_arc_mm_per_10cm == pytest.approx(100 * rise / tube.chord_m, rel=2e-3)


def test_radii_below_nothing_are_no_body() -> None:
    x = np.linspace(0, 0.1, 50)
    radii = np.linspace(0.02, -0.01, 50)
    traits = tube_traits(np.stack([x, 0 * x, 0 * x + 0.5], axis=1), radii)
    assert np.isfinite([traits.lengths.thread_m, traits.volume_m3]).all()
    assert (traits.diameter_m >= 0).all()


OPTIONS = MeasureOptions(instances="dataset", segmenter="none", methods=(MethodName.M1,))


@pytest.fixture
def capture() -> Capture:
    return next(iter(open_source(example_captures() / "simulated-row-b"))).load()


def of_another_package(function: Callable[..., Any]) -> Callable[..., Any]:
    function.__module__ = "another_package"
    return function


def giving(answer: Any) -> Callable[..., Any]:
    def give(*_: object) -> Any:
        if isinstance(answer, BaseException):
            raise answer
        return answer

    return of_another_package(give)


def measured(capture: Capture, *traits: TableTrait) -> CaptureResult:
    return Measurer(OPTIONS, plug_ins=PlugIns(traits=traits)).measure(capture)


@pytest.mark.parametrize("answer", ["soft", 1 + 2j, float("inf"), SystemExit(0)])
def test_what_is_no_finite_number_is_a_failure_of_its_own(answer: Any, capture: Capture) -> None:
    result = measured(capture, TableTrait("firmness", "", "says", giving(answer)))
    assert len(result.fruit) == 2
    for fruit in result.fruit:
        assert fruit.length is not None
        assert Flag.PLUGIN_FAILED in fruit.flags
        assert fruit.trait_values["firmness"].value is None
    assert "firmness" in result.failures[0].message


@pytest.mark.parametrize("name", ["length_cm", "capture", "m1_cm", "skin_yellow_share"])
def test_a_column_that_is_taken_is_said(name: str, capture: Capture) -> None:
    trait = TableTrait(name, "", "says", giving(7.0))
    measurer = Measurer(OPTIONS, plug_ins=PlugIns(traits=(trait,)))
    (fault,) = measurer.plugged.faults
    assert "has a name that is taken" in str(fault)
    assert 7.0 not in measurer.measure(capture).rows()[0].values()


def test_capitals_in_a_column_are_refused() -> None:
    trait = TableTrait("Length_CM", "", "says", giving(7.0))
    (fault,) = Measurer(OPTIONS, plug_ins=PlugIns(traits=(trait,))).plugged.faults
    assert "lower case" in str(fault)


def detected(capture: Capture, detector: Callable[..., Any], segmenter: Any = None) -> Any:
    plug_ins = PlugIns(detector=of_another_package(detector), segmenter=segmenter)
    return Measurer(OPTIONS, plug_ins=plug_ins).measure(capture)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"keypoints": np.ones((4, 3))}, "keypoints"),
        ({"keypoints": np.full((5, 3), 1e300)}, "keypoints"),
        ({"mask": np.zeros((480, 848), bool)}, "no pixel"),
        ({"confidence": np.nan}, "confidence"),
    ],
)
def test_a_fruit_that_is_none_is_left_out_and_the_others_stay(
    changes: dict[str, Any], words: str, capture: Capture
) -> None:
    whole = [Instance.of_mask(mask) for mask in capture.masks]
    result = detected(capture, giving([replace(whole[0], **changes), whole[1]]))
    assert len(result.fruit) == 1
    assert words in result.failures[0].message


def test_a_detector_may_draw_every_mask_into_one_array(capture: Capture) -> None:
    buffer = np.zeros_like(capture.masks[0])

    def detect(capture: Capture) -> Iterator[Instance]:
        for mask in capture.masks:
            buffer[:] = mask
            yield replace(Instance.of_mask(mask), mask=buffer)

    lengths = [fruit.length for fruit in detected(capture, detect).fruit]
    assert lengths == [fruit.length for fruit in measured(capture).fruit]


class Drawing:
    """A segmenter that answers with the same for every fruit."""

    def __init__(self, **changes: Any) -> None:
        self.changes = changes

    def segment(self, _color: Any, instances: Sequence[Instance]) -> list[Instance]:
        return [replace(instance, **self.changes) for instance in instances]


Drawing.__module__ = "another_package"


@pytest.mark.parametrize(
    "changes",
    [{"mask": None, "mask_failure": "too dark"}, {"mask": np.zeros((480, 848), bool)}],
    ids=["words of its own", "empty"],
)
def test_a_segmenter_without_a_mask_is_a_flag(changes: dict[str, Any], capture: Capture) -> None:
    boxes = [replace(Instance.of_mask(mask), mask=None) for mask in capture.masks]
    result = detected(capture, giving(boxes), Drawing(**changes))
    assert [fruit.mask for fruit in result.fruit] == [None, None]
    assert all(Flag.SAM_MASK_EMPTY in fruit.flags for fruit in result.fruit)
