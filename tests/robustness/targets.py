"""Every reader of files: what a valid input is, and how far it is read."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tests.robustness import seeds

from cucumbervision.errors import CucumberVisionError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping


@dataclass(frozen=True)
class Target:
    """One way by which files enter.

    Parameters
    ----------
    name : str
        What tables call it.
    seed : callable
        Writes valid files into an empty folder.
    read : callable
        Reads a folder as its commands do, up to the first use of what was read. Also takes the
        path of the file in it that was damaged: what does not read that one is left out. Of an
        empty path everything is read.
    weight : int
        Its share of the inputs: what is read quickly gets more, and the slowest one 1.
    whole : bool
        Whether the valid files are read to the end; a network that is no detector is refused late.
    """

    name: str
    seed: Callable[[Path], None]
    read: Callable[[Path, str], None]
    weight: int
    whole: bool = True


def _each(reads: Iterable[Callable[[], object]]) -> None:
    """Run every read; the last named error is raised when all of them were tried."""
    fault = None
    for read in reads:
        try:
            read()
        except CucumberVisionError as error:
            fault = error
    if fault is not None:
        raise fault


def _those_of(reads: Mapping[str, Callable[[], object]], name: str) -> None:
    """Run the reads whose keys a damaged file's path begins with; all where it names none."""
    _each([reads[key] for key in reads if name.startswith(key)] or reads.values())


def _captures(path: Path, **options: Any) -> None:
    from cucumbervision.capture.readers import ReadOptions, open_source

    _each(ref.load for ref in open_source(path, ReadOptions(**options)))


def _capture_folders(folder: Path, name: str) -> None:
    """Read the one of several folders, or files, that was damaged."""
    inside = {p.name: partial(_captures, p) for p in sorted(folder.iterdir())}
    _those_of(inside, name.partition("/")[0])


def _scene(folder: Path, _name: str) -> None:
    _captures(folder)


def _viewer(folder: Path, _name: str) -> None:
    _captures(folder / "s", intrinsics=folder / "camera.json")


def _camera_files(folder: Path, name: str) -> None:
    from cucumbervision.capture.camera_file import read_camera_file
    from cucumbervision.capture.readers.common import choose_intrinsics

    def read(path: Path) -> None:
        choose_intrinsics(None, read_camera_file(path), 64, 48, source=path)

    _those_of({p.name: partial(read, p) for p in sorted(folder.iterdir())}, name)


def _instances(*names: str) -> Callable[[Path, str], None]:
    def read_one(path: Path) -> None:
        from cucumbervision.instances.instance_files import read_instances

        read_instances(path).for_capture(["a.png"], 64, 48, frame=1)

    def read(folder: Path, damaged: str) -> None:
        _those_of({name: partial(read_one, folder / name) for name in names}, damaged)

    return read


def _truth(folder: Path, name: str) -> None:
    from cucumbervision.accuracy.truth import floor_of, read_truth

    def read(path: Path) -> None:
        floor_of(read_truth(path).lengths)

    _those_of({p.name: partial(read, p) for p in sorted(folder.glob("*.csv"))}, name)


def _poses(folder: Path, name: str) -> None:
    from cucumbervision_greenhouse.rounds.poses import read_poses

    _those_of({one: partial(read_poses, folder / one) for one in ("poses.csv", "poses.json")}, name)


def _run(folder: Path, name: str) -> None:
    from cucumbervision.accuracy.measured import read_measured
    from cucumbervision.accuracy.own_truth import match_truth
    from cucumbervision.accuracy.truth import read_truth
    from cucumbervision.calibration.site_calibration import calibrate_lengths

    def calibrate() -> None:
        measured, true = (
            read_measured(folder / "measurements.json"),
            read_truth(folder / "true.csv"),
        )
        match_truth(measured, true)
        calibrate_lengths(measured, true, "x")

    reads = {"measurements.csv": partial(read_measured, folder / "measurements.csv")}
    _those_of({**reads, "measurements.json": calibrate, "true.csv": calibrate}, name)


def _calibration(folder: Path, _name: str) -> None:
    from cucumbervision.calibration.calibration_file import read_site_calibration

    site = read_site_calibration(folder / "site.json")
    site.camera.difference(seeds.CAMERA, "841512")
    _ = site.tag, site.depth_divisor


