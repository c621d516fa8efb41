from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
import uuid
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import openpyxl
import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import DepthAlong, Stream
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.readers.native import write_native
from cucumbervision.capture.source import CaptureRef, CaptureSource, ReadOptions, example_captures
from cucumbervision.crop.profiles import load_profile
from cucumbervision.errors import CucumberVisionError, UnknownModelError
from cucumbervision.files import as_path, cell_value
from cucumbervision.methods.result import LengthDefinition, MethodName, Selector
from cucumbervision.networks.registry import load_registry
from cucumbervision.plugins import Plugin
from cucumbervision.run import batch
from cucumbervision.run.finders import Finder
from cucumbervision.run.measurer import Failure
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import (
    CaptureRecord,
    OutputFolder,
    deciding_sha256,
    measure_inputs,
)

ROW_A = "simulated-row-a"


@pytest.fixture(scope="module")
def run_out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One run over the bundled captures and a broken one, with the data set's masks."""
    folder = tmp_path_factory.mktemp("run")
    broken = folder / "broken"
    shutil.copytree(example_captures() / "simulated-bench", broken)
    (broken / "depth_000002.png").write_bytes(b"\x89PNG\r\n")
    seen: list[CaptureRecord | Failure] = []
    result = measure_inputs(
        [broken, example_captures(), folder / "missing"],
        folder / "out",
        MeasureOptions(),
        seen.append,
    )
    assert [isinstance(one, Failure) for one in seen] == [True, False, False, False, True]
    assert [len(one.rows) for one in seen if isinstance(one, CaptureRecord)] == [3, 3, 2]
    assert result.exit_code == 1
    assert result.captures == 3
    assert len(result.rows) == 8
    assert len(result.failures) == 2
    return folder / "out"


