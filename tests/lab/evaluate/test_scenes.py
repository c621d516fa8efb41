"""The whole evaluation on a few drawn frames, by networks that always give the same answer."""

from __future__ import annotations

import csv
import hashlib
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.constant_network import constant_network
from typer.testing import CliRunner

pytest.importorskip("pycocotools")
pytest.importorskip("onnx")

from cucumbervision.accuracy.statistics import Cell
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.pictures import write_png
from cucumbervision.cli.app import app
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision_lab.data.coco import write_coco
from cucumbervision_lab.data.labels import DataSet, Label, LabelledPicture
from cucumbervision_lab.evaluate import scenes as run
from cucumbervision_lab.evaluate.measure_case import Masks
from cucumbervision_lab.evaluate.outcomes import Evaluation, end_rows
from cucumbervision_lab.evaluate.pictures import Stage, open_networks, read_held_out
from cucumbervision_lab.evaluate.report import detection_tables
from cucumbervision_lab.evaluate.scenes import evaluate_detection
from cucumbervision_lab.scenes.bodies import arc_tube, rotation
from cucumbervision_lab.scenes.scene import Scene, render

CAMERA = Intrinsics(320, 192, 300.0, 300.0, 160.0, 96.0)
DEPTH_M = 0.4
# Drawn pictures in the order of the set: fruit, nothing, fruit.
NAMES = ("a", "b", "c")


def network(path: Path, *outputs: NDArray[Any], **props: object) -> Path:
    """Write a network that gives these arrays, whatever it sees."""
    props = {"names": {0: "cucumber"}, "stride": 32, "end2end": True, **props}
    path.write_bytes(constant_network(*outputs, props=props, shape=(1, 3, 192, 320)))
    return path


def sha1_of(path: Path) -> str:
    return hashlib.sha1(path.read_bytes(), usedforsecurity=False).hexdigest()[:12]


def rows_of(*rows: Sequence[float]) -> NDArray[np.float64]:
    out = np.zeros((1, 300, len(rows[0])))
    out[0, : len(rows)] = rows
    return out


class DrawnFruit:
    """A fruit of 14 cm before an empty wall, as it is and as a file."""

    def __init__(self, folder: Path) -> None:
        tube = arc_tube(0.14, 0.02).moved(rotation(20.0, 0.0, 0.0), (0.0, 0.0, DEPTH_M))
        self.tube, self.drawn = tube, render(Scene.of(tube, backdrop_m=0.6), CAMERA)
        self.mask = self.drawn.mask(0)
        axis = np.array([tube.axis_m[0], tube.axis_m[-1]])
        ends = CAMERA.project(axis)
        line = np.linspace(0, 1, 5)[:, None] * (ends[1] - ends[0]) + ends[0]
        self.keypoints = np.column_stack([line, np.full(5, 2.0)])
        self.folder = self._write(folder)

    def _write(self, folder: Path) -> Path:
        color = np.full((192, 320, 3), (150, 140, 130), np.uint8)
        extras = {
            "centreline_m": self.tube.centreline_m,
            "thread_m": self.tube.thread_m,
            "chord_m": self.tube.chord_m,
        }
        label = Label.of_mask(self.mask, keypoints=self.keypoints, hidden_share=0.0, extras=extras)
        raw = folder / "raw"
        (raw / "images").mkdir(parents=True)
        (raw / "depth").mkdir()
        pictures = []
        for name in NAMES:
            shown = color.copy()
            if name != "b":
                shown[self.mask] = (40, 120, 40)
            depth = np.where(self.drawn.mask(0) & (name != "b"), self.drawn.depth_m, 0.6)
            write_png(raw / "images" / f"{name}.png", shown)
            write_png(raw / "depth" / f"{name}.png", np.rint(1000 * depth).astype(np.uint16))
            pictures.append(
                LabelledPicture(
                    f"images/{name}.png",
                    320,
                    192,
                    () if name == "b" else (label,),
                    f"scene-{name}",
                    "test",
                    "synth",
                    depth_file=f"depth/{name}.png",
                    camera=CAMERA,
                )
            )
        write_coco(DataSet(raw, tuple(pictures)), folder / "set")
        return folder / "set"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> DrawnFruit:
    return DrawnFruit(tmp_path_factory.mktemp("networks"))


