"""One tube in several views of a drawn row, through the store."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.greenhouse.rounds.conftest import MORNING as ROUND
from tests.greenhouse.rounds.test_adding import CAMERA, FRUIT, MORNING, OPTIONS, draw

from cucumbervision.calibration.calibration_file import (
    CalibratedCamera,
    DepthScaleEntry,
    MeasuredWith,
    SiteCalibration,
)
from cucumbervision.instances.mask_codes import decode_rle
from cucumbervision.measurement.result import Choice
from cucumbervision.measurement.views import measure_views
from cucumbervision_greenhouse.rounds.adding import add_captures
from cucumbervision_greenhouse.rounds.from_store import joint_groups, read_round
from cucumbervision_greenhouse.rounds.fruit_table import fruit_table
from cucumbervision_greenhouse.rounds.joint_lengths import measure_jointly
from cucumbervision_greenhouse.rounds.merge_and_link import merge_round
from cucumbervision_greenhouse.store.repository import Store, open_store

STOPS = (0, 1, 2)


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a store of a row of which three stops of one aisle were measured and merged."""
    folder = tmp_path_factory.mktemp("walked")
    for number in STOPS:
        draw("left", number, folder / "walk")
    with open_store(folder / "house.db") as store:
        store.save_round(ROUND)
        add_captures(store, MORNING, [folder / "walk"], OPTIONS)
        merge_round(store, MORNING)
    return folder


@pytest.fixture
def merged(walked: Path, tmp_path: Path) -> Iterator[Store]:
    """A copy of that store."""
    copy = shutil.copytree(walked, tmp_path / "copy")
    with open_store(copy / "house.db") as store:
        yield store


def test_joint_tube_is_used_for_fruit_that_several_stops_show(merged: Store) -> None:
    before = {one.view.key: one for one in fruit_table(read_round(merged, MORNING))}
    told: list[tuple[int, int]] = []
    measured = measure_jointly(merged, MORNING, lambda *numbers: told.append(numbers)).fruit
    content = read_round(merged, MORNING)
    assert measured == len(joint_groups(content)) == len(content.joint) >= 3
    assert told == [(k, measured) for k in range(1, measured + 1)]
    table = fruit_table(content)
    joint = [line for line in table if line.joint is not None]
    assert len(joint) >= 3
    truth = {round(along, 1): length for along, _, _, length, _ in FRUIT}
    for line in joint:
        assert line.view.along_m is not None
        record, alone = line.view.record, before[line.view.key].view.record
        assert record.reason == Choice.SEVERAL_VIEWS
        nearest = min(truth, key=lambda at_m: abs(at_m - (line.view.along_m or 0.0)))
        assert record.centreline_m == pytest.approx(truth[nearest], rel=0.03)
        assert record.length is not None
        assert record.length.sides is not None
        assert record.length.sides[0] == record.length_m  # the interval is about it
        # What is the view's own stays so.
        assert (record.number, record.score) == (alone.number, alone.score)


def test_what_is_measured_is_not_measured_again_until_a_view_changes(merged: Store) -> None:
    several = measure_jointly(merged, MORNING).fruit
    assert measure_jointly(merged, MORNING).fruit == 0
    views = next(iter(joint_groups(read_round(merged, MORNING)).values()))
    detail = merged.detection(views[0].key)
    mask = decode_rle(detail.view.record.mask or "", CAMERA.height, CAMERA.width)
    assert mask.any()
    length = detail.view.record.length
    assert length is not None
    length = replace(length, value_m=0.9 * length.value_m)
    shorter = replace(detail.view.record, length=length)
    merged.correct(views[0].key, shorter)
    assert measure_jointly(merged, MORNING).fruit == 1
    content = read_round(merged, MORNING)
    assert len(content.joint) == several  # the old one is gone
    merged.unmerge(views[0].key)
    merge_round(merged, MORNING)
    assert measure_jointly(merged, MORNING).fruit <= 1


