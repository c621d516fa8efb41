from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from cucumbervision.errors import TrainingError
from cucumbervision_lab.training.plan import RunState, parse_plan
from cucumbervision_lab.training.settings import (
    TrainOptions,
    choose_device,
    one_to_many_at,
    rate_at,
    trainer_settings,
)

OUT = Path("run")


def state(task: str = "seg", epochs: int = 0) -> RunState:
    """A run of two parts: three epochs at 640 pixels, then one at 896."""
    plan = parse_plan("640x24,896x8", 8)
    return RunState(task, "data.yaml", "yolo26n-seg.yaml", plan, epochs=epochs, seed=5)


def test_what_falls_over_the_plan() -> None:
    assert [rate_at(t) for t in (0.0, 1.0)] == pytest.approx([1.0, 0.05])
    assert [one_to_many_at(t, 0.3) for t in (0.0, 0.5, 1.0)] == pytest.approx([0.3, 0.2, 0.1])
    # A network that already gives it less keeps that.
    assert one_to_many_at(1.0, 0.05) == pytest.approx(0.05)


def test_batch_and_frozen_layers_follow_the_device_unless_they_are_given() -> None:
    usual, own = TrainOptions(freeze=-1), TrainOptions(batch=3, freeze=2)
    assert [usual.batch_on(device) for device in ("cpu", "0")] == [8, 64]
    assert [usual.frozen_on(device) for device in ("cpu", "0")] == [6, 0]
    assert [own.batch_on(device) for device in ("cpu", "0")] == [3, 3]
    assert [own.frozen_on(device) for device in ("cpu", "0")] == [2, 2]


@pytest.mark.parametrize(("batch", "rate"), [(0, 0.002), (2, 0.002), (8, 0.002), (32, 0.004)])
def test_the_rate_grows_with_the_root_of_the_batch(batch: int, rate: float) -> None:
    options = TrainOptions(batch=batch, learning_rate=0.002)
    settings = trainer_settings(state(), "yolo26n-seg.yaml", OUT, options, "cpu")
    assert settings["lr0"] == pytest.approx(rate)
    # Eight pictures are one step even where a batch is smaller.
    assert settings["nbs"] == max(8, batch)


def test_a_run_goes_on_at_the_size_and_seed_of_its_epoch() -> None:
    options = TrainOptions()
    made = [
        trainer_settings(state(epochs=n), "yolo26n-seg.yaml", OUT, options, "cpu")
        for n in (0, 2, 3)
    ]
    assert [one["imgsz"] for one in made] == [640, 640, 896]
    assert [one["seed"] for one in made] == [5, 7, 8]
    assert {one["epochs"] for one in made} == {4}
    assert (made[0]["model"], made[0]["pretrained"]) == ("yolo26n-seg.yaml", False)


def test_fruit_with_points_are_neither_turned_nor_upside_down() -> None:
    seg, pose = (
        trainer_settings(state(task), "yolo26n-pose.yaml", OUT, TrainOptions(), "cpu")
        for task in ("seg", "pose")
    )
    assert (seg["degrees"], seg["flipud"], seg["fliplr"]) == (45.0, 0.5, 0.5)
    assert (pose["degrees"], pose["flipud"], pose["fliplr"]) == (0.0, 0.0, 0.5)


@pytest.mark.train
def test_weights_that_are_none_are_named(tmp_path: Path) -> None:
    if importlib.util.find_spec("ultralytics") is None:
        pytest.skip("needs the extra 'train'")
    bad = tmp_path / "bad.pt"
    bad.write_bytes(b"no weights")
    with pytest.raises(TrainingError, match=r"bad\.pt: .*cannot load the weights"):
        trainer_settings(state(), str(bad), OUT, TrainOptions(), "cpu")
    assert [choose_device(name) for name in ("cpu", "1")] == ["cpu", "1"]
