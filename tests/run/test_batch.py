"""Rows are the same wherever captures are measured, and a process that dies costs none."""

from __future__ import annotations

import json
import logging
import os
import shutil
import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.capsules import capsule_capture, lying

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.readers.native import write_native
from cucumbervision.capture.source import CaptureRef, CaptureSource, ReadOptions, example_captures
from cucumbervision.errors import (
    CaptureError,
    CucumberVisionError,
    DepthError,
    InstancesError,
    IntrinsicsError,
)
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.methods.flags import Flag
from cucumbervision.methods.result import Fruit, LengthDefinition, MethodName
from cucumbervision.run import batch
from cucumbervision.run.batch import (
    Engine,
    Item,
    Labels,
    Processes,
    ResultWorker,
    Worker,
    count_captures,
    in_process,
    in_turn,
    list_captures,
    measure,
    measure_all,
    read_captures,
)
from cucumbervision.run.measurer import CaptureResult, Failure, Measurer
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import BatchOptions, measure_inputs

OPTIONS = MeasureOptions(instances="dataset", methods=(MethodName.M1, MethodName.M3))


def test_two_processes_give_the_rows_of_one_and_recordings_are_read_in_the_parent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = os.getpid()

    def opener(path: Path, options: ReadOptions, _: object) -> CaptureSource:
        """The bundled captures, the second as a recording's: known by loading it alone."""
        first, second, third = open_source(path, options)

        def load() -> Capture:
            assert os.getpid() == here
            return second.load()

        played = replace(second, parts=None, load=load)
        refs = [first, played, third, CaptureRef("end", -1, _raise, "end")]
        return CaptureSource(path, "test", lambda: iter(refs), len(refs))

    monkeypatch.setattr(batch, "open_source", opener)
    tables: list[list[bytes]] = []
    for engine in (in_process, Processes(2)):
        out = tmp_path / f"out{len(tables)}"
        options = BatchOptions(engine=engine)
        result = measure_inputs([example_captures()], out, OPTIONS, batch=options)
        assert (result.captures, result.exit_code) == (3, 1)
        tables.append([(out / f"{n}.csv").read_bytes() for n in ("measurements", "failures")])
    assert tables[0] == tables[1]


def _raise() -> Capture:
    raise CaptureError("stopped in the middle", source="recording")


def killing(path: Path, once: Path) -> Capture:
    """Kill the process that reads it, the first time or always."""
    if not once.exists():
        if once.parent.exists():
            once.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return next(iter(open_source(path))).load()


