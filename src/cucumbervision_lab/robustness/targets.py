"""Every reader of files: what a valid input is, and how far it is read."""

from __future__ import annotations

import shutil
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cucumbervision.errors import CucumberVisionError
from cucumbervision_lab.robustness import seeds

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable


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
        Reads a folder as its commands do, up to the first use of what was read.
    weight : int
        How many inputs it gets for one of the slowest.
    whole : bool
        Whether the valid files are read to the end; a network that is no detector is refused late.
    """

    name: str
    seed: Callable[[Path], None]
    read: Callable[[Path], None]
    weight: int = 100
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


def _captures(path: Path, **options: Any) -> None:
    from cucumbervision.capture.readers import ReadOptions, open_source

    _each(ref.load for ref in open_source(path, ReadOptions(**options)))


def _pairs(folder: Path) -> None:
    whole = folder / "whole.npz"
    _each((lambda: _captures(folder), lambda: _captures(whole)))


def _viewer(folder: Path) -> None:
    _captures(folder / "s", intrinsics=folder / "camera.json")


def _camera_files(folder: Path) -> None:
    from cucumbervision.capture.camera_file import read_camera_file
    from cucumbervision.capture.intrinsics import check_intrinsics

    def read(path: Path) -> None:
        check_intrinsics(read_camera_file(path).intrinsics, 64, 48, source=path)

    _each(lambda p=p: read(p) for p in sorted(folder.glob("*.json")))  # type: ignore[misc]


def _instances(*names: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        from cucumbervision.perception.instance_files import read_instances

        _each(
            lambda name=name: read_instances(folder / name).for_capture(["a.png"], 64, 48, frame=1)  # type: ignore[misc]
            for name in names
        )

    return read


def _truth(folder: Path) -> None:
    from cucumbervision.accuracy.truth import floor_of, read_bar_rows, read_truth

    def read(path: Path) -> None:
        floor_of(read_truth(path).lengths)
        read_bar_rows(path)

    _each(lambda p=p: read(p) for p in sorted(folder.glob("*.csv")))  # type: ignore[misc]


def _poses(folder: Path) -> None:
    from cucumbervision.rounds.poses import read_poses

    _each((lambda: read_poses(folder / "poses.csv"), lambda: read_poses(folder / "poses.json")))


def _run(folder: Path) -> None:
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

    _each((lambda: read_measured(folder / "measurements.csv"), calibrate))


def _calibration(folder: Path) -> None:
    from cucumbervision.calibration.calibration_file import read_site_calibration

    site = read_site_calibration(folder / "site.json")
    site.camera.difference(seeds.CAMERA, "841512")
    _ = site.tag, site.depth_divisor


def _store(folder: Path) -> None:
    from cucumbervision.store.images import check_store
    from cucumbervision.store.repository import open_store

    with open_store(folder / "house.db", images=folder / "pictures", create=False) as store:
        for one in store.rounds():
            _read_round(store, one.key)
        check_store(store)


def _read_round(store: Any, key: str) -> None:
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
    store.measurements(key), store.cameras(key), store.links(key), store.log(key)


def _network(folder: Path) -> None:
    import numpy as np

    from cucumbervision.perception.runtime import open_network

    network = open_network(folder / "net.onnx", "onnxruntime", threads=1)
    network.run({"images": np.ones((1, 3, 8, 8), np.float32)})


def _registry(folder: Path) -> None:
    from cucumbervision.perception.registry import load_registry

    registry = load_registry(user=folder)
    registry.default("segment")
    registry.state("own")


def _judgement(folder: Path) -> None:
    from cucumbervision.perception.in_use import use_network
    from cucumbervision.perception.registry import load_registry

    with tempfile.TemporaryDirectory(dir=folder) as user:
        use_network(folder, registry=load_registry(user=Path(user)))


def _settings(folder: Path) -> None:
    from cucumbervision.dashboard.access import read_accounts, read_openid_connect
    from cucumbervision.dashboard.settings import read_settings

    def units() -> None:
        found = read_settings(folder / "house.settings.json")
        _ = found.units, found.rates, found.options

    accounts, secrets = folder / "accounts.txt", folder / "secrets.toml"
    with suppress(OSError):
        accounts.chmod(0o600)
    _each((units, lambda: read_accounts(accounts), lambda: read_openid_connect((secrets,))))


def _published(folder: Path) -> None:
    from cucumbervision.agronomy.profiles import load_profile
    from cucumbervision.measurement.intervals import read_interval_models
    from cucumbervision.perception.registry import load_registry
    from cucumbervision_lab.detection.photo_audit import read_audit
    from cucumbervision_lab.training.recipe import read_recipe

    _each(
        (
            lambda: load_profile(folder / "long-cucumber.toml"),
            lambda: load_registry(folder / "models.toml", folder / "none"),
            lambda: read_interval_models(folder / "interval_models.json"),
            lambda: read_recipe(folder / "recipe.toml"),
            lambda: read_audit([folder / "audit.json"]),
        )
    )


def _data_set(folder: Path) -> None:
    from cucumbervision_lab.datasets.card import dataset_card
    from cucumbervision_lab.datasets.checks import check_folder
    from cucumbervision_lab.datasets.coco import collect_fragments

    if (folder / "fragments").is_dir():
        collect_fragments(folder)
    data, _ = check_folder(folder, duplicates=False)
    for picture in data.pictures:
        for label in picture.labels:
            _ = label.mask, label.amodal
    dataset_card(data)


def _records(folder: Path) -> None:
    from cucumbervision.accuracy.records import read_records, readings_frame

    if found := read_records([folder / "records.jsonl"]):
        readings_frame(found)


def _training(folder: Path) -> None:
    from cucumbervision_lab.training.plan import RunState

    state = RunState.load(folder)
    _ = state.pictures, state.is_done, state.plan.text


def _card(folder: Path) -> None:
    from cucumbervision_lab.training.publish import card_markdown, read_card

    card_markdown(read_card(folder / "cucumber-ends.json"))


def _uploads(folder: Path) -> None:
    from cucumbervision.intake.uploads import accept_uploads

    files = sorted(p for p in folder.iterdir() if p.is_file())
    out = folder / "in"
    try:
        got = accept_uploads([(p.name, p) for p in files], out)
        faults = [one.error for one in got.refused]
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


def _recording(folder: Path) -> None:
    from cucumbervision.intake.recordings import open_guarded

    _each(ref.load for ref in open_guarded(folder / "walk.db3"))


TARGETS: tuple[Target, ...] = (
    Target("native captures", seeds.native, _captures),
    Target("BOP scenes", seeds.bop, _captures),
    Target("picture pairs, arrays", seeds.pairs, _pairs),
    Target("Viewer exports", seeds.viewer, _viewer),
    Target("camera files", seeds.camera_file, _camera_files, 200),
    Target("COCO instances", seeds.coco, _instances("coco.json", "results.json"), 200),
    Target("YOLO labels", seeds.yolo, _instances("", "a.txt"), 200),
    Target("truth tables", seeds.truth, _truth, 200),
    Target("poses", seeds.poses, _poses, 200),
    Target("runs", seeds.run, _run, 50),
    Target("calibration", seeds.calibration, _calibration, 200),
    Target("store files", seeds.store, _store, 3),
    Target("ONNX", seeds.network, _network, 100),
    Target("own networks", seeds.own_networks, _registry, 100),
    Target("judged networks", seeds.judgement, _judgement, 50, whole=False),
    Target("settings, accounts", seeds.settings, _settings, 100),
    Target("profiles, registry, audit", seeds.published, _published, 50),
    Target("COCO data sets", seeds.coco_set, _data_set, 50),
    Target("YOLO data sets", seeds.yolo_set, _data_set, 50),
    Target("benchmark records", seeds.records, _records, 50),
    Target("trainings", seeds.training, _training, 100),
    Target("model cards", seeds.model_card, _card, 100),
    Target("uploads", seeds.uploads, _uploads, 15),
    Target("recordings", seeds.recording, _recording, 1),
)