def read_csv(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8-sig") as stream:
        return list(csv.DictReader(stream))


def test_bad_input_loses_nothing_of_the_rest(run_out: Path) -> None:
    rows = read_csv(run_out / "measurements.csv")
    assert len(rows) == 8
    assert all(row["length_cm"] for row in rows)
    failures = read_csv(run_out / "failures.csv")
    assert [f["error"] for f in failures] == ["CaptureError", "CaptureError"]
    assert "depth_000002.png" in failures[0]["message"]
    assert "missing" in failures[1]["message"]
    assert all("\n" not in f["message"] and ";" in f["message"] for f in failures)


def test_lengths_are_near_the_truth_within_each_methods_known_error(run_out: Path) -> None:
    rows = [r for r in read_csv(run_out / "measurements.csv") if r["capture"] == ROW_A]
    truth = json.loads((example_captures() / ROW_A / "truth.json").read_text())
    for row, true in zip(rows, truth, strict=True):
        assert row["method"] == "M6"
        assert float(row["centreline_cm"]) / (100 * true["centreline_m"]) == pytest.approx(
            1, abs=0.02
        )
        assert float(row["thread_cm"]) / (100 * true["thread_m"]) == pytest.approx(1, abs=0.03)
        # M3 reads the visible chord: at most the chord, and at least all but 4 % of it.
        assert 0.96 < float(row["m3_cm"]) / (100 * true["chord_m"]) < 1.01
        # The paper's M5 over-reads by its tip anchors and by the round surface: short fruit most.
        assert 0.99 < float(row["m5_cm"]) / (100 * true["centreline_m"]) < 1.08
        assert row["simulated"] == "true"


def test_json_carries_provenance(run_out: Path) -> None:
    report = json.loads((run_out / "measurements.json").read_text(encoding="utf-8"))
    assert report["software"].startswith("cucumbervision ")
    assert report["licence"] == "AGPL-3.0-only"
    assert len(report["config_sha256"]) == 64
    assert report["models"] == []
    assert "numpy" in report["versions"]
    assert report["kernel"] in ("compiled", "numpy")
    assert len(report["failures"]) == 2
    first = report["captures"][0]
    assert first["intrinsics"]["stream"] == "color"
    assert first["intrinsics"]["fx_px"] == 616.4
    fruit = first["fruit"][0]
    assert fruit["methods"]["M5"]["length_m"] * 100 == pytest.approx(fruit["m5_cm"], abs=1e-3)
    assert len(fruit["methods"]["M5"]["tips_m"]) == 2
    assert fruit["methods"]["M4"]["reason"] == "no-keypoints"


def test_workbook_says_the_same_as_the_csv(run_out: Path) -> None:
    sheet = openpyxl.load_workbook(run_out / "measurements.xlsx")["Fruit"]
    lines = list(sheet.iter_rows(min_row=2, values_only=True))
    rows = read_csv(run_out / "measurements.csv")
    assert len(lines) == len(rows)
    for line, row in zip(lines, rows, strict=True):
        for cell, text in zip(line, row.values(), strict=True):
            shown = cell_value(cell)  # Excel has true and false of its own
            assert ("" if shown is None else str(shown)) == text or float(cell) == float(text)


def test_an_annotated_picture_for_each_capture(run_out: Path) -> None:
    pictures = sorted((run_out / "overlays").glob("*.png"))
    # The broken capture keeps its name for when it is repaired.
    assert [p.stem for p in pictures] == ["simulated-bench-2", ROW_A, "simulated-row-b"]
    picture = cv2.imread(str(pictures[0]))
    assert picture is not None
    assert picture.shape == (480, 848, 3)


def test_captures_of_one_name_get_pictures_of_their_own(tmp_path: Path) -> None:
    other = tmp_path / "again"
    shutil.copytree(example_captures() / ROW_A, other)
    result = measure_inputs(
        [example_captures() / ROW_A, other],
        tmp_path / "out",
        MeasureOptions(methods=(MethodName.M1,)),
    )
    assert sorted({str(row["capture"]) for row in result.rows}) == [ROW_A, f"{ROW_A}-2"]
    assert len(list((tmp_path / "out" / "overlays").iterdir())) == 2
    assert all(row["m5_cm"] is None for row in result.rows)


FIRST_FRUIT = (180.0, 85.0, 80.0, 295.0)  # x, y, width, height


def coco(
    path: Path, boxes: Sequence[Sequence[float]] = (), *others: Any, names: Sequence[str] = (ROW_A,)
) -> MeasureOptions:
    """Write boxes of the first image, and further annotations, and return options for them."""
    of_first = {"image_id": 0, "category_id": 1}
    labels = [{"id": k, **of_first, "bbox": box} for k, box in enumerate(boxes, 1)]
    content = {
        "images": [{"id": k, "file_name": name} for k, name in enumerate(names)],
        "annotations": [*labels, *others],
        "categories": [{"id": 1, "name": "cucumber"}],
    }
    path.write_text(json.dumps(content))
    return MeasureOptions(instances=str(path))


def test_a_capture_without_fruit_is_a_picture_without_rows(tmp_path: Path) -> None:
    options = coco(tmp_path / "boxes.json")
    result = measure_inputs([example_captures() / ROW_A], tmp_path / "out", options)
    assert (result.captures, result.rows, result.failures) == (1, [], [])
    assert (tmp_path / "out" / "overlays" / f"{ROW_A}.png").exists()


def test_boxes_from_a_file_are_refined_by_sam_and_bad_ones_are_noted(tmp_path: Path) -> None:
    options = coco(tmp_path / "boxes.json", [FIRST_FRUIT, (900.0, 10.0, 40.0, 40.0)])
    result = measure_inputs([example_captures() / ROW_A], tmp_path / "out", options)
    assert len(result.rows) == 1
    row = result.rows[0]
    assert row["mask_source"] == "sam"
    assert row["m3_cm"] == pytest.approx(23.2, rel=0.04)
    assert [f.error for f in result.failures] == ["InstancesError"]
    models = json.loads((tmp_path / "out" / "measurements.json").read_text())["models"]
    assert models[0]["name"] == "mobile-sam"
    assert set(models[0]["sha256"]) == {"encoder", "decoder"}


@pytest.mark.parametrize("named", [True, False])
def test_a_file_for_other_pictures_measures_none_of_them(tmp_path: Path, named: bool) -> None:
    # Its image id is the capture's running number, and its name another picture's.
    names = ["elsewhere.png", ROW_A] if named else ["elsewhere.png"]
    unknown = [
        {"id": k, "image_id": k, "category_id": 1, "bbox": [1, 1, 9, 9]} for k in range(90, 98)
    ]
    path = tmp_path / "boxes.json"
    options = coco(path, [FIRST_FRUIT], *(unknown if named else ()), names=names)
    options = replace(options, segmenter="none")
    result = measure_inputs([example_captures()], tmp_path / "out", options)
    assert result.rows == []
    if named:
        assert result.failures == []
        assert result.notes == [
            f"{path}: no fruit given for simulated-bench, simulated-row-b",
            f"{path}: no capture is called elsewhere.png, "
            + ", ".join(f"image id {number}" for number in range(90, 98)),
        ]
        report = json.loads((tmp_path / "out" / "measurements.json").read_text(encoding="utf-8"))
        assert report["notes"] == result.notes
    else:
        (failure,) = result.failures
        assert "names none of the captures (simulated-bench, " in failure.message


def test_the_second_capture_that_one_label_names_is_not_measured(tmp_path: Path) -> None:
    for folder, capture in (("h1", ROW_A), ("h2", "simulated-row-b")):
        shutil.copytree(example_captures() / capture, tmp_path / folder / "cap")
    options = coco(tmp_path / "boxes.json", [FIRST_FRUIT], names=["cap"])
    options = replace(options, segmenter="none")
    result = measure_inputs([tmp_path / "h1", tmp_path / "h2"], tmp_path / "out", options)
    assert ([row["capture"] for row in result.rows], result.exit_code) == ([ROW_A], 1)
    (failure,) = result.failures
    assert failure.capture == "simulated-row-b"
    assert f"both {ROW_A} and simulated-row-b are: only the first" in failure.message


def test_without_a_segmenter_boxes_are_measured_by_the_box(tmp_path: Path) -> None:
    label = tmp_path / f"{ROW_A}.txt"
    label.write_text(f"0 {220 / 848} {232 / 480} {80 / 848} {295 / 480}\n")
    options = MeasureOptions(instances=str(tmp_path), segmenter="none")
    result = measure_inputs([example_captures() / ROW_A], tmp_path / "out", options)
    assert [row["method"] for row in result.rows] == ["M1"]
    assert result.rows[0]["reason"] == "no-mask-box-elongated"


def test_the_dataset_is_asked_for_masks_that_it_lacks(tmp_path: Path) -> None:
    plain = tmp_path / "plain"
    shutil.copytree(example_captures() / ROW_A, plain)
    shutil.rmtree(plain / "mask_visib")
    result = measure_inputs([plain], tmp_path / "out", MeasureOptions(instances="dataset"))
    assert result.rows == []
    assert "has no masks" in result.failures[0].message


def test_a_segmenter_that_is_not_here_stops_the_run_at_once() -> None:
    with pytest.raises(UnknownModelError, match="choose one of mobile-sam"):
        Finder(MeasureOptions(segmenter="sam-vit-b"))


def test_an_output_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(CucumberVisionError, match=r"file/out: cannot be written .*--out"):
        measure_inputs([example_captures()], file / "out", MeasureOptions())


def test_whatever_is_raised_in_one_capture_the_others_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    good = next(iter(open_source(example_captures() / ROW_A)))

    def too_large() -> Capture:
        return replace(good.load(), depth_m=np.zeros((1 << 24, 1 << 24), np.float32))

    def endless() -> Capture:
        return replace(good.load(), burst_size=int(float("inf")))

    def opener(path: Path, *_: object) -> CaptureSource:
        def refs() -> Iterator[CaptureRef]:
            yield CaptureRef("too_large", 0, too_large)
            yield CaptureRef("endless", 0, endless)
            yield good
            raise RecursionError("maximum recursion depth exceeded")

        return CaptureSource(path, "test", refs)

    options = MeasureOptions(methods=(MethodName.M1,))
    monkeypatch.setattr(batch, "open_source", opener)
    result = measure_inputs([Path("house")], tmp_path, options)
    assert (result.captures, len(result.rows), result.exit_code) == (1, 3, 70)
    assert [(f.capture, f.error) for f in result.failures] == [
        ("too_large", "OutOfMemoryError"),
        ("endless", "InternalError"),
        ("", "InternalError"),
    ]
    assert "OverflowError" in result.failures[1].message
    assert len(read_csv(tmp_path / "failures.csv")) == 3
    assert len(read_csv(tmp_path / "measurements.csv")) == 3


def test_a_picture_that_cannot_be_written_costs_no_row(tmp_path: Path) -> None:
    (tmp_path / "overlays" / f"{ROW_A}.png").mkdir(parents=True)
    options = MeasureOptions(methods=(MethodName.M1,))
    result = measure_inputs([example_captures() / ROW_A], tmp_path, options)
    assert (result.captures, len(result.rows), result.exit_code) == (1, 3, 1)
    assert [f.error for f in result.failures] == ["FileError"]
    assert "Is a directory" in result.failures[0].message


@pytest.mark.parametrize(
    ("unit_m", "note"),
    [(0.01, "is one step of depth really 1 mm? --depth-unit 0.0001, 0.0002"), (0.001, None)],
)
def test_a_batch_whose_lengths_are_all_impossible_says_what_would_explain_it(
    tmp_path: Path, unit_m: float, note: str | None
) -> None:
    # Depth in tenths of a millimetre, read as millimetres; the fruit lie at 4.2 m then.
    folder = tmp_path / "in"
    capture = next(iter(open_source(example_captures() / ROW_A).refs())).load()
    small = replace(capture, depth_m=capture.depth_m * np.float32(unit_m / 0.001), masks=())
    far = np.where(small.depth_m < 5.5, small.depth_m * np.float32(0.85), 0).astype(np.float32)
    write_native(replace(small, depth_m=far if note else small.depth_m), folder)
    options = coco(tmp_path / "boxes.json", [FIRST_FRUIT], names=[capture.name])
    result = measure_inputs([folder], tmp_path / "out", options)
    (row,) = result.rows
    assert (row["length_cm"] is None) == (note is not None)
    assert (row["reason"] == "implausible-length") == (note is not None)
    assert bool(result.notes) == (note is not None)
    if note:
        assert row["interval_low_cm"] is None
        assert str(row["fallback"]).endswith(":out-of-range")
        assert note in result.notes[0]


@pytest.fixture(params=["local", "remote"])
def out(request: pytest.FixtureRequest, tmp_path: Path) -> OutputFolder:
    """An output folder on the disk, or on a store."""
    if request.param == "local":
        return OutputFolder(tmp_path / "out")
    pytest.importorskip("upath")
    return OutputFolder(as_path(f"memory://{uuid.uuid4().hex}"))


@pytest.fixture
def local(tmp_path: Path) -> OutputFolder:
    return OutputFolder(tmp_path / "out")


def test_a_file_replaces_another_and_leaves_no_other(out: OutputFolder) -> None:
    assert not out.has("overlays/a.png")
    for data in (b"first", b"second"):
        out.write("overlays/a.png", data)
    assert (out.path / "overlays/a.png").read_bytes() == b"second"
    assert [path.name for path in (out.path / "overlays").iterdir()] == ["a.png"]
    with out.replacing("table.csv") as path:
        assert path.suffix == ".csv"
        path.write_text("a,b\n")
    assert (out.path / "table.csv").read_text() == "a,b\n"


def test_what_fails_half_way_leaves_what_was_there(out: OutputFolder) -> None:
    out.write("table.csv", b"whole")

    def break_off() -> None:
        with out.replacing("table.csv") as path:
            path.write_bytes(b"ha")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        break_off()
    assert (out.path / "table.csv").read_bytes() == b"whole"
    assert [path.name for path in out.path.rglob("*") if path.is_file()] == ["table.csv"]


def test_the_next_run_removes_what_a_killed_one_left_half_written(local: OutputFolder) -> None:
    pytest.importorskip("fcntl")
    program = (
        "import os, signal, sys; from pathlib import Path\n"
        "from cucumbervision.run.whole_run import OutputFolder\n"
        "with OutputFolder(Path(sys.argv[1])).replacing('overlays/a.png') as path:\n"
        "    path.write_bytes(b'ha'); os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", program, local.path], check=False)
    left = [path for path in local.path.rglob("*") if path.is_file()]
    assert [path.read_bytes() for path in left] == [b"ha"]
    with local.locked(".lock"):
        local.write("table.csv", b"whole")
    assert sorted(path.name for path in local.path.iterdir()) == [".lock", "overlays", "table.csv"]
    assert not list((local.path / "overlays").iterdir())


