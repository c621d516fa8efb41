"""Real trainings by the trainer: what is learnt, how, and in which precision."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from pathlib import Path

import pytest

if importlib.util.find_spec("ultralytics") is None:
    pytest.skip("needs the extra 'train'", allow_module_level=True)

from tests.lab.training.conftest import QUICK, Notes

from cucumbervision_lab.training.checkpoint import import_ultralytics
from cucumbervision_lab.training.data import prepare_data
from cucumbervision_lab.training.plan import RunState, parse_plan
from cucumbervision_lab.training.settings import TrainOptions, trainer_settings
from cucumbervision_lab.training.train import NETWORK, train
from cucumbervision_lab.training.trainer import TrainerSettings, make_trainer

pytestmark = pytest.mark.train


class Deaf:
    def batch(self, done: int, total: int) -> None:
        pass

    def epoch(self, number: int, metrics: Mapping[str, float], seconds: float) -> None:
        pass


def backbone(network: object) -> dict[str, object]:
    state = network.state_dict()  # type: ignore[attr-defined]
    return {key: value for key, value in state.items() if not key.startswith("model.23.")}


def test_pose_begins_with_the_layers_of_seg(seg_run: Path, pose_set: Path, tmp_path: Path) -> None:
    import_ultralytics()
    import torch
    from ultralytics.nn.tasks import load_checkpoint

    data = prepare_data(pose_set, "pose", tmp_path)
    init = str(seg_run / NETWORK)
    state = RunState("pose", str(data), init, parse_plan("64x8", 8))
    settings = trainer_settings(state, init, tmp_path, QUICK, "cpu")
    assert (settings["model"], settings["pretrained"]) == ("yolo26n-pose.yaml", init)
    course = TrainerSettings(state.plan)
    trainer = make_trainer("pose", settings, Deaf(), course, threads=1, bfloat16=False)
    trainer.setup_model()
    ours, theirs = backbone(trainer.model), backbone(load_checkpoint(init)[0].float())
    assert ours.keys() == theirs.keys()
    assert len(ours) > 300
    assert all(torch.equal(ours[key], theirs[key]) for key in ours)
    # The boxes' branch of the head too; the points' own is new.
    head = trainer.model.model[-1]
    taken = load_checkpoint(init)[0].float().model[-1]
    assert torch.equal(head.cv2[0][0].conv.weight, taken.cv2[0][0].conv.weight)


def test_points_are_learnt_kindly_and_judged_strictly(pose_set: Path, tmp_path: Path) -> None:
    import_ultralytics()
    data = prepare_data(pose_set, "pose", tmp_path)
    plan = parse_plan("64x8,96x8", 8)
    state = RunState("pose", str(data), "yolo26n-pose.yaml", plan)
    settings = trainer_settings(state, state.init, tmp_path, QUICK, "cpu")
    course = TrainerSettings(plan, by_place=True)
    trainer = make_trainer("pose", settings, Deaf(), course, threads=1, bfloat16=True)
    seen = {}

    def look(t: object) -> None:
        loss = t.model.criterion  # type: ignore[attr-defined]
        seen["loss"] = loss.one2one.keypoint_loss.sigmas.tolist()
        seen["share"] = [loss.o2m, loss.o2o]
        seen["narrowed"] = ["predict" in vars(t.model)]  # type: ignore[attr-defined]

    trainer.add_callback("on_train_batch_end", look)
    trainer.train()
    # Kindly at the plan's beginning, strictly in validation.
    assert seen["loss"] == pytest.approx([0.2] * 5)
    assert trainer.validator.sigma.tolist() == pytest.approx([0.05] * 5)
    assert seen["share"] == pytest.approx([0.8, 0.2])
    assert seen["narrowed"] == [True]
    assert "predict" not in vars(trainer.model)
    assert trainer.validator.end2end
    assert 0 < trainer.metrics["val/pose_loss"] < 1e4


def test_small_batches_leave_the_norms(seg_run: Path, seg_set: Path, tmp_path: Path) -> None:
    import_ultralytics()
    import torch
    from ultralytics.nn.tasks import load_checkpoint

    init = seg_run / NETWORK
    options = TrainOptions(**{**vars(QUICK), "batch": 3})
    train(
        "seg", seg_set, tmp_path / "run", init=str(init), plan="64x8", per_epoch=8, options=options
    )
    before, after = (
        load_checkpoint(str(path))[0].float().state_dict()
        for path in (init, tmp_path / "run" / NETWORK)
    )
    means = [key for key in before if key.endswith("running_mean")]
    assert len(means) > 100
    assert all(torch.equal(before[key], after[key]) for key in means)
    assert not torch.equal(before["model.0.conv.weight"], after["model.0.conv.weight"])


def test_bfloat16_learns_as_float32_does(seg_set: Path, tmp_path: Path) -> None:
    losses = {}
    for precision in ("f32", "bf16"):
        notes = Notes()
        options = TrainOptions(**{**vars(QUICK), "precision": precision, "learning_rate": 0.002})
        train(
            "seg",
            seg_set,
            tmp_path / precision,
            init="yolo26n-seg.yaml",
            plan="64x24",
            per_epoch=8,
            options=options,
            callbacks=notes,
        )
        losses[precision] = [
            sum(v for k, v in r.metrics.items() if k.startswith("train/")) for r in notes.epochs
        ]
    # Rounding grows with every step, and differs from one processor to another.
    assert losses["bf16"][0] == pytest.approx(losses["f32"][0], rel=0.1)
    assert losses["bf16"] == pytest.approx(losses["f32"], rel=0.3)
    assert losses["bf16"] != losses["f32"]
