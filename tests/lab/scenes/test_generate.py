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
from cucumbervision_lab.data.coco import read_coco
from cucumbervision_lab.data.labels import DataSet
from cucumbervision_lab.scenes.generate import FrameOptions, SynthOptions, generate, parse_size

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
