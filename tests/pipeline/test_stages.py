"""What has to be measured again when an option, a file or a network changes, and what not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cucumbervision.agronomy.profiles import load_profile
from cucumbervision.capture.conventions import DepthAlong, Stream
from cucumbervision.capture.source import ReadOptions
from cucumbervision.errors import CucumberVisionError
from cucumbervision.measurement.result import LengthDefinition, MethodName, Selector
from cucumbervision.perception.registry import load_registry
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision.pipeline.stages import Stage, StageHashes

BY_MASK = (Stage.DATASET, Stage.KEPT)
DRAWN = (Stage.DATASET, Stage.DRAWN)
DETECTED = (Stage.DETECTED, Stage.DRAWN)
USUAL = MeasureOptions()


def holds(stages: Sequence[Stage], before: MeasureOptions, now: MeasureOptions) -> bool:
    """Whether what was measured with some options is still right with others."""
    return StageHashes(now).still_hold(stages, StageHashes(before).of(stages))


@pytest.mark.parametrize("stages", [BY_MASK, DRAWN, DETECTED])
def test_nothing_changes_by_itself(stages: Sequence[Stage]) -> None:
    assert holds(stages, USUAL, MeasureOptions())


@pytest.mark.parametrize(
    "change",
    [
        {"methods": (MethodName.M1,)},
        {"selector": Selector.PAPER},
        {"length": LengthDefinition.THREAD},
        {"reading": ReadOptions(depth_unit_m=0.0001)},
        {"reading": ReadOptions(depth_along=DepthAlong.RAY)},
        {"reading": ReadOptions(aligned_to=Stream.DEPTH)},
        {"camera_up": "left"},
        {"classes": ("ripe",)},
    ],
)
def test_what_every_length_depends_on_measures_all_again(change: dict[str, Any]) -> None:
    changed = replace(USUAL, **change)
    assert [holds(stages, USUAL, changed) for stages in (BY_MASK, DRAWN, DETECTED)] == [False] * 3


def test_a_crop_s_sizes_measure_all_again() -> None:
    mini = USUAL.for_crop(load_profile("mini-cucumber"))
    assert [holds(stages, USUAL, mini) for stages in (BY_MASK, DETECTED)] == [False, False]


@pytest.mark.parametrize("change", [{"confidence": 0.6}, {"input_sizes": (640,)}])
def test_the_detector_s_options_leave_the_data_set_s_own_masks(change: dict[str, Any]) -> None:
    changed = replace(USUAL, **change)
    assert [holds(stages, USUAL, changed) for stages in (BY_MASK, DRAWN, DETECTED)] == [
        *(True, True),
        False,
    ]


@pytest.mark.parametrize("change", [{"runtime": "onnxruntime"}, {"full_precision": False}])
def test_how_networks_are_computed_leaves_what_none_saw(change: dict[str, Any]) -> None:
    changed = replace(USUAL, **change)
    assert [holds(stages, USUAL, changed) for stages in (BY_MASK, DRAWN, DETECTED)] == [
        True,
        *(False, False),
    ]


def test_frames_of_a_burst_and_where_a_picture_lies_change_no_hash() -> None:
    # Both are part of what was read: its content has a hash of its own.
    reading = ReadOptions(burst=9, depth=Path("depth.png"))
    assert holds(BY_MASK, USUAL, replace(USUAL, reading=reading))


def test_a_result_of_another_source_is_none() -> None:
    only_models = replace(USUAL, instances="models")
    assert not StageHashes(only_models).still_hold(BY_MASK, StageHashes(only_models).of(BY_MASK))
    assert StageHashes(USUAL).sources == {Stage.DATASET, Stage.DETECTED}
    assert StageHashes(only_models).sources == {Stage.DETECTED}
    by_file = {
        "dataset": Stage.DATASET,
        "labels.json": Stage.LISTED,
        "own.ONNX": Stage.DETECTED,
    }
    for choice, stage in by_file.items():
        assert StageHashes(replace(USUAL, instances=choice)).sources == {stage}
    assert not StageHashes(USUAL).still_hold((), StageHashes(USUAL).of(()))


def test_a_file_counts_by_its_content(tmp_path: Path) -> None:
    labels = tmp_path / "labels.json"
    labels.write_text("[]")
    options = replace(USUAL, instances=str(labels))
    listed = (Stage.LISTED, Stage.KEPT)
    before = StageHashes(options).of(listed)
    # The same content written again is the same, and another place of it, too.
    labels.write_text("[]")
    (tmp_path / "other.json").write_text("[]")
    assert StageHashes(options).of(listed) == before
    moved = replace(USUAL, instances=str(tmp_path / "other.json"))
    assert StageHashes(moved).of(listed) == before
    labels.write_text("[1]")
    assert not StageHashes(options).still_hold(listed, before)


def test_a_folder_counts_by_its_files_and_their_names(tmp_path: Path) -> None:
    folder = tmp_path / "labels"
    (folder / "a").mkdir(parents=True)
    (folder / "a/1.txt").write_text("0 1 1 1 1")
    options, listed = replace(USUAL, instances=str(folder)), (Stage.LISTED,)
    before = StageHashes(options).of(listed)
    assert StageHashes(options).of(listed) == before
    (folder / "a/1.txt").rename(folder / "a/2.txt")
    assert StageHashes(options).of(listed) != before


def test_a_calibration_counts_everywhere_by_its_content(tmp_path: Path) -> None:
    site = tmp_path / "site.json"
    site.write_text("{}")
    calibrated = replace(USUAL, calibration=site)
    before = {stages: StageHashes(calibrated).of(stages) for stages in (BY_MASK, DETECTED)}
    assert not holds(BY_MASK, USUAL, calibrated)
    site.write_text('{"scale": 1}')
    assert all(StageHashes(calibrated).of(stages) != before[stages] for stages in before)


@pytest.mark.parametrize("task", ["segment", "fruit", "pose"])
def test_another_network_finds_the_fruit_again(task: str) -> None:
    registry = load_registry()
    name = next(model.name for model in registry.models if model.task == task)
    without = replace(registry, shipped=tuple(m for m in registry.shipped if m.name != name))
    before = StageHashes(USUAL, registry).of([Stage.DETECTED])
    assert StageHashes(USUAL, without).of([Stage.DETECTED]) != before


def test_a_file_that_is_gone_is_named(tmp_path: Path) -> None:
    gone = replace(USUAL, calibration=tmp_path / "gone.json")
    with pytest.raises(CucumberVisionError, match=r"gone\.json: no such file; check the run's"):
        StageHashes(gone).of(BY_MASK)


def test_order_and_kind_of_stages_count() -> None:
    hashes = StageHashes(USUAL)
    chains = [
        (),
        (Stage.DETECTED,),
        (Stage.DETECTED, Stage.DRAWN),
        (Stage.DETECTED, Stage.KEPT),
        (Stage.DATASET, Stage.DRAWN),
        (Stage.DATASET,),
        (Stage.KEPT,),
    ]
    assert len({hashes.of(chain) for chain in chains}) == len(chains)
    # Names from a journal are the same as stages.
    assert hashes.of(["detected", "drawn"]) == hashes.of((Stage.DETECTED, Stage.DRAWN))