@pytest.mark.parametrize("always", [False, True])
def test_a_worker_that_is_killed_costs_at_most_its_own_capture(
    tmp_path: Path, always: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    house = Path(shutil.copytree(example_captures(), tmp_path / "house"))
    once = tmp_path / ("nowhere" if always else "house") / "once"

    def opener(path: Path, options: ReadOptions, _: object) -> CaptureSource:
        def refs() -> Iterator[CaptureRef]:
            first, *others = open_source(path, options)
            yield replace(first, load=Killing(house / first.name, once))
            yield from others

        return CaptureSource(path, "test", refs, 3)

    monkeypatch.setattr(batch, "open_source", opener)
    options = BatchOptions(engine=Processes(2))
    result = measure_inputs([house], tmp_path / "out", OPTIONS, batch=options)
    assert (result.captures, result.exit_code) == ((2, 1) if always else (3, 0))
    assert [failure.capture for failure in result.failures] == ["simulated-bench"] * always
    assert all("was killed twice" in failure.message for failure in result.failures)


class Killing:
    """A loader that can be sent to another process."""

    def __init__(self, path: Path, once: Path) -> None:
        self._path, self._once = path, once

    def __call__(self) -> Capture:
        return killing(self._path, self._once)


class Names(Worker[str]):
    """Makes of each result its capture's name."""

    def measure(self, capture: Capture) -> str:
        return capture.name


@pytest.mark.parametrize("engine", [in_turn, in_process, Processes(2)])
def test_outcomes_come_in_order_with_failures_as_values(engine: Engine) -> None:
    first, second, third = list_captures([example_captures()], OPTIONS.reading)
    nowhere = Failure("nowhere", "", "CaptureError", "nowhere: does not exist")
    broken = CaptureRef("broken", 0, _raise, input="house")
    items = [first, nowhere, second, broken, third]
    done = list(measure_all(items, Names(Measurer(OPTIONS)), engine))
    assert [item for item, _ in done] == items
    answers = [x.message if isinstance(x, Failure) else x for _, x in done]
    failed = ["nowhere: does not exist", "recording: stopped in the middle"]
    names = ["simulated-bench", "simulated-row-a", "simulated-row-b"]
    assert answers == [names[0], failed[0], names[1], failed[1], names[2]]


def test_in_turn_asks_for_no_item_before_the_last_was_dealt_with() -> None:
    log: list[str] = []

    def items() -> Iterator[Item]:
        for capture in list_captures([example_captures()], OPTIONS.reading):
            assert isinstance(capture, CaptureRef)
            log.append(f"asked {capture.name[-1]}")
            yield capture

    for _, result in measure_all(items(), ResultWorker(Measurer(OPTIONS)), in_turn):
        assert isinstance(result, CaptureResult)
        log.append(f"done {result.capture.name[-1]}")
    assert log == ["asked h", "done h", "asked a", "done a", "asked b", "done b"]


def test_a_stopped_loop_begins_nothing_and_still_names_what_failed() -> None:
    first, second, _ = list_captures([example_captures()], OPTIONS.reading)
    nowhere = Failure("nowhere", "", "CaptureError", "nowhere: does not exist")
    seen: list[str | None] = []
    for _, answer in measure_all(
        [first, second, nowhere], Names(Measurer(OPTIONS)), in_turn, lambda: bool(seen)
    ):
        seen.append(answer.message if isinstance(answer, Failure) else answer)
    assert seen == ["simulated-bench", None, "nowhere: does not exist"]


def test_what_nothing_can_be_measured_without_ends_the_loop(tmp_path: Path) -> None:
    lost = replace(OPTIONS, calibration=tmp_path / "gone.json")
    listed = list_captures([example_captures()], lost.reading)
    with pytest.raises(CucumberVisionError, match=r"gone\.json"):
        list(measure_all(listed, ResultWorker(Measurer(lost))))


def test_a_path_by_two_ways_is_read_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    depth_m = np.full((48, 64), 0.45, np.float32)
    color, camera = np.zeros((48, 64, 3), np.uint8), Intrinsics(64, 48, 60.0, 60.0, 31.5, 23.5)
    for name in ("süd", "黄瓜"):
        write_native(Capture(color, depth_m, camera, name), tmp_path / name)
    (tmp_path / "link").symlink_to(tmp_path / "süd")
    inputs = [tmp_path / "süd", tmp_path / "link", tmp_path / "黄瓜", tmp_path / "." / "黄瓜"]
    with caplog.at_level(logging.WARNING):
        found = list(read_captures(inputs, ReadOptions()))
    # Names keep the letters of their alphabet.
    assert [one.name for one in found if not isinstance(one, Failure)] == ["süd", "黄瓜"]
    assert count_captures(inputs, ReadOptions()) == 2
    assert [r.getMessage().split(" is ", 1)[1] for r in caplog.records] == [
        "given twice: it is measured once"
    ] * 2


def test_pictures_that_belong_to_no_capture_are_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    depth_m = np.full((48, 64), 0.45, np.float32)
    color, camera = np.zeros((48, 64, 3), np.uint8), Intrinsics(64, 48, 60.0, 60.0, 31.5, 23.5)
    write_native(Capture(color, depth_m, camera, "a"), tmp_path / "a")
    (tmp_path / "depth_7.png").write_bytes(b"x")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "rgb_8.jpg").write_bytes(b"x")
    (tmp_path / "notes.txt").write_text("x")
    (tmp_path / "house.jpg").write_bytes(b"x")
    with caplog.at_level(logging.WARNING):
        found = list(read_captures([tmp_path], ReadOptions()))
    assert [one.name for one in found if not isinstance(one, Failure)] == ["a"]
    said = f"{tmp_path}: 2 images belong to no capture: depth_7.png, b/rgb_8.jpg"
    assert [record.getMessage() for record in caplog.records] == [said]