def _store(folder: Path, _name: str) -> None:
    from cucumbervision_greenhouse.store.check import check_store
    from cucumbervision_greenhouse.store.repository import open_store

    with open_store(folder / "house.db", images=folder / "pictures", create=False) as store:
        for one in store.rounds():
            _read_round(store, one.key)
        check_store(store)


def _read_round(store: Any, key: str) -> None:
    from cucumbervision_greenhouse.rounds.from_store import read_round
    from cucumbervision_greenhouse.rounds.fruit_table import fruit_table

    for stop in store.stops(key):
        for capture in store.stop(stop.key).captures:
            for ref, read in (
                (capture.color, store.images.read_color),
                (capture.depth, store.images.read_depth),
            ):
                if ref is not None:
                    read(ref)
    for fruit in store.detections(key):
        store.detection(fruit.key)
    for joint in store.joint(key):
        store.joint_drawing(key, joint)
    store.measurements(key), store.cameras(key), store.links(key), store.log(key)
    fruit_table(read_round(store, key))


def _network(folder: Path, _name: str) -> None:
    import numpy as np

    from cucumbervision.perception.runtime import open_network

    network = open_network(folder / "net.onnx", "onnxruntime")
    network.run({"images": np.ones((1, 3, 8, 8), np.float32)})


def _detector(folder: Path, _name: str) -> None:
    import numpy as np

    from cucumbervision.errors import InstancesError
    from cucumbervision.instances.instance import in_picture
    from cucumbervision.perception.yolo import YoloDetector

    color = np.full((48, 64, 3), 128, np.uint8)
    for instance in YoloDetector(folder / "detector.onnx", "onnxruntime").detect(color):
        try:
            in_picture(instance, 64, 48)
        except InstancesError as error:
            raise AssertionError("a detector gave a fruit that no picture holds") from error


def _registry(folder: Path, _name: str) -> None:
    from cucumbervision.perception.registry import load_registry

    registry = load_registry(user=folder)
    registry.default("segment")
    registry.state("own")


def _judgement(folder: Path, _name: str) -> None:
    from cucumbervision.perception.own_networks import use_network
    from cucumbervision.perception.registry import load_registry

    with tempfile.TemporaryDirectory(dir=folder) as user:
        use_network(folder, registry=load_registry(user=Path(user)))


def _settings(folder: Path, _name: str) -> None:
    from cucumbervision_greenhouse.backend.settings import read_settings

    settings = read_settings(folder / "house.settings.json")
    _ = settings.units, settings.rates, settings.options


def _published(folder: Path, name: str) -> None:
    from cucumbervision.agronomy.profiles import load_profile
    from cucumbervision.measurement.intervals import read_interval_models
    from cucumbervision.perception.registry import load_registry
    from cucumbervision_lab.detection.photo_audit import read_audit
    from cucumbervision_lab.training.recipe import read_recipe

    reads: dict[str, Callable[..., object]] = {
        "long-cucumber.toml": load_profile,
        "models.toml": partial(load_registry, user=folder / "none"),
        "interval_models.json": read_interval_models,
        "recipe.toml": read_recipe,
        "audit.json": lambda path: read_audit([path]),
    }
    _those_of({one: partial(read, folder / one) for one, read in reads.items()}, name)


def _data_set(folder: Path, _name: str) -> None:
    from cucumbervision_lab.datasets.checks import check_folder
    from cucumbervision_lab.datasets.coco import collect_fragments

    if (folder / "fragments").is_dir():
        collect_fragments(folder)
    data, _ = check_folder(folder, duplicates=False)
    for picture in data.pictures:
        for label in picture.labels:
            _ = label.mask, label.amodal


def _records(folder: Path, _name: str) -> None:
    from cucumbervision_lab.benchmark.records import read_records, readings_frame

    if found := read_records([folder / "records.jsonl"]):
        readings_frame(found)


def _training(folder: Path, _name: str) -> None:
    from cucumbervision_lab.training.plan import RunState

    state = RunState.load(folder)
    _ = state.pictures, state.is_done, state.plan.text


def _card(folder: Path, _name: str) -> None:
    from cucumbervision_lab.training.publish import card_markdown, read_card

    card_markdown(read_card(folder / "cucumber-look.json"))


