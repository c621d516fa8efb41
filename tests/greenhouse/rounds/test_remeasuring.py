"""Stops measured again: what is new of them, and what people said that stays."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.capture.frames import Doubt
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import StoreError
from cucumbervision.measurement.flags import Flag
from cucumbervision.measurement.result import LengthDefinition, MethodName
from cucumbervision.pipeline.measurer import Measurer
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision_greenhouse.rounds.adding import add_captures
from cucumbervision_greenhouse.rounds.remeasuring import measure_round_again
from cucumbervision_greenhouse.rounds.stop_records import instance_of, stop_record, stored_capture
from cucumbervision_greenhouse.store.check import check_store
from cucumbervision_greenhouse.store.links import LinkKind
from cucumbervision_greenhouse.store.records import key_of
from cucumbervision_greenhouse.store.repository import Store
from cucumbervision_greenhouse.store.views import DetectionSummary, Verdict

MORNING = key_of("rounds", "morning")
OPTIONS = MeasureOptions(instances="dataset", methods=(MethodName.M3, MethodName.M6))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A capture of three fruit."""
    return Path(shutil.copytree(example_captures() / "simulated-row-a", tmp_path / "row-a"))


def change_camera(folder: Path, factor: float) -> None:
    """Correct the intrinsics: lengths across the picture change by one over the factor."""
    path = folder / "capture.json"
    manifest = json.loads(path.read_text())
    for name in ("fx", "fy"):
        manifest["camera"][name] *= factor
    path.write_text(json.dumps(manifest))


def fruit_of(store: Store) -> dict[str, DetectionSummary]:
    return {detection.key: detection for detection in store.detections(MORNING)}


def kind_of(view: DetectionSummary) -> str | None:
    return None if view.record.length is None else str(view.record.length.kind)


def chords_m(store: Store) -> list[float]:
    return [one.record.chord_m or 0.0 for one in fruit_of(store).values()]


def test_corrected_intrinsics_are_measured_again(store: Store, folder: Path) -> None:
    [first] = add_captures(store, MORNING, [folder], OPTIONS)
    before, wrong = fruit_of(store), chords_m(store)
    change_camera(folder, 0.97)
    [added] = add_captures(store, MORNING, [folder], OPTIONS)
    assert (added.remeasured, added.new, added.fruit, added.failure) == (True, False, 3, None)
    assert added.stop_key == first.stop_key
    assert fruit_of(store).keys() == before.keys()
    # Hanging fruit lie across the picture: x and y grow by 1 / 0.97, z stays.
    assert chords_m(store) == pytest.approx([one / 0.97 for one in wrong], rel=0.01)
    [stop] = store.stop(first.stop_key).captures
    manifest = json.loads((folder / "capture.json").read_text())
    assert stop.camera["fx"] == manifest["camera"]["fx"]
    # Nothing has changed since.
    [third] = add_captures(store, MORNING, [folder], OPTIONS)
    assert (third.remeasured, third.new) == (False, False)
    assert len(store.stops(MORNING)) == 1
    assert check_store(store).sound


def test_other_options_are_measured_again_and_what_has_no_part_is_not(
    store: Store, folder: Path
) -> None:
    add_captures(store, MORNING, [folder], OPTIONS)
    # No network looked at a data set's own masks.
    [added] = add_captures(store, MORNING, [folder], replace(OPTIONS, confidence=0.9))
    assert not added.remeasured
    chord = replace(OPTIONS, length=LengthDefinition.CHORD)
    [added] = add_captures(store, MORNING, [folder], chord)
    assert added.remeasured
    assert {kind_of(one) for one in fruit_of(store).values()} == {"chord"}


def test_what_people_said_stays(store: Store, folder: Path) -> None:
    [first] = add_captures(store, MORNING, [folder], OPTIONS)
    stop = store.stop(first.stop_key)
    records = {fruit.number: fruit for fruit in stop.captures[0].fruit}
    rejected, corrected, picked = fruit_of(store)
    number = fruit_of(store)[corrected].record.number
    store.signed("ana").set_verdict([rejected], Verdict.REJECTED)
    store.signed("ana").correct(corrected, records[number])
    store.signed("ana").pick([picked], at_s=5.0)
    added = store.signed("ana").add_fruit(first.stop_key, stop.captures[0].name, records[1])
    store.signed("ana").merge(corrected, picked)
    before = store.corrected(MORNING)[corrected].chord_m or 0.0
    # The data set lost a mask since: that fruit is measured with its old one.
    sorted((folder / "mask_visib").iterdir())[0].unlink()
    change_camera(folder, 0.97)
    [later] = add_captures(store, MORNING, [folder], OPTIONS)
    assert later.remeasured
    fruit = fruit_of(store)
    assert fruit.keys() == {rejected, corrected, picked, added}
    assert fruit[rejected].verdict is Verdict.REJECTED
    assert fruit[added].verdict is Verdict.ACCEPTED
    assert fruit[picked].picked_s == 5.0
    assert fruit[corrected].corrected
    assert store.corrected(MORNING)[corrected].chord_m == pytest.approx(before / 0.97, rel=0.01)
    [link] = [one for one in store.links(MORNING, LinkKind.SAME) if one.by_hand]
    assert {link.first, link.second} == {corrected, picked}
    numbers = [one.record.number for one in fruit.values()]
    assert len(set(numbers)) == 4
    # What was done by hand is undone as ever; that a stop was measured again is not.
    store.undo(MORNING)
    assert not [one for one in store.links(MORNING, LinkKind.SAME) if one.by_hand]
    log = store.log(MORNING)
    number = next(one.number for one in log if one.kind == "measure-again")
    with pytest.raises(StoreError, match="undo"):
        store.undo(number=number)


