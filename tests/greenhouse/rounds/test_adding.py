"""Captures that are really drawn, measured and saved: then merged over stops and aisles."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers.native import write_native
from cucumbervision.methods.result import MethodName
from cucumbervision.run.options import MeasureOptions
from cucumbervision_greenhouse.rounds.adding import Added, Place, add_captures
from cucumbervision_greenhouse.rounds.fruit_table import fruit_table, read_round
from cucumbervision_greenhouse.rounds.merge_and_link import merge_round
from cucumbervision_greenhouse.rounds.poses import PoseLine
from cucumbervision_greenhouse.store.records import key_of
from cucumbervision_greenhouse.store.repository import Store
from cucumbervision_lab.scenes.bodies import arc_tube, rotation
from cucumbervision_lab.scenes.depth_camera import D4xx, sense
from cucumbervision_lab.scenes.scene import Kind, Scene, render

CAMERA = Intrinsics(424, 240, 308.2, 308.1, 212.1, 119.8)
MORNING = key_of("rounds", "morning")
OPTIONS = MeasureOptions(instances="dataset", methods=(MethodName.M3, MethodName.M6))
ACROSS_M = 1.4
# Along, up, from the left aisle's cameras; length and radius: metres.
FRUIT = (
    (0.05, 0.02, 0.66, 0.20, 0.020),
    (0.22, -0.03, 0.72, 0.13, 0.017),
    (0.38, 0.04, 0.70, 0.24, 0.022),
    (0.52, -0.02, 0.68, 0.16, 0.018),
    (0.71, 0.01, 0.74, 0.21, 0.021),
)
TRUE = {"left": (0.10, 0.40, 0.70), "right": (0.25, 0.55)}
SAID = {"left": (0.13, 0.38, 0.71), "right": (0.23, 0.57)}


def draw(side: str, number: int, folder: Path) -> Path:
    """Write one capture of the row; masks are the fruit's, left to right in the picture."""
    sign = 1.0 if side == "left" else -1.0
    tubes = []
    for along, up, depth, length, radius in FRUIT:
        away = depth if side == "left" else ACROSS_M - depth
        at = (sign * (along - TRUE[side][number]), -up, away)
        tubes.append(arc_tube(length, radius, 3.0, neck=0.2).moved(rotation(-90.0), at))
    scene = Scene.of(*tubes, backdrop_m=0.95)
    exact = render(scene, CAMERA)
    rng = np.random.default_rng([number, len(side)])
    [depth_m] = sense(scene, D4xx.like(CAMERA), rng, 1)
    color = np.where((exact.kind == Kind.FRUIT)[..., None], [60, 120, 50], [90, 90, 80]).astype(
        np.uint8
    )
    color = np.clip(color + rng.normal(0, 3, color.shape), 0, 255).astype(np.uint8)
    masks = tuple(m for k in range(len(FRUIT)) if (m := exact.mask(k)).sum() > 400)
    place = Stop("3", side, SAID[side][number], number)
    name = f"{side}-{number}"
    capture = Capture(color, depth_m, CAMERA, name, masks=masks, stop=place, simulated=True)
    write_native(capture, folder / name)
    return folder / name


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with all captures of the row."""
    for side, places in TRUE.items():
        for number in range(len(places)):
            draw(side, number, tmp_path / "walk")
    return tmp_path / "walk"


def test_drawn_captures_become_each_fruit_once(store: Store, folder: Path) -> None:
    added = add_captures(store, MORNING, [folder], OPTIONS)
    assert [one.failure for one in added] == [None] * 5
    assert all(one.new for one in added)
    assert merge_round(store, MORNING) == {"3": []}
    table = fruit_table(read_round(store, MORNING))
    assert len(table) == len(FRUIT)
    for line, (along, _, _, length, _) in zip(table, FRUIT, strict=True):
        assert line.along_m == pytest.approx(along, abs=0.03)
        assert line.centreline_m == pytest.approx(length, rel=0.05)
        assert line.views >= 3

    # The same captures again are neither measured nor saved.
    again = add_captures(store, MORNING, [folder], OPTIONS)
    assert [one.stop_key for one in again] == [one.stop_key for one in added]
    assert not any(one.new for one in again)
    assert len(store.stops(MORNING)) == 5


def test_a_deleted_capture_is_told_and_not_measured_again(store: Store, tmp_path: Path) -> None:
    path = draw("left", 0, tmp_path)
    [first] = add_captures(store, MORNING, [path], OPTIONS)
    store.delete_stop(first.stop_key)
    [again] = add_captures(store, MORNING, [path], OPTIONS)
    assert (again.deleted, again.new, again.fruit) == (True, False, 0)
    assert again.stop_key == first.stop_key
    assert store.stops(MORNING) == []


def test_one_bad_input_loses_nothing_of_the_rest(store: Store, tmp_path: Path) -> None:
    good = draw("left", 0, tmp_path)
    seen: list[Added] = []
    nowhere = tmp_path / "nowhere"
    done = add_captures(store, MORNING, [nowhere, good], OPTIONS, report=seen.append)
    assert done[0].failure is not None
    assert "nowhere" in done[0].failure.message
    assert done[1].new
    assert seen == done


def test_place_and_poses_come_before_the_files(store: Store, tmp_path: Path) -> None:
    paths = [draw("left", number, tmp_path) for number in (0, 1)]
    line = PoseLine(capture="left-1", position_m=7.5, position_sd_m=0.01, height_m=1.3)
    place = Place(row="9", position_m=2.0, spacing_m=0.5)
    add_captures(store, MORNING, paths[:1], OPTIONS, place)
    add_captures(store, MORNING, paths[1:], OPTIONS, Place(poses={"left-1": line}))
    first, second = store.stops(MORNING)
    assert (first.row, first.position_m, first.position_sd_m) == ("9", 2.0, 0.03)
    assert (second.row, second.position_m, second.position_sd_m) == ("3", 7.5, 0.01)
    pose = np.array(store.stop(second.key).pose).reshape(4, 4)
    assert pose[:3, 3].tolist() == [7.5, 1.3, 0.0]
    at = [v.along_m for v in store.detections(MORNING) if v.stop_key == second.key]
    # Measured from the camera's true place, 0.40 m.
    expected = [7.5 + along - 0.40 for along, *_ in FRUIT]
    assert sorted(a for a in at if a is not None) == pytest.approx(expected, abs=0.02)


def test_one_camera_takes_a_place_once_and_another_on_its_mast_too(
    store: Store, tmp_path: Path
) -> None:
    first, second, third = (draw("left", number, tmp_path / "low") for number in range(3))
    place = Place(row="9", position_m=2.0, spacing_m=0.5)
    assert add_captures(store, MORNING, [first], OPTIONS, place)[0].new
    slip, next_one = add_captures(store, MORNING, [second, third], OPTIONS, place)
    assert slip.failure is not None
    assert slip.failure.capture == "left-1"
    assert "stop 0 is at 2.00 m of that row and side" in slip.failure.message
    assert next_one.new
    # Of another height, or through another lens, it is another camera's.
    line = PoseLine(capture="left-1", position_m=2.0, height_m=1.3)
    [higher] = add_captures(store, MORNING, [second], OPTIONS, Place("9", poses={"left-1": line}))
    manifest = tmp_path / "low" / "left-1" / "capture.json"
    other = json.loads(manifest.read_text())
    other["name"], other["camera"]["fx"] = "other", other["camera"]["fx"] + 0.7
    manifest.write_text(json.dumps(other))
    [lens] = add_captures(store, MORNING, [second], OPTIONS, place)
    assert (higher.new, lens.new) == (True, True)
    # In the order in which their files were written.
    assert [stop.position_m for stop in store.stops(MORNING)] == [2.0, 2.0, 2.5, 2.0]


def test_a_capture_without_its_pose_is_refused(store: Store, tmp_path: Path) -> None:
    line = PoseLine(capture="another", position_m=1.0)
    path = draw("left", 0, tmp_path)
    [done] = add_captures(store, MORNING, [path], OPTIONS, Place(poses={"another": line}))
    assert done.failure is not None
    assert "left-0: the pose file has no line for this capture" in done.failure.message
    assert store.stops(MORNING) == []
