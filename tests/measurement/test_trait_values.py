"""Traits of other packages that fail, or do what they should not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import PluginError
from cucumbervision.instances.instance import Instance
from cucumbervision.measurement.flags import Flag
from cucumbervision.measurement.result import MethodName
from cucumbervision.measurement.trait_values import TableTrait
from cucumbervision.pipeline.measurer import CaptureResult, Measurer
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision.pipeline.plugged import PlugIns

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


@pytest.mark.parametrize(
    "answer", [10**400, 1 + 2j, np.complex128(1), np.timedelta64(3), float("inf"), SystemExit(0)]
)
def test_what_is_no_finite_number_is_a_failure_of_its_own(answer: Any, capture: Capture) -> None:
    result = measured(capture, TableTrait("firmness", "", "says", giving(answer)))
    assert len(result.fruit) == 2
    for fruit in result.fruit:
        assert fruit.length is not None
        assert Flag.PLUGIN_FAILED in fruit.flags
        assert fruit.trait_values["firmness"].value is None
    assert "firmness" in result.failures[0].message


def test_a_trait_that_writes_into_the_picture_changes_nothing(capture: Capture) -> None:
    def fill(capture: Capture, _fruit: object) -> float:
        capture.depth_m[capture.depth_m == 0] = np.nan
        return 1.0

    before = capture.depth_m.copy()
    plain = measured(capture)
    result = measured(capture, TableTrait("x", "", "says", of_another_package(fill)))
    assert np.array_equal(capture.depth_m, before)
    assert "read-only" in result.failures[0].message
    assert [row["length_cm"] for row in result.rows()] == [row["length_cm"] for row in plain.rows()]


@pytest.mark.parametrize("name", ["length_cm", "capture", "m1_cm", "skin_yellow_share"])
def test_a_column_that_is_taken_is_said(name: str, capture: Capture) -> None:
    trait = TableTrait(name, "", "says", giving(7.0))
    measurer = Measurer(OPTIONS, plug_ins=PlugIns(traits=(trait,)))
    (fault,) = measurer.plugged.faults
    assert "has a name that is taken" in str(fault)
    assert 7.0 not in measurer.measure(capture).rows()[0].values()


def test_two_traits_of_one_name_are_not_mixed(capture: Capture) -> None:
    traits = tuple(TableTrait("x", "", "says", giving(value)) for value in (7.0, 8.0))
    measurer = Measurer(OPTIONS, plug_ins=PlugIns(traits=traits))
    assert len(measurer.plugged.faults) == 1
    assert measurer.measure(capture).rows()[0]["x"] == 7.0


def test_capitals_in_a_column_are_refused() -> None:
    trait = TableTrait("Length_CM", "", "says", giving(7.0))
    (fault,) = Measurer(OPTIONS, plug_ins=PlugIns(traits=(trait,))).plugged.faults
    assert "lower case" in str(fault)


def test_a_trait_whose_name_fails_is_left_out() -> None:
    class Nameless:
        unit = says = ""

        @property
        def name(self) -> str:
            raise ValueError("no name")

        def __call__(self, *_: object) -> float:
            return 1.0

    Nameless.__module__ = "another_package"
    (fault,) = Measurer(OPTIONS, plug_ins=PlugIns(traits=(Nameless(),))).plugged.faults
    assert "no name" in str(fault)


def test_a_detector_that_ends_the_program_or_writes_into_it_is_named(capture: Capture) -> None:
    def write(capture: Capture) -> list[Instance]:
        capture.color[:] = 0
        return []

    for detector, words in ((giving(SystemExit(3)), "SystemExit"), (write, "read-only")):
        plug_ins = PlugIns(detector=of_another_package(detector))
        with pytest.raises(PluginError, match=words):
            Measurer(MeasureOptions(segmenter="none"), plug_ins=plug_ins).measure(capture)