CAMERA_1280 = Intrinsics(1280, 720, 924.0, 924.0, 639.5, 359.5)


@pytest.fixture(scope="module")
def bench() -> Capture:
    return next(iter(open_source(example_captures() / "simulated-bench"))).load()


@pytest.fixture(scope="module")
def lengths_m(bench: Capture) -> list[float]:
    return values(measure(bench, instances="dataset").fruit)


def values(fruit: Sequence[Fruit]) -> list[float]:
    return [one.length.value_m for one in fruit if one.length is not None]


def test_arrays_measure_as_the_capture_does(bench: Capture, lengths_m: list[float]) -> None:
    matrix = bench.intrinsics.matrix
    in_mm = np.rint(bench.depth_m * 1000).astype(np.uint16)
    in_float = np.where(bench.depth_m > 0, bench.depth_m, np.nan).astype(np.float64)
    as_numbers = [255 * mask.astype(np.uint8) for mask in bench.masks]
    for depth in (in_mm, in_float):
        found = measure(bench.color, depth, matrix, masks=as_numbers)
        assert values(found.fruit) == pytest.approx(lengths_m, abs=1e-4)
        assert found.captures[0].models == ()  # masks that are given are of no network or plug-in
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
    assert sorted(names) == ["again", "simulated-bench"]
    (model,) = (model for model in found.captures[0].models if "package" in model)
    assert model["kind"] == "detector"
    assert str(model["name"]).endswith("second")
    # Its masks are measured as they are, pale and reddish ends included.
    assert values(found.fruit) == pytest.approx([lengths_m[1]] * 2)
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


def test_masks_and_boxes_that_do_not_fit_are_named_and_the_others_measured() -> None:
    capture = capsule_capture(lying(0.16))
    mask = capture.masks[0]
    good = Instance.of_mask(mask)
    small = Instance.of_mask(mask[::2, ::2])
    nowhere = replace(good, box=np.array([700.0, 10, 800, 40]))
    unknown = replace(good, box=np.array([np.nan, 10, 800, 40]))
    unsure = replace(good, confidence=np.nan)
    found = measure(capture, instances=[small, nowhere, good, unknown, unsure])
    assert values(found.fruit) == pytest.approx([0.16], abs=0.002)
    told = [failure.message for failure in found.failures]
    assert len(told) == 4
    assert "instance 1: the mask is 320x180, the picture 640x360" in told[0]
    assert "instance 2: the box [700, 10, 800, 40] has no area inside" in told[1]
    assert "instance 4: the box [nan, 10, 800, 40] is not finite" in told[2]
    assert "instance 5: the confidence is nan" in told[3]


def test_a_box_beyond_the_picture_is_cut_and_flagged() -> None:
    capture = capsule_capture(lying(0.16))
    wide = replace(Instance.of_mask(capture.masks[0]), box=np.array([-40.0, 100, 400, 220]))
    (fruit,) = measure(capture, instances=[wide]).fruit
    assert fruit.instance.box.tolist() == [-0.5, 100, 400, 220]
    assert Flag.BOX_CLIPPED in fruit.flags


def test_classes_choose_what_is_measured() -> None:
    capture = capsule_capture(lying(0.16, down_m=-0.05), lying(0.14, down_m=0.06))
    pair = [Instance.of_mask(mask) for mask in capture.masks]
    labelled = [replace(pair[0], class_name="Cucumber "), replace(pair[1], class_name="leaf")]
    assert len(measure(capture, instances=labelled).fruit) == 2
    results = measure(capture, instances=labelled, classes="cucumber")
    assert values(results.fruit) == pytest.approx([0.16], abs=0.002)
    assert results.captures[0].left_out == {"leaf": 1}


