"""The whole evaluation on a few drawn frames, by networks that always give the same answer."""

from __future__ import annotations

import csv
import hashlib
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

pytest.importorskip("pycocotools")
pytest.importorskip("onnx")

from tests.constant_network import constant_network

from cucumbervision.accuracy.statistics import Cell
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.pictures import write_png
from cucumbervision.cli.app import app
from cucumbervision.errors import DataSetError
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision_lab.data.coco import write_coco
from cucumbervision_lab.data.labels import DataSet, Label, LabelledPicture
from cucumbervision_lab.evaluate import scenes as run
from cucumbervision_lab.evaluate.measure_case import Masks, Row
from cucumbervision_lab.evaluate.outcomes import Evaluation, end_rows
from cucumbervision_lab.evaluate.pictures import (
    Frame,
    Networks,
    Stage,
    frame_of,
    open_networks,
    read_held_out,
)
from cucumbervision_lab.evaluate.report import detection_tables, photo_tables
from cucumbervision_lab.evaluate.scenes import (
    audited,
    audited_photos,
    evaluate_detection,
    evaluate_photos,
    load_audit,
    photo_truth,
    set_records,
)
from cucumbervision_lab.scenes.bodies import arc_tube, rotation
from cucumbervision_lab.scenes.generate import FrameOptions, SynthOptions, generate
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


SIDES = {"left", "right", "up", "down", "up-left", "up-right", "down-left", "down-right"}


def write_picture(path: Path, grey: int) -> str:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((48, 64, 3), grey, np.uint8))
    return hashlib.sha1(path.read_bytes()).hexdigest()[:12]


def audit(*photos: LabelledPicture) -> DataSet:
    return DataSet(Path(), photos, ("cucumber", "zucchini"))


def audited_photo(sha1: str, split: str, *labels: Label) -> LabelledPicture:
    return LabelledPicture(sha1, 64, 48, labels, "one", split, "us", "CC0")


def box(x1: int, y1: int, x2: int, y2: int) -> np.ndarray:
    return np.array([x1, y1, x2, y2]) - 0.5


def test_the_packaged_audit_is_sound() -> None:
    data = load_audit()
    assert data.refused == ()
    splits: dict[str, set[str]] = {}
    outlined = 0
    for p in data.pictures:
        splits.setdefault(p.scene, set()).add(p.split)
        for label in p.labels:
            low, high = label.box[:2] + 0.5, label.box[2:] + 0.5
            assert (low >= 0).all(), p.file
            assert (low < high).all(), p.file
            assert (high <= (p.width, p.height)).all(), p.file
            assert label.extras.get("stem") in (SIDES if not label.ignore else set()) | {None}
            for end in () if label.keypoints is None else label.keypoints[[0, 4], :2]:
                assert (label.box[:2] <= end).all(), p.file
                assert (end <= label.box[2:]).all(), p.file
            if label.mask_code is not None:
                assert label.pseudo
                assert p.split != "test"
                outlined += 1
        setting = p.extras["setting"]
        assert (setting in ("none", "parts")) == (not p.shows_fruit), p.file
        assert (setting == "none") == (not p.labels), p.file
    assert [scene for scene, names in splits.items() if len(names) > 1] == []
    assert outlined > 400


def test_a_photo_is_known_by_its_bytes_wherever_it_lies(tmp_path: Path) -> None:
    sha1 = write_picture(tmp_path / "deep" / "renamed.png", 90)
    write_picture(tmp_path / "unknown.png", 30)
    fruit = Label(box(10, 5, 30, 45), category=1)
    crate = Label(box(30, 0, 64, 48), ignore=True)
    book = audit(audited_photo(sha1, "test", fruit, crate), audited_photo("0" * 12, "test"))
    found = audited(tmp_path, "test", book)
    (picture,) = found.pictures
    assert (picture.file, picture.split, picture.source) == ("deep/renamed.png", "test", "us")
    truth = photo_truth(picture, found).true
    assert [(one.optional, one.ignore) for one in truth] == [(True, False), (False, True)]
    with pytest.raises(DataSetError, match="contains no audited photo"):
        audited(tmp_path, "train", book)


