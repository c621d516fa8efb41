"""`measure` on arrays, masks and detectors of one's own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import CaptureError, InstancesError
from cucumbervision.measurement.result import FruitMeasurement, LengthDefinition
from cucumbervision.perception.instances import Instance, MaskSource
from cucumbervision.pipeline.results import measure


@pytest.fixture(scope="module")
def bench() -> Capture:
    return next(iter(open_source(example_captures() / "simulated-bench"))).load()


@pytest.fixture(scope="module")
def lengths_m(bench: Capture) -> list[float]:
    return values(measure(bench, instances="dataset").fruit)


def values(fruit: Sequence[FruitMeasurement]) -> list[float]:
    return [one.length.value_m for one in fruit if one.length is not None]


def test_arrays_measure_as_the_capture_does(bench: Capture, lengths_m: list[float]) -> None:
    matrix = bench.intrinsics.matrix
    in_mm = np.rint(bench.depth_m * 1000).astype(np.uint16)
    in_float = np.where(bench.depth_m > 0, bench.depth_m, np.nan).astype(np.float64)
    as_numbers = [255 * mask.astype(np.uint8) for mask in bench.masks]
    for depth in (in_mm, in_float):
        found = measure(bench.color, depth, matrix, masks=as_numbers)
        assert values(found.fruit) == pytest.approx(lengths_m, abs=1e-4)
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
    assert names == ["simulated-bench", "again"]
    assert values(found.fruit) == pytest.approx([lengths_m[1]] * 2, abs=1e-6)
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