@pytest.fixture(scope="module")
def networks(scene: DrawnFruit, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Give a pair of networks that see the fruit everywhere, the pose one by 3 px too low."""
    folder = tmp_path_factory.mktemp("networks")
    box = box_of_mask(scene.mask) + 0.5
    prototypes = np.zeros((1, 32, 48, 80))
    blocks = scene.mask.reshape(48, 4, 80, 4).mean(axis=(1, 3))
    prototypes[0, 0] = 4 * (blocks - 0.5)
    segment = network(
        folder / "seg.onnx", rows_of([*box, 0.9, 0, 1.0, *[0.0] * 31]), prototypes, task="segment"
    )
    low = scene.keypoints + np.array([0.5, 3.5, 0.0])
    low[:, 2] = 0.95
    pose = network(
        folder / "pose.onnx", rows_of([*box, 0.8, 0, *low.ravel()]), task="pose", kpt_shape=[5, 3]
    )
    return segment, pose


@pytest.fixture(scope="module")
def result(scene: DrawnFruit, networks: tuple[Path, Path]) -> Evaluation:
    opened = open_networks(*networks, "mobile-sam", runtime="onnxruntime")
    # SAM on one picture only: it takes most of the time.
    return evaluate_detection(read_held_out(scene.folder), opened, sam_limit=1)


def test_average_precision_and_recall(result: Evaluation, scene: DrawnFruit) -> None:
    tables = {table.title: table for table in detection_tables(result)}
    found = {row[:2]: row[2:] for row in tables["Average precision"].rows}
    assert len(found) == 5
    # Hit, false alarm, hit, all of one confidence: precision 1 up to a recall of 0.5, then 2/3.
    expected = (51 + 50 * 2 / 3) / 101
    for stage in (Stage.SEGMENTED, Stage.POSED):
        assert found[str(stage), "boxes"] == pytest.approx((2, expected, expected), abs=1e-6)
    assert found[str(Stage.SEGMENTED), "masks"][1] == pytest.approx(expected)
    # All five are 3 px off: OKS = exp(-9 / (2 area 0.1²)).
    similarity = math.exp(-9 / (2 * np.count_nonzero(scene.mask) * 0.1**2))
    passed = sum(similarity >= t for t in np.arange(0.5, 0.96, 0.05).round(2))
    keypoints = found[str(Stage.POSED), "keypoints"]
    assert keypoints[2] == pytest.approx(expected * passed / 10)
    assert 5 <= passed <= 9
    for _, fruit, scenes, recall, _, _, _, precision, _ in tables["Recall and precision"].rows:
        assert (fruit, scenes, recall) == (2, 2, 1.0)
        assert precision == pytest.approx(2 / 3)


def tables_of(result: Evaluation) -> dict[str, dict[Cell, dict[str, Cell]]]:
    """Give the tables' rows by title and first cell, each by the columns' heads."""
    return {
        table.title: {row[0]: dict(zip(table.heads, row, strict=True)) for row in table.rows}
        for table in detection_tables(result)
    }


def test_ends(result: Evaluation, scene: DrawnFruit) -> None:
    length = float(np.linalg.norm(scene.keypoints[4, :2] - scene.keypoints[0, :2]))
    every = tables_of(result)["Ends"]["all"]
    assert every["n"] == 4
    # The network's points are 3 px off; the outline's axis ends within a pixel of the fruit's.
    assert cast("float", every["median (% of length)"]) < 100 * 1 / length
    assert end_rows(result.frames, result.networks.confidence)["swapped"].tolist() == [False, False]


def test_masks_and_lengths(result: Evaluation) -> None:
    tables = tables_of(result)
    masks = tables["Masks"]
    assert (masks["detector"]["fruit"], masks["measured"]["fruit"]) == (2, 1)
    assert cast("float", masks["detector"]["mean IoU"]) > 0.9  # blocks of four pixels
    assert cast("float", masks["measured"]["mean IoU"]) > 0.93  # drawn by SAM
    assert set(result.readings["masks"]) == {Masks.EXACT, Masks.PERCEIVED}
    for words in ("true masks", "perceived masks"):
        lengths = tables[f"Accuracy against the centreline, {words}"]
        best = lengths["selector best"]
        assert (best["measured (%)"], best["captures"]) == (100.0, 1)
        assert cast("float", best["MAPE (%)"]) < 5
    assert lengths["M4"]["measured (%)"] == 100.0


def test_missed_fruit_count_in_full(scene: DrawnFruit, tmp_path: Path) -> None:
    blind = network(tmp_path / "blind.onnx", rows_of([0, 0, 9, 9, 0.1, 0]), task="detect")
    opened = open_networks(blind, blind, None, runtime="onnxruntime")
    result = evaluate_detection(read_held_out(scene.folder), opened)
    assert tables_of(result)["Recall and precision"]["reported detections"]["recall"] == 0.0
    rows = tables_of(result)["Accuracy against the thread, perceived masks"].values()
    assert {row["captures"] for row in rows} == {2}
    assert {row["measured (%)"] for row in rows} == {0.0}
    assert {row["MAPE (%)"] for row in rows} == {100.0}


def test_the_command_writes_everything(
    scene: DrawnFruit, networks: tuple[Path, Path], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    arguments = ["evaluate", "models", str(scene.folder), "--out", str(out)]
    arguments += ["--seg", str(networks[0]), "--pose", str(networks[1])]
    arguments += ["--runtime", "onnxruntime", "--segmenter", "none"]
    found = CliRunner().invoke(app, arguments)
    assert found.exit_code == 0, found.output
    assert "Average precision" in found.output
    numbers = json.loads((out / "results.json").read_text())
    tables = {table["title"]: table["rows"] for table in numbers["tables"]}
    reported = tables["Recall and precision"][0]
    assert (reported["stage"], reported["recall"], reported["fruit"]) == (
        "reported detections",
        1,
        2,
    )
    assert [one["name"] for one in numbers["networks"]] == ["seg.onnx", "pose.onnx"]
    lengths = {r["method"]: r for r in tables["Accuracy against the thread, perceived masks"]}
    assert (lengths["M6 thread"]["captures"], lengths["M6 thread"]["measured (%)"]) == (2, 100.0)
    assert lengths["M6 thread"]["MAPE (%)"] < 10
    with (out / "detections.csv").open(encoding="utf-8") as stream:
        outcomes = [row["outcome"] for row in csv.DictReader(stream)]
    assert outcomes == ["hit", "false", "hit"]


def test_photos_are_judged_by_a_command_of_their_own(
    scene: DrawnFruit, networks: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Networks that always see the fruit at its full size find nothing at half size."""
    fruit, tests = Label(box_of_mask(scene.mask)), {"a": "on the plant", "b": "negatives"}
    pictures = [
        LabelledPicture(
            sha1_of(scene.folder / "images" / f"{name}.png"),
            320,
            192,
            (fruit,) if name == "a" else (),
            name,
            "test",
            extras={"setting": "plant", "test": test},
        )
        for name, test in tests.items()
    ]
    monkeypatch.setattr(run, "load_audit", lambda: DataSet(Path(), tuple(pictures)))
    arguments = ["evaluate", "photos", str(scene.folder), "--out", str(tmp_path / "out")]
    arguments += ["--seg", str(networks[0]), "--pose", str(networks[1])]
    # The detector is sure by 0.9, the pose network by 0.8, and what ships counts both: 0.85.
    arguments += ["--confidence", "0.82"]
    found = CliRunner().invoke(app, [*arguments, "--runtime", "onnxruntime"])
    assert found.exit_code == 0, found.output
    assert "test: on the plant" in found.output
    numbers = json.loads((tmp_path / "out" / "photos.json").read_text(encoding="utf-8"))
    shares = {row["photos"]: row for row in numbers["tables"][0]["rows"]}
    assert shares["test: on the plant"]["recall"] == 1.0
    assert shares["test: negatives"]["precision"] == 0.0
    assert shares["half size: on the plant"]["recall"] == 0.0
    with (tmp_path / "out" / "photo_detections.csv").open(encoding="utf-8") as stream:
        assert [row["outcome"] for row in csv.DictReader(stream)] == ["hit", "false"]

    empty = tmp_path / "empty"
    empty.mkdir()
    refused = CliRunner().invoke(app, ["evaluate", "photos", str(empty), "--out", "x"])
    assert refused.exit_code != 0
