"""Real trainings of a network with random weights on eight little pictures."""

from __future__ import annotations

import csv
import importlib.util
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

if importlib.util.find_spec("ultralytics") is None:
    pytest.skip("needs the extra 'train'", allow_module_level=True)

from tests.lab.training.conftest import QUICK, Notes, StopAfterEpoch

from cucumbervision.errors import ModelError, TrainingError
from cucumbervision.perception.runtime import open_network
from cucumbervision.perception.yolo_layout import SIZES_KEY
from cucumbervision_lab.training.checkpoint import import_ultralytics, read_rows, stored_run_state
from cucumbervision_lab.training.export import export_trained, last_metrics
from cucumbervision_lab.training.plan import RunState
from cucumbervision_lab.training.settings import rate_at
from cucumbervision_lab.training.train import NETWORK, EpochReport, train

pytestmark = pytest.mark.train


def rows(run: Path) -> list[tuple[int, int]]:
    return [(int(row["pictures"]), int(row["size_px"])) for row in read_rows(run / "metrics.csv")]


def test_parts_of_a_plan_follow_each_other(seg_run: Path) -> None:
    assert rows(seg_run) == [(8, 64), (16, 64), (24, 96)]
    state = RunState.load(seg_run)
    assert (state.pictures, state.is_done, state.plan.text) == (24, True, "64x16,96x8")
    assert (seg_run / "weights/last.pt").is_file()
    assert (seg_run / NETWORK).stat().st_size < 7e6  # stripped of its optimiser
    assert list(seg_run.rglob("*.part")) == []
    place = stored_run_state(seg_run / NETWORK)
    assert place is not None
    assert (place["epochs"], place["init"]) == (3, "yolo26n-seg.yaml")
    assert Path(place["data"]).name == place["data"]  # no path of this machine


def test_a_run_keeps_how_it_learns(seg_run: Path) -> None:
    assert RunState.load(seg_run).learning == {
        "learning_rate": 0.001,
        "one_to_many": 0.8,
    }
    used = (seg_run / "args.yaml").read_text().splitlines()
    # The second call came with another learning rate, and with another batch.
    for line in ("batch: 2", "imgsz: 96", "lr0: 0.001", "optimizer: AdamW", "nms: false"):
        assert line in used


def test_a_finished_plan_has_nothing_to_do(seg_run: Path) -> None:
    before = (seg_run / "metrics.csv").read_bytes()
    assert train("seg", None, seg_run, resume=True, options=QUICK) == seg_run / NETWORK
    assert (seg_run / "metrics.csv").read_bytes() == before