def test_polygons_beside_the_photos_become_masks_where_they_fit(tmp_path: Path) -> None:
    sha1 = write_picture(tmp_path / "images" / "a.png", 90)
    (tmp_path / "labels_seg").mkdir()
    # A triangle over x 8 to 24 and y 12 to 36 of a picture 64 x 48, and one that fits nothing.
    (tmp_path / "labels_seg" / "a.txt").write_text(
        "0 0.125 0.25 0.375 0.25 0.375 0.75\n0 0.5 0.5 0.6 0.5 0.6 0.6\n", encoding="utf-8"
    )
    book = audit(
        audited_photo(sha1, "train", Label(box(8, 12, 24, 36)), Label(box(41, 12, 64, 36)))
    )
    first, second = audited(tmp_path, audit=book, outlines=True).pictures[0].labels
    assert first.mask is not None
    assert first.mask.sum() == pytest.approx(16 * 24 / 2, abs=20)
    assert (first.pseudo, second.mask) == (False, None)
    assert all(x.mask is None for x in audited(tmp_path, audit=book).pictures[0].labels)


@pytest.mark.realdata
def test_every_audited_photo_is_in_the_real_folder(shared_data: Path) -> None:
    data = audited(shared_data, outlines=True)
    assert len(data.pictures) == len(load_audit().pictures)
    board = [p for p in data.pictures if p.extras["collection"] == "board_cm"]
    labels = [label for p in board for label in p.labels]
    assert sum(label.mask is not None for label in labels) / len(labels) > 0.9


class TruthFinder:
    """Finds every fruit that is to be found, as SAM would draw it."""

    def __init__(self, folder: Path) -> None:
        self.data = generate(
            SynthOptions(frames=3, seed=3, frame=FrameOptions(width=640, height=360)), folder
        )

    def find(self, capture: Capture) -> SimpleNamespace:
        (picture,) = (p for p in self.data.pictures if Path(p.file).stem == capture.name)
        found = []
        for label, fruit in zip(
            picture.labels, frame_of(picture, self.data, None).true, strict=True
        ):
            if fruit.required and label.mask is not None:
                found.append(Instance(label.box, 0.8, mask=label.mask, mask_source=MaskSource.SAM))
        return SimpleNamespace(instances=tuple(found))


@pytest.fixture(scope="module")
def finder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TruthFinder]:
    finder = TruthFinder(tmp_path_factory.mktemp("drawn") / "set")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "package_finder", lambda: finder)
        yield finder


@pytest.fixture(scope="module")
def rows(finder: TruthFinder, tmp_path_factory: pytest.TempPathFactory) -> list[Row]:
    return set_records(finder.data.folder, "all", tmp_path_factory.mktemp("kept") / "rows.jsonl")


def test_the_same_mask_reads_the_same_whoever_drew_it(rows: list[Row]) -> None:
    given, perceived = (
        [row for row in rows if row["masks"] == kind] for kind in (Masks.EXACT, Masks.PERCEIVED)
    )
    assert len(given) == len(perceived) > 2
    for one, other in zip(given, perceived, strict=True):
        assert one["fruit"] == other["fruit"]
        thread_m = one["lengths_m"]["M6 thread"]
        assert thread_m == pytest.approx(other["lengths_m"]["M6 thread"], rel=1e-6)
        assert one["mask_features"]["perceived"] == 0.0
        assert other["mask_features"]["perceived"] == 1.0
    whole = [row for row in given if not row["cut_off"] and row["hidden_share"] < 0.05]
    errors = [(row["lengths_m"]["M6"] or np.nan) / row["centreline_m"] - 1 for row in whole]
    assert abs(np.median(errors)) < 0.05


def test_learning_asks_for_a_drawn_set(tmp_path: Path) -> None:
    told = CliRunner().invoke(app, ["benchmark", "--learn-intervals", str(tmp_path / "a.json")])
    assert told.exit_code == 2
    assert "--learn-set" in told.output


ENDS = ("blossom end", "stem end")
SPOTS = [np.array([0.0, 30 * k, 90, 30 * k + 20]) for k in range(8)]


def photo(name: str, scene: str, true: list[Label], *found: int) -> Frame:
    seen = tuple(Label(SPOTS[k], score=0.9 - 0.1 * k) for k in found)
    return Frame(name, scene, 300, 300, tuple(true), kept=seen)


def photo_set(*photos: tuple[str, str, str], folder: Path = Path(), **fields: Any) -> DataSet:
    """Give photos of a name, a setting and a test."""
    pictures = (
        LabelledPicture(name, 80, 60, extras={"setting": setting, "test": test}, **fields)
        for name, setting, test in photos
    )
    return DataSet(folder, tuple(pictures))


