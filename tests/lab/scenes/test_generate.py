from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.capture.pictures import read_color, read_depth
from cucumbervision.errors import DataSetError
from cucumbervision.tube.shape import polyline_length
from cucumbervision_lab.data.coco import read_coco
from cucumbervision_lab.data.labels import DataSet
from cucumbervision_lab.scenes.generate import (
    Frame,
    FrameOptions,
    SynthOptions,
    draw_frame,
    extras_of,
    generate,
    parse_size,
)
from cucumbervision_lab.scenes.textures import load_assets

OPTIONS = SynthOptions(frames=4, seed=3, frame=FrameOptions(width=256, height=144))


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> DataSet:
    return generate(OPTIONS, tmp_path_factory.mktemp("set"))


def test_the_set_reads_back_with_pictures_depth_and_truth(drawn: DataSet) -> None:
    data = read_coco(drawn.folder)
    assert len(data.pictures) == 4
    labels = 0
    for picture in data.pictures:
        assert read_color(data.path(picture)).shape == (144, 256, 3)
        assert picture.depth_file is not None
        sensor = read_depth(data.folder / picture.depth_file) * picture.depth_unit_m
        exact = read_depth(data.folder / picture.depth_file.replace("depth", "exact")) * 1e-4
        assert picture.camera is not None
        for label in picture.labels:
            labels += 1
            mask, amodal = label.mask, label.amodal
            assert mask is not None
            assert amodal is not None
            assert not (mask & ~amodal).any()
            assert label.hidden_share == pytest.approx(1 - mask.sum() / amodal.sum(), abs=1e-4)
            near, far = np.percentile(exact[mask], [0, 100])
            axis = np.array(label.extras["axis_m"])
            assert near > axis[:, 2].min() - 0.03
            assert far < axis[:, 2].max() + 0.03
        assert sensor.shape == exact.shape == (144, 256)
        assert (sensor > 0).mean() > 0.5
    assert labels > 4


def test_an_interrupted_run_goes_on_and_gives_the_same(drawn: DataSet, tmp_path: Path) -> None:
    generate(SynthOptions(frames=2, seed=3, frame=OPTIONS.frame), tmp_path)
    frames = tmp_path / "frames.jsonl"
    frames.write_text(frames.read_text().splitlines(keepends=True)[0])
    (tmp_path / "annotations.json").unlink()
    seen: list[int] = []
    generate(OPTIONS, tmp_path, workers=2, progress=seen.append)
    assert seen == [1, 1, 1, 1]
    assert (tmp_path / "annotations.json").read_text() == (
        drawn.folder / "annotations.json"
    ).read_text()
    for name in ("images/000001.jpg", "depth/000003.png"):
        assert (tmp_path / name).read_bytes() == (drawn.folder / name).read_bytes()


def test_other_options_are_refused_in_a_begun_folder(drawn: DataSet) -> None:
    before = (drawn.folder / "annotations.json").read_bytes()
    with pytest.raises(DataSetError, match="other options"):
        generate(SynthOptions(frames=4, seed=4, frame=OPTIONS.frame), drawn.folder)
    assert (drawn.folder / "annotations.json").read_bytes() == before


def test_a_damaged_manifest_is_named(tmp_path: Path) -> None:
    (tmp_path / "synth.json").write_text("{")
    with pytest.raises(DataSetError, match=r"synth\.json"):
        generate(OPTIONS, tmp_path)


def test_words_without_meaning_are_refused() -> None:
    for size in ("1280", "8x8"):
        with pytest.raises(DataSetError, match="--size"):
            parse_size(size)
    with pytest.raises(DataSetError, match="--split"):
        SynthOptions(split="exam")


@pytest.mark.skipif(os.name != "posix", reason="groups of processes are POSIX")
def test_a_command_that_is_killed_leaves_no_process_behind(tmp_path: Path) -> None:
    program = "from cucumbervision.cli.app import main; main()"
    command = [sys.executable, "-c", program, "synth", "--out", str(tmp_path / "set")]
    options = ["--frames", "500", "--size", "96x64", "--no-depth", "--workers", "2"]
    running = subprocess.Popen([*command, *options], start_new_session=True)
    deadline = time.monotonic() + 60
    while not list((tmp_path / "set").glob("images/*.jpg")) and time.monotonic() < deadline:
        time.sleep(0.1)
    running.send_signal(signal.SIGTERM)
    running.wait(30)
    drawn = len(list((tmp_path / "set").glob("images/*.jpg")))
    assert 0 < drawn < 500
    while time.monotonic() < deadline:
        try:
            os.killpg(running.pid, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    os.killpg(running.pid, signal.SIGKILL)
    pytest.fail("workers were left")


SMALL = FrameOptions(width=320, height=180, depth=False)
SENSED = FrameOptions(width=320, height=180)
ASSETS = load_assets(None)


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return [draw_frame(5, index, SMALL, ASSETS) for index in range(4)]


def test_the_same_seed_draws_the_same_pixels(frames: list[Frame]) -> None:
    again = draw_frame(5, 2, SMALL, ASSETS)
    np.testing.assert_array_equal(again.color, frames[2].color)
    assert again.depth_m is None
    assert not np.array_equal(draw_frame(6, 2, SMALL, ASSETS).color, again.color)


def test_with_depth_the_colours_are_the_same(frames: list[Frame]) -> None:
    sensed = draw_frame(5, 3, SENSED, ASSETS)
    np.testing.assert_array_equal(sensed.color, frames[3].color)
    np.testing.assert_array_equal(draw_frame(5, 3, SENSED, ASSETS).depth_m, sensed.depth_m)


def test_the_sensor_reads_what_is_there_to_a_few_millimetres() -> None:
    # The sensor's windows are pixels of a D435's 1280 x 720: no smaller picture would do.
    frame = draw_frame(5, 2, FrameOptions(), ASSETS)
    assert frame.depth_m is not None
    errors, filled = [], []
    for truth in frame.truth:
        if truth.visible.sum() > 2000:
            seen = truth.visible & (frame.depth_m > 0)
            errors.append(np.median(frame.depth_m[seen] - frame.exact_m[seen]))
            filled.append(seen.sum() / truth.visible.sum())
    assert len(errors) >= 3
    assert np.median(np.abs(errors)) < 0.005
    assert np.median(filled) > 0.9


def test_extras_hold_the_axis_and_its_length(frames: list[Frame]) -> None:
    for frame in frames:
        for truth in frame.truth:
            extras = extras_of(truth)
            axis = np.array(extras["axis_m"])
            # 41 points of a gentle bend lose next to nothing of its length.
            assert polyline_length(axis) == pytest.approx(extras["centreline_m"], rel=2e-3)
            assert max(extras["radius_m"]) == pytest.approx(truth.radius_m.max(), rel=0.03)
            assert 0 <= extras["tilt_deg"] <= 90
            ends = frame.camera.project(axis[[0, -1]])
            np.testing.assert_allclose(ends, truth.keypoints_px[[0, 4]], atol=0.05)