def test_a_file_that_names_none_of_the_captures_is_a_failure(tmp_path: Path) -> None:
    path = tmp_path / "labels.json"
    path.write_text(json.dumps([{"file_name": "other.png", "bbox": [1, 1, 5, 5]}]))
    (failure,) = measure(capsule_capture(lying(0.16)), instances=path).failures
    assert failure.error == "InstancesError"
    assert "names none of the captures (capsules); it names other.png" in failure.message


def halved(capture: Capture) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return capture.color[::2, ::2], capture.depth_m[::2, ::2], capture.masks[0][::2, ::2]


def test_a_matrix_of_the_unscaled_picture_is_refused() -> None:
    capture = capsule_capture(lying(0.16), camera=CAMERA_1280)
    color, depth_m, mask = halved(capture)
    matrix = CAMERA_1280.matrix
    with pytest.raises(IntrinsicsError, match=r"2 times as large as 640x360.*-50 % wrong"):
        measure(color, depth_m, matrix, masks=[mask])
    matrix[:2] /= 2
    (fruit,) = measure(color, depth_m, matrix, masks=[mask]).fruit
    assert fruit.length is not None
    assert fruit.length.value_m == pytest.approx(0.16, abs=0.002)


def test_a_cut_out_with_the_matrix_of_the_whole_is_doubted() -> None:
    capture = capsule_capture(lying(0.16, tilt_deg=35))
    part = slice(80, 280), slice(160, 560)
    color, depth_m, mask = (
        array[part] for array in (capture.color, capture.depth_m, capture.masks[0])
    )
    matrix = capture.intrinsics.matrix
    (fruit,) = measure(color, depth_m, matrix, masks=[mask]).fruit
    assert Flag.PRINCIPAL_POINT in fruit.flags


@pytest.mark.parametrize(
    ("depth", "words"),
    [
        (lambda depth_m: np.rint(depth_m * 255).astype(np.uint8), "depth has 8 bits"),
        (lambda depth_m: depth_m * 1000, "declared in metres, but 100 %.*0.001 m"),
        (lambda depth_m: depth_m > 0.5, "depth has 8 bits .bool"),
        (lambda depth_m: np.rint(depth_m).astype(np.uint16), "declared in millimetres, but"),
    ],
)
def test_depth_that_is_no_metres_is_refused(
    depth: Callable[[np.ndarray], np.ndarray], words: str
) -> None:
    capture = capsule_capture(lying(0.16, distance_m=0.9), wall_m=1.4)
    with pytest.raises(DepthError, match=words):
        measure(capture.color, depth(capture.depth_m), capture.intrinsics, masks=capture.masks)


def test_captures_and_labels_without_a_counterpart_are_named(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    images = [{"id": k, "file_name": f"row1/{n}.png"} for k, n in enumerate("ac")]
    boxes = [{"id": 0, "image_id": 0, "category_id": 1, "bbox": [2, 1, 5, 4]}]
    path.write_text(json.dumps({"images": images, "annotations": boxes, "categories": []}))
    a, again, b = (CaptureRef(name, 0, _raise, f"row1/{name}.png") for name in "aab")
    labels = Labels(str(path))
    first, second, third = labels.checked([a, replace(again, name="a-2"), b])
    assert (first, third) == (a, b)
    assert isinstance(second, Failure)
    assert "names row1/a.png once, which both a and a-2 are" in second.message
    notes = [f"{path}: no fruit given for b", f"{path}: no capture is called row1/c.png"]
    assert labels.notes() == notes
    lost = Labels(str(path))
    assert list(lost.checked([b]))
    with pytest.raises(InstancesError, match=r"names none of the captures \(b\); it names row1/a"):
        lost.notes()
    assert Labels("auto").notes() == []