def test_the_tube_is_kept_with_the_cameras_that_saw_it(merged: Store) -> None:
    measure_jointly(merged, MORNING)
    content = read_round(merged, MORNING)
    line = next(line for line in fruit_table(content) if line.joint is not None)
    assert line.joint is not None
    drawing = merged.joint_drawing(MORNING, line.joint.key)
    assert drawing.record is not None
    path = np.array(drawing.record.methods[0].path_m)
    assert len(path) > 20
    assert drawing.record.methods[0].diameter_m
    assert len(drawing.poses) == drawing.views >= 2
    # Laid into every view, the axis lies in that view's mask.
    for key, numbers in drawing.poses.items():
        pose = np.reshape(numbers, (4, 4))
        u, v = CAMERA.project(path @ pose[:3, :3].T + pose[:3, 3]).round().astype(int).T
        mask = decode_rle(merged.detection(key).view.record.mask or "", CAMERA.height, CAMERA.width)
        # Ends may lie a pixel outside, and the picture may cut a view.
        inside = (u >= 0) & (v >= 0) & (u < CAMERA.width) & (v < CAMERA.height)
        assert mask[v[inside], u[inside]].mean() > 0.9


def test_without_pictures_lengths_stay_those_of_the_views(merged: Store) -> None:
    content = read_round(merged, MORNING)
    pooled = [(one.view.key, one.view.record.length) for one in fruit_table(content)]
    for path in merged.images.folder.rglob("*.png"):
        path.unlink()
    assert measure_jointly(merged, MORNING).fruit == len(joint_groups(content))
    after = read_round(merged, MORNING)
    assert {one.reason for one in after.joint.values()} == {"no-picture"}
    assert [(one.view.key, one.view.record.length) for one in fruit_table(after)] == pooled


def test_one_that_fails_loses_nothing_of_the_rest(
    merged: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = 0

    def once(*views: Any, **options: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == 1:
            raise MemoryError
        return measure_views(*views, **options)

    monkeypatch.setattr("cucumbervision_greenhouse.rounds.joint_lengths.measure_views", once)
    done = measure_jointly(merged, MORNING)
    [failure] = done.failures
    assert failure.error == "OutOfMemoryError"
    assert len(read_round(merged, MORNING).joint) == done.fruit - 1
    assert measure_jointly(merged, MORNING).fruit == 1  # the next time it is measured
    assert len(read_round(merged, MORNING).joint) == done.fruit


def test_a_calibration_holds_for_all_views_together(store: Store, tmp_path: Path) -> None:
    run = MeasuredWith(
        software="x", config_sha256="", selector="best", methods=["M6"], instances="dataset"
    )
    scale = DepthScaleEntry(
        value=1.02,
        standard_error=0.001,
        spread=0.002,
        captures=5,
        spacing_m=0.01,
    )
    site = SiteCalibration(
        name="house",
        created="2026-05-02T10:00:00+00:00",
        software="x",
        camera=CalibratedCamera.of(CAMERA),
        measured_with=run,
        depth_scale=scale,
    )
    (tmp_path / "site.json").write_text(site.as_text())
    for number in STOPS:
        draw("left", number, tmp_path / "walk")
    options = replace(OPTIONS, calibration=tmp_path / "site.json")
    add_captures(store, MORNING, [tmp_path / "walk"], options)
    merge_round(store, MORNING)
    measure_jointly(store, MORNING)
    lines = [one for one in fruit_table(read_round(store, MORNING)) if one.joint is not None]
    assert lines
    for line in lines:
        nearest = min(FRUIT, key=lambda one: abs(one[0] - (line.view.along_m or 0.0)))
        assert line.view.record.centreline_m == pytest.approx(nearest[3] / 1.02, rel=0.03)


def test_what_comes_first_stops_it_and_nothing_is_done_twice(merged: Store) -> None:
    asked = iter([False, True])
    assert measure_jointly(merged, MORNING, interrupted=lambda: next(asked)).fruit == 1
    content = read_round(merged, MORNING)
    assert len(content.joint) == 1
    assert measure_jointly(merged, MORNING).fruit == len(joint_groups(content)) - 1