def scored() -> Evaluation:
    cucumber, courgette = Label(SPOTS[0]), Label(SPOTS[1], optional=True)
    crate = Label(np.array([0.0, 60, 300, 115]), ignore=True)
    frames = (
        photo("a.jpg", "one", [cucumber, courgette, crate], 0, 1, 2, 3),
        photo("b.jpg", "one", [cucumber, Label(SPOTS[5])], 0),
        photo("c.jpg", "two", [cucumber], 0, 4),
        photo("d.jpg", "three", [], 6),
    )
    settings = ("crate", "board", "board", "none")
    names = [frame.name for frame in frames]
    photos = photo_set(*zip(names, settings, ["loose fruit"] * 4, strict=True))
    return Evaluation(photos, Networks(None, None, None, 0.25), frames, missing=2)


def test_recall_and_precision_of_photos() -> None:
    found = scored()
    whole = found.score()
    # Four cucumbers, one missed; five judged detections, two of them on nothing.
    assert (whole.recall.value, whole.recall.count, whole.recall.groups) == (0.75, 4, 2)
    assert whole.precision is not None
    assert (whole.precision.value, whole.precision.count) == (0.6, 5)
    assert "4 photos of 3 scenes; 2 of the audit's" in photo_tables(found)[0].comment
    board, empty = (found.score(setting=name).precision for name in ("board", "none"))
    assert board is not None
    assert empty is not None
    assert (board.value, empty.value) == pytest.approx((2 / 3, 0.0))


class Reader:
    """A detector that boxes what is not grey."""

    task = "detect"
    looks = 1

    def detect(self, color_rgb: NDArray[np.uint8]) -> tuple[Instance, ...]:
        rows, columns = np.nonzero((color_rgb != 114).any(axis=2))
        edges = [columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5]
        return (Instance(np.array(edges), 0.9),)


def test_small_fruit_are_the_same_photos_at_half_size(tmp_path: Path) -> None:
    color = np.full((60, 80, 3), 114, np.uint8)
    color[20:30, 10:50] = 30
    write_png(tmp_path / "a.png", color)
    fruit = Label(np.array([9.5, 19.5, 49.5, 29.5]))
    data = photo_set(
        ("a.png", "plant", "on the plant"), ("a.png", "none", "negatives"), folder=tmp_path
    )
    data = replace(data, pictures=(replace(data.pictures[0], labels=(fruit,)), data.pictures[1]))
    found = evaluate_photos(data, Networks(Reader(), None, None, 0.3))  # type: ignore[arg-type]
    for small in (False, True):
        assert found.score(small=small, test="on the plant").recall.value == 1.0
        negatives = found.score(small=small, test="negatives").precision
        assert negatives is not None
        assert negatives.value == 0.0
    rows = [row[0] for row in photo_tables(found)[0].rows]
    assert rows == [
        "all",
        *("test: negatives", "test: on the plant"),
        *("half size: all", "half size: negatives", "half size: on the plant"),
        *("where: none", "where: plant"),
    ]


def test_ends_on_photos_are_judged_by_the_straight_line_between_them() -> None:
    line = np.linspace([10.0, 10.0], [110.0, 10.0], 5)
    true = Label(SPOTS[0], keypoints=np.column_stack([line, [2.0, 0, 0, 0, 2]]))
    points = np.column_stack([line + np.array([0.0, 3.0]), np.ones(5)])
    fruit = Label(SPOTS[0], score=0.9, keypoints=points)
    frame = Frame("a.jpg", "one", 300, 300, (true,), posed=(fruit,), kept=(fruit,))
    photos = photo_set(("a.jpg", "trial", "first audit"))
    found = Evaluation(photos, Networks(None, None, None, 0.25), (frame,))
    (row,) = end_rows(found.frames, 0.25).itertuples()
    assert (row.length_px, row.blossom_percent, row.stem_percent, row.swapped) == (
        100.0,
        3.0,
        3.0,
        False,
    )
    assert [r[0] for r in photo_tables(found)[1].rows] == ["all", "in sight", *ENDS]


@pytest.mark.realdata
def test_audited_photos(shared_data: Path) -> None:
    photos, missing = audited_photos(shared_data)
    assert missing == 0
    boxes = [label for picture in photos.pictures for label in photo_truth(picture, photos).true]
    assert sum(box.required for box in boxes) > 40
    assert any(box.optional for box in boxes)
    assert any(box.ignore for box in boxes)
    for split in ("train", "val"):
        others, _ = audited_photos(shared_data, split)
        assert not {p.scene for p in photos.pictures} & {p.scene for p in others.pictures}