def _uploads(folder: Path, name: str) -> None:
    from cucumbervision.intake.uploads import accept_uploads

    files = sorted(p for p in folder.iterdir() if p.is_file())
    alone = [p for p in files if p.suffix in (".zip", ".npz")]
    if (folder / name) in alone:
        files = [folder / name]
    elif name:  # a picture pair goes together
        files = [p for p in files if p not in alone]
    out = folder / "in"
    try:
        got = accept_uploads([(p.name, p) for p in files], out)
        faults = [*got.refused]
        for source in got.sources:
            for ref in source.open():
                try:
                    ref.load()
                except CucumberVisionError as error:
                    faults.append(error)
        if faults:
            raise faults[0]
    finally:
        shutil.rmtree(out, ignore_errors=True)


def _recording(folder: Path, _name: str) -> None:
    _captures(folder / "walk.db3")


def _crop_pack(folder: Path, _name: str) -> None:
    from cucumbervision.pipeline.crop_pack import read_pack
    from cucumbervision.pipeline.options import MeasureOptions

    read_pack(folder).options(MeasureOptions())


def _queue(folder: Path, _name: str) -> None:
    from cucumbervision_greenhouse.backend.uploads import Uploads
    from cucumbervision_greenhouse.store.waiting import WaitingCaptures

    waiting, uploads = WaitingCaptures(folder / "house.waiting"), Uploads(folder / "uploads")
    uploads.to_measure()
    for upload in uploads.all():
        uploads.files(upload.sending.key)
    waiting.set_aside()
    _each(capture.load for capture in waiting.captures())


def _journal(folder: Path, _name: str) -> None:
    from cucumbervision.pipeline.folder import Journal, OutputFolder

    with Journal(OutputFolder(folder)) as journal:
        places = [key.hex() for key in journal._index]
        for record in journal.records(places):
            _ = record.rows


def _hand_lengths(folder: Path, _name: str) -> None:
    from cucumbervision_greenhouse.backend.hand_lengths import hand_lengths
    from cucumbervision_greenhouse.store.records import DetectionRecord
    from cucumbervision_greenhouse.store.views import DetectionSummary

    fruit = [
        DetectionSummary(
            *(f"k{n}", "s", "r", "a", "3", "left", 2, 1e9, False, 0.4, 0.04, None),
            record=DetectionRecord(n),
        )
        for n in (1, 2)
    ]
    hand_lengths(folder / "round.csv", fruit)


TARGETS: tuple[Target, ...] = (
    Target("native captures", seeds.native, _capture_folders, 150),
    Target("BOP scenes", seeds.bop, _scene, 150),
    Target("picture pairs, arrays", seeds.pairs, _capture_folders, 100),
    Target("Viewer exports", seeds.viewer, _viewer, 100),
    Target("camera files", seeds.camera_file, _camera_files, 400),
    Target("COCO instances", seeds.coco, _instances("coco.json", "results.json"), 200),
    Target("YOLO labels", seeds.yolo, _instances("", "a.txt"), 150),
    Target("truth tables", seeds.truth, _truth, 400),
    Target("poses", seeds.poses, _poses, 450),
    Target("runs", seeds.run, _run, 200),
    Target("calibration", seeds.calibration, _calibration, 450),
    Target("store files", seeds.store, _store, 25),
    Target("ONNX", seeds.network, _network, 300),
    Target("detectors", seeds.detector, _detector, 50),
    Target("own networks", seeds.own_networks, _registry, 100),
    Target("judged networks", seeds.judgement, _judgement, 100, whole=False),
    Target("settings", seeds.settings, _settings, 450),
    Target("profiles, registry, audit", seeds.published, _published, 100),
    Target("COCO data sets", seeds.coco_set, _data_set, 100),
    Target("YOLO data sets", seeds.yolo_set, _data_set, 100),
    Target("benchmark records", seeds.records, _records, 100),
    Target("trainings", seeds.training, _training, 400),
    Target("model cards", seeds.model_card, _card, 450),
    Target("uploads", seeds.uploads, _uploads, 100),
    Target("recordings", seeds.recording, _recording, 1),
    Target("labelled sets", seeds.labelled_set, _scene, 100),
    Target("crop packs", seeds.crop_pack, _crop_pack, 150),
    Target("presses and uploads", seeds.queue, _queue, 150),
    Target("journals", seeds.journal, _journal, 200),
    Target("lengths by hand", seeds.hand_lengths, _hand_lengths, 300),
)