def test_a_stop_that_cannot_be_measured_again_stays_as_it_was(store: Store, folder: Path) -> None:
    add_captures(store, MORNING, [folder], OPTIONS)
    before = chords_m(store)
    lost = replace(OPTIONS, calibration=folder / "gone.json")
    [failed] = add_captures(store, MORNING, [folder], lost)
    assert failed.failure is not None
    assert "gone.json" in failed.failure.message
    assert chords_m(store) == before


def test_a_round_is_measured_again_from_what_it_keeps(store: Store, folder: Path) -> None:
    add_captures(store, MORNING, [folder], OPTIONS)
    keys, before = fruit_of(store).keys(), chords_m(store)
    shutil.rmtree(folder)
    chord = replace(OPTIONS, length=LengthDefinition.CHORD)
    steps: list[tuple[int, int]] = []
    done, failures = measure_round_again(store, MORNING, chord, lambda *step: steps.append(step))
    assert (done, failures, steps) == (1, [], [(1, 1)])
    fruit = fruit_of(store)
    assert fruit.keys() == keys
    assert {kind_of(one) for one in fruit.values()} == {"chord"}
    # The depth that is kept is rounded to a fraction of a millimetre.
    assert chords_m(store) == pytest.approx(before, rel=2e-3)
    assert np.isfinite([one.along_m for one in fruit.values()]).all()  # type: ignore[arg-type]


def stem_heights_m(store: Store) -> list[float]:
    """How far below the blossom end each fruit's stem end lies, in order along the row."""
    fruit = (one.record for one in fruit_of(store).values())
    return [(one.stem_y_m or 0.0) - (one.blossom_y_m or 0.0) for one in fruit]


def test_which_way_is_down_stays_known_when_a_stop_is_measured_again(
    store: Store, folder: Path
) -> None:
    """The pictures are turned: what lies lower in them hung higher."""
    path = folder / "capture.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"gravity": [0.0, -0.98, 0.199]}))
    [done] = add_captures(store, MORNING, [folder], OPTIONS)
    before = stem_heights_m(store)
    assert len(before) == 3
    assert min(before) > 0.1
    assert store.stop(done.stop_key).captures[0].gravity == (0.0, -0.98, 0.199)
    assert measure_round_again(store, MORNING, OPTIONS) == (1, [])
    assert stem_heights_m(store) == pytest.approx(before, abs=0.01)
    # How the camera was held is only a default: the capture's own gravity stands.
    measure_round_again(store, MORNING, replace(OPTIONS, camera_up="top"))
    assert stem_heights_m(store) == pytest.approx(before, abs=0.01)
    assert check_store(store).sound


def test_how_the_camera_was_held_can_be_said_anew(store: Store, folder: Path) -> None:
    [done] = add_captures(store, MORNING, [folder], replace(OPTIONS, camera_up="bottom"))
    assert min(stem_heights_m(store)) > 0.1
    measure_round_again(store, MORNING, OPTIONS)
    assert min(stem_heights_m(store)) > 0.1
    measure_round_again(store, MORNING, replace(OPTIONS, camera_up="top"))
    assert max(stem_heights_m(store)) < -0.1
    assert store.stop(done.stop_key).captures[0].gravity == (0.0, 1.0, 0.0)


def test_what_a_reader_found_doubtful_stays_said(store: Store) -> None:
    """Depth of fewer pixels than colour: measured again, and corrected by hand."""
    [capture] = [ref.load() for ref in open_source(example_captures() / "simulated-row-a")]
    coarse = replace(capture, doubts=(Doubt.DEPTH_RESAMPLED,))
    measurer = Measurer(OPTIONS)
    stop = stop_record(MORNING, [measurer.measure(coarse)], measurer, images=store.images)
    store.save_stop(stop)
    assert store.stop(stop.key) == stop
    assert measure_round_again(store, MORNING, OPTIONS) == (1, [])
    flags = [one.record.flags.split() for one in fruit_of(store).values()]
    assert [flag.count("depth-resampled") for flag in flags] == [1, 1, 1]
    [saved] = store.stop(stop.key).captures
    read = stored_capture(store.images, saved, stop)
    shape = (read.height, read.width)
    fruit = measurer.measure_instance(read, instance_of(saved.fruit[0], shape))
    assert Flag.DEPTH_RESAMPLED in fruit.flags
    assert check_store(store).sound
