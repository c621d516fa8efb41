from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from cucumbervision.capture.source import example_captures
from cucumbervision.errors import DiskFullError, StoreAwayError
from cucumbervision.perception.registry import load_registry
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision_greenhouse.backend.measuring import SharedMeasurer
from cucumbervision_greenhouse.backend.progress import progress_of
from cucumbervision_greenhouse.backend.uploading import CAMERAS, measure_upload
from cucumbervision_greenhouse.backend.uploads import (
    Sending,
    SentFile,
    SentPlace,
    Upload,
    UploadOutcome,
    Uploads,
)
from cucumbervision_greenhouse.rounds.demonstration import DEMONSTRATION
from cucumbervision_greenhouse.store.records import DetectionRecord, Round, key_of
from cucumbervision_greenhouse.store.repository import Store

OPTIONS = MeasureOptions(instances="dataset")
ROUND = Round(key_of("uploads"))
PLACE = SentPlace(row="7", side="right", position_m=3.0, step_m=0.5, back=True)


@pytest.fixture(scope="module")
def measurer() -> SharedMeasurer:
    return SharedMeasurer(load_registry())


def kind_of(record: DetectionRecord) -> str | None:
    return None if record.length is None else str(record.length.kind)


Measure = Callable[..., tuple[UploadOutcome, ...]]


@pytest.fixture
def measured(store: Store, measurer: SharedMeasurer, tmp_path: Path) -> Measure:
    """Send files into the round, measure them, and return their outcomes."""
    store.save_round(ROUND)
    uploads = Uploads(tmp_path / "uploads")

    def measure(
        files: list[tuple[str, io.BytesIO]],
        options: MeasureOptions = OPTIONS,
        camera: str = "",
    ) -> tuple[UploadOutcome, ...]:
        listed = tuple(SentFile(name=name, size=len(f.getvalue())) for name, f in files)
        sending = Sending(round=ROUND.key, files=listed, place=PLACE, camera=camera)
        uploads.begin(sending, 10**9)
        for number, (_, content) in enumerate(files):
            uploads.append(sending.key, number, 0, content.getvalue())
        assert uploads.to_measure() == [sending.key]
        measure_upload(uploads, sending.key, measurer, store, options)
        assert uploads.to_measure() == []
        return uploads.all()[0].outcomes

    return measure


def pair(number: int) -> list[tuple[str, io.BytesIO]]:
    """Return a colour and a depth picture without intrinsics: a wall at 0.6 m."""
    return [
        (
            f"{part}_{number}.png",
            io.BytesIO(cv2.imencode(".png", np.full((48, 64), value, dtype))[1].tobytes()),
        )
        for part, value, dtype in (("color", 200 + number, np.uint8), ("depth", 600, np.uint16))
    ]


def packed() -> io.BytesIO:
    """Return a zip of two drawn captures without a position of their own."""
    file, folder = io.BytesIO(), example_captures() / "simulated-row-a"
    with zipfile.ZipFile(file, "w") as archive:
        for name in ("a", "b"):
            for path in sorted(p for p in folder.rglob("*") if p.is_file()):
                data = path.read_bytes()
                if path.name == "capture.json":
                    manifest = json.loads(data)
                    manifest["stop"] = {}
                    data = json.dumps(manifest).encode()
                archive.writestr(f"{name}/{path.relative_to(folder)}", data)
    file.seek(0)
    return file


def test_one_bad_file_costs_only_itself_and_each_is_told_by_its_name(
    store: Store, measured: Measure
) -> None:
    files = [("odd.png", io.BytesIO(b"MZ")), *pair(1), ("row.zip", packed())]
    told = measured(files)
    assert sum(one.saved for one in told) == 2
    lost = [one for one in told if not one.saved]
    assert [one.name for one in lost] == ["odd.png", "upload"]
    assert "has no matching picture" in lost[0].words
    assert "intrinsics" in lost[1].words
    # Drawn: in the demonstration, from the given place on, backwards.
    assert store.stops(ROUND.key) == []
    places = [(s.row, s.side, s.position_m, s.step) for s in store.stops(DEMONSTRATION)]
    assert places == [("7", "right", 3.0, 1), ("7", "right", 2.5, 2)]
    again = measured([("row.zip", packed())])
    assert [one.words for one in again] == ["is in the round already"] * 2
    store.delete_stop(store.stops(DEMONSTRATION)[0].key)
    again = measured([("row.zip", packed())])
    assert [(one.saved, one.words) for one in again] == [
        (False, "was deleted: undo that to have it back"),
        (False, "is in the round already"),
    ]