def test_two_runs_do_not_write_into_one_folder(local: OutputFolder) -> None:
    pytest.importorskip("fcntl")
    with local.locked(".lock"):
        folder = OutputFolder(local.path)
        with (
            pytest.raises(CucumberVisionError, match="another run is writing into it; wait"),
            folder.locked(".lock"),
        ):
            raise AssertionError
    with local.locked(".lock"):
        pass


USUAL, REGISTRY = MeasureOptions(), load_registry()


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
        {"segmenter": "none"},
        {"end_look": False},
        {"accepted_m": load_profile("mini-cucumber").accepted_m},
    ],
)
def test_options_decide(change: dict[str, Any]) -> None:
    assert deciding_sha256(replace(USUAL, **change), REGISTRY) != deciding_sha256(USUAL, REGISTRY)


def test_the_content_of_named_files_decides(tmp_path: Path) -> None:
    boxes = tmp_path / "boxes.json"
    options = replace(USUAL, instances=str(boxes))
    with pytest.raises(CucumberVisionError, match="no such file"):
        deciding_sha256(options, REGISTRY)
    boxes.write_text("{}")
    before = deciding_sha256(options, REGISTRY)
    boxes.write_text("{ }")
    assert deciding_sha256(options, REGISTRY) != before


def test_a_network_in_use_decides() -> None:
    (seg, *_) = (model for model in REGISTRY.models if model.task == "segment")
    other = replace(seg, files=(replace(seg.files[0], sha256="0" * 64),))
    changed = tuple(other if model is seg else model for model in REGISTRY.shipped)
    registry = replace(REGISTRY, shipped=changed)
    assert deciding_sha256(USUAL, registry) != deciding_sha256(USUAL, REGISTRY)


def test_a_plug_in_without_a_version_is_never_the_same() -> None:
    known = Plugin("methods", "M7", "other:M7", "other", "1.0")
    unknown = replace(known, version="")
    one, again = (deciding_sha256(USUAL, REGISTRY, [known]) for _ in range(2))
    assert one == again != deciding_sha256(USUAL, REGISTRY)
    assert deciding_sha256(USUAL, REGISTRY, [unknown]) != deciding_sha256(
        USUAL, REGISTRY, [unknown]
    )