def test_killed_training_goes_on_where_it_was(seg_set: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    words = ["train", "network", "seg", str(seg_set), "--out", str(run)]
    words += ["--init", "yolo26n-seg.yaml"]
    words += ["--plan", "64x320,96x8", "--per-epoch", "8", "--batch", "4"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", "from cucumbervision.cli.app import main; main()", *words]
    with subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL) as process:
        try:
            end = time.monotonic() + 240
            # The second epoch's row: the first epoch's checkpoint is whole by then.
            while not (run / "metrics.csv").is_file() or len(rows(run)) < 2:
                assert process.poll() is None
                assert time.monotonic() < end
                time.sleep(0.05)
        finally:
            process.send_signal(signal.SIGKILL)
    done = rows(run)[-1][0]
    notes = StopAfterEpoch()
    with pytest.raises(KeyboardInterrupt):
        train("seg", None, run, resume=True, options=QUICK, callbacks=notes)
    # The row follows the checkpoint: a kill between the two leaves an epoch without its row.
    assert [r.pictures for r in notes.epochs] in ([done + 8], [done + 16])
    assert notes.epochs[0].of == 328
    assert not RunState.load(run).is_done


def test_another_machine_goes_on_in_the_same_plan(seg_set: Path, tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    begin = partial(train, init="yolo26n-seg.yaml", plan="64x24", per_epoch=8, options=QUICK)
    with pytest.raises(KeyboardInterrupt):
        begin("seg", seg_set, here, callbacks=StopAfterEpoch())
    assert RunState.load(here).pictures == 8
    seen: list[tuple[float, float, float]] = []

    class Looks(Notes):
        def epoch(self, report: EpochReport) -> None:
            super().epoch(report)
            seen.append((report.pictures, rate(there), report.of))

    def rate(run: Path) -> float:
        with (run / "results.csv").open() as file:
            return float(list(csv.DictReader(file, skipinitialspace=True))[-1]["lr/pg0"])

    train("seg", seg_set, there, init=str(here / NETWORK), options=QUICK, callbacks=Looks())
    # It went on at the second epoch of three; the rate has fallen as if nothing had been between,
    # but for the first steps of an optimiser that remembers nothing: 2 of 100 there, then 4.
    assert [(pictures, of) for pictures, _, of in seen] == [(16, 24), (24, 24)]
    expected = [0.001 * rate_at(1 / 3) * 0.02, 0.001 * rate_at(2 / 3) * 0.04]
    assert [one for _, one, _ in seen] == pytest.approx(expected, rel=1e-3)


def test_what_cannot_be_trained_is_named(seg_set: Path, seg_run: Path, tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="already contains a training run"):
        train("seg", seg_set, seg_run)
    with pytest.raises(TrainingError, match="is a training run for seg, not pose"):
        train("pose", None, seg_run, resume=True)
    with pytest.raises(TrainingError, match="no data set given"):
        train("seg", None, tmp_path / "new")
    with pytest.raises(TrainingError, match=r"gone\.pt: weights not found"):
        train("seg", seg_set, tmp_path / "new", init=str(tmp_path / "gone.pt"))
    with pytest.raises(TrainingError, match="unknown task"):
        train("detect", seg_set, tmp_path / "new")
    bad = tmp_path / "bad.pt"
    bad.write_bytes(b"none")
    with pytest.raises(TrainingError, match=r"bad\.pt: cannot load the weights"):
        train("seg", seg_set, tmp_path / "new", init=str(bad), plan="64x8")


@pytest.mark.parametrize("runtime", ["onnxruntime", "openvino"])
def test_exported_file_computes_as_the_network(
    runtime: str, seg_run: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    pytest.importorskip(runtime)
    import numpy as np

    ultralytics = import_ultralytics()
    import torch

    out = tmp_path_factory.mktemp("out")
    card = export_trained(seg_run, out, "tiny-seg")
    network = open_network(out / card.file, runtime, full_precision=True)
    model = ultralytics.YOLO(str(seg_run / NETWORK)).model.float().eval()
    model.end2end = True
    head = model.model[-1]
    head.postprocess = lambda rows: rows  # all anchors, as corners
    for height, width in ((64, 96), (96, 64), (160, 160)):
        picture = np.random.default_rng(height).random((1, 3, height, width), np.float32)
        with torch.no_grad():
            rows, masks = model(torch.from_numpy(picture))[0]
        given = network.run({"images": picture})
        found = given["output0"][0]
        low, high = rows[0, :, :2].T.numpy(), rows[0, :, 2:4].T.numpy()
        # Weights are stored in half precision after batch norm was folded into them.
        assert np.abs(found[:2] - (low + high) / 2).max() < 0.5
        assert np.abs(found[2:4] - (high - low)).max() < 0.5
        assert np.abs(found[4] - rows[0, :, 4].numpy()).max() < 0.005
        assert np.abs(given["output1"] - masks.numpy()).max() < 0.05


def test_card_tells_of_the_run(seg_run: Path, tmp_path: Path) -> None:
    judged = tmp_path / "judged.json"
    judged.write_text('{"command": "evaluate", "recall": 0.9}')
    card = export_trained(seg_run, tmp_path, "tiny-seg", evaluation=judged, credits=["Photos: A"])
    assert card.plan == "24 of 64x16,96x8 pictures in 0.0 h"
    assert open_network(tmp_path / card.file, "onnxruntime").metadata[SIZES_KEY] == "640,896"
    assert card.began_with == "yolo26n-seg.yaml"
    assert card.metrics["size_px"] == 96
    assert card.metrics["mAP50(M)"] == last_metrics(seg_run / "metrics.csv")["mAP50(M)"]
    page = (tmp_path / "tiny-seg.md").read_text()
    for word in ("AGPL-3.0", "Photos: A", card.sha256, "--plan 64x16,96x8", '"recall": 0.9'):
        assert word in page
    assert "## Trained on" in page
    assert "| not stated | not stated | 8 | 8 | 8 |" in page
    assert str(seg_run) not in page
    assert str(tmp_path) not in page


def test_what_cannot_be_exported_is_named(seg_run: Path, tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="invalid model name"):
        export_trained(seg_run, tmp_path, "Tiny Seg")
    with pytest.raises(TrainingError, match="no epoch has completed yet"):
        export_trained(tmp_path, tmp_path, "tiny")
    (tmp_path / "bad.pt").write_bytes(b"none")
    with pytest.raises((TrainingError, ModelError), match=r"bad\.pt: cannot load the weights"):
        export_trained(tmp_path / "bad.pt", tmp_path, "tiny")