def test_an_upload_is_counted_in_captures_and_not_in_files(
    store: Store, measured: Measure, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    write = Uploads._write

    def heard(uploads: Uploads, upload: Upload) -> None:
        write(uploads, upload)
        said.append(progress_of(ROUND.key, (), uploads=[upload]).words)

    monkeypatch.setattr(Uploads, "_write", heard)
    measured([("odd.png", io.BytesIO(b"MZ")), ("row.zip", packed())])
    # It is announced, begun, and opened; then its two captures; then it is done.
    counted = ["Measuring: 0 of 2 captures", "Measuring: 1 of 2 captures"]
    assert said[:-2] == ["Checking 2 files", "Checking 2 files", *counted]


def test_one_camera_takes_a_place_once(store: Store, measured: Measure) -> None:
    camera = next(iter(CAMERAS))
    for number, words in (
        (1, "row 7, right, 3.00 m"),
        (2, "stop 1 is at 3.00 m of that row and side"),
    ):
        (told,) = measured(pair(number), camera=camera)
        assert words in told.words
        assert told.saved == (number == 1)
    assert len(store.stops(ROUND.key)) == 1


def test_a_camera_s_usual_figures_stand_for_intrinsics_that_are_missing(
    store: Store, measured: Measure
) -> None:
    camera = next(iter(CAMERAS))
    told = measured(pair(1), camera=camera)
    assert [one.saved for one in told] == [True]
    (stop,) = store.stops(ROUND.key)
    assert (stop.row, stop.position_m) == ("7", 3.0)
    taken = store.stop(stop.key).captures[0].camera
    assert taken["fx"] == pytest.approx(CAMERAS[camera] * 48)


def test_files_stay_while_the_disk_is_full_or_the_store_away(
    store: Store, measurer: SharedMeasurer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store.save_round(ROUND)
    uploads, content = Uploads(tmp_path / "uploads"), packed().getvalue()
    file = SentFile(name="row.zip", size=len(content))
    sending = Sending(round=ROUND.key, files=(file,), place=PLACE)
    uploads.begin(sending, 10**9)
    uploads.append(sending.key, 0, 0, content)

    def full(*_: object) -> None:
        raise DiskFullError("cannot be kept (No space left on device)", source="row.zip")

    def locked(*_: object) -> None:
        raise StoreAwayError("database is locked")

    with monkeypatch.context() as patch:
        patch.setattr(Store, "save_stop", locked)
        for _ in range(4):
            measure_upload(uploads, sending.key, measurer, store, OPTIONS)
        patch.setattr(Store, "save_stop", full)
        for _ in range(4):
            measure_upload(uploads, sending.key, measurer, store, OPTIONS)
        patch.setattr("cucumbervision.intake.uploads.write_chunk", full)
        for _ in range(4):
            measure_upload(uploads, sending.key, measurer, store, OPTIONS)
    [upload] = uploads.all()
    assert (upload.done, upload.tries) == (False, 0)
    assert "No space left on device" in upload.outcomes[0].words
    measure_upload(uploads, sending.key, measurer, store, OPTIONS)
    assert [outcome.saved for outcome in uploads.all()[0].outcomes] == [True, True]


def test_files_stay_while_nothing_can_be_measured(
    store: Store, measurer: SharedMeasurer, tmp_path: Path
) -> None:
    store.save_round(ROUND)
    uploads = Uploads(tmp_path / "uploads")
    sending = Sending(round=ROUND.key, files=(SentFile(name="row.zip", size=3),), place=PLACE)
    uploads.begin(sending, 10**9)
    uploads.append(sending.key, 0, 0, b"PK.")
    lost = replace(OPTIONS, instances=str(tmp_path / "lost.json"))
    measure_upload(uploads, sending.key, measurer, store, lost)
    (outcome,) = uploads.all()[0].outcomes
    assert not outcome.saved
    assert "lost.json" in outcome.words
    assert uploads.to_measure() == [sending.key]
