"""Ultralytics' trainer with what is ours: progress, safe files, bfloat16, stages that go on.

Nothing of Ultralytics is forked: one subclass of its trainer, and its callbacks.
"""

from __future__ import annotations

import time
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from cucumbervision.perception.yolo import BY_PLACE
from cucumbervision_lab.training.assigner import assign_coarsely
from cucumbervision_lab.training.half_precision import channels_last, narrow, widen
from cucumbervision_lab.training.points import (
    learn_to_assign,
    learn_to_see,
    order_by_place,
    set_tolerance,
    tolerance_at,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["Watcher", "make_trainer", "strip"]

_OUTSIDE = ("clearml", "comet", "dvc", "mlflow", "neptune", "raytune", "tensorboard", "wandb")
_O2M_FIRST, _O2M_LAST = 0.8, 0.1  # Ultralytics' E2ELoss: share of the one-to-many head


class Watcher(Protocol):
    """Who is told how a training goes on."""

    def batch(self, done: int, total: int) -> None:
        """Tell that `done` of an epoch's `total` batches are through."""

    def epoch(self, number: int, metrics: Mapping[str, float], seconds: float) -> bool:
        """Tell what an epoch, counted from 1, came to. True ends the training after it."""


def make_trainer(
    task: str,
    overrides: dict[str, Any],
    watcher: Watcher,
    *,
    threads: int,
    workers: int,
    bfloat16: bool,
    span: tuple[float, float],
    still_norms: bool = False,
    strict: bool = False,
    by_place: bool = False,
) -> Any:
    """Build the trainer of one stage.

    Parameters
    ----------
    task : str
        'segment' or 'pose'.
    overrides : dict
        Ultralytics' own settings.
    watcher : Watcher
        Is told of every batch and epoch.
    threads, workers : int
        Threads of torch, and processes that load pictures.
    bfloat16 : bool
        Run the network's layers in bfloat16 on the CPU.
    span : tuple of float
        Where in the whole plan the stage begins and ends, 0 to 1: the one-to-many head's share
        of the loss falls over the plan, not anew in every stage.
    still_norms : bool
        Keep the statistics of batch norm as they are; for very small batches.
    strict : bool
        Judge points by the final tolerance from the beginning.
    by_place : bool
        Learn points in the order in which they lie in the picture.

    Returns
    -------
    ultralytics.engine.trainer.BaseTrainer
        Ready for `train()`.
    """
    from ultralytics.models.yolo.pose import PoseTrainer
    from ultralytics.models.yolo.segment import SegmentationTrainer
    from ultralytics.utils import SETTINGS

    for name in _OUTSIDE:
        dict.__setitem__(SETTINGS, name, False)
    base: Any = {"segment": SegmentationTrainer, "pose": PoseTrainer}[task]

    class Training(_Ours, base):  # type: ignore[misc]
        """Named without 'Trainer', so that Ultralytics ties no outside services to it."""

    trainer = Training(overrides=overrides)
    trainer.still_norms = still_norms
    trainer.by_place = by_place
    if by_place:
        trainer.add_callback("on_train_start", _say_by_place)
    # Ultralytics allows the CPU one thread less than it has, and no loading beside it.
    trainer.args.workers = workers
    _listen(trainer, watcher, threads)
    trainer.add_callback("on_train_start", lambda t: _share_of_heads(t, span))
    if task == "pose":
        trainer.add_callback("on_train_start", lambda t: learn_to_assign(t.model))
        trainer.add_callback("on_train_start", lambda t: learn_to_see(t.model))
        trainer.add_callback(
            "on_train_epoch_start", lambda t: _be_stricter(t, (1, 1) if strict else span)
        )
    if overrides["device"] == "cpu":
        trainer.add_callback("on_train_start", lambda t: channels_last(t.model))
        if task == "segment":
            trainer.add_callback("on_train_start", lambda t: assign_coarsely(t.model))
    if bfloat16:
        trainer.add_callback("on_train_epoch_start", lambda t: narrow(t.model))
        trainer.add_callback("on_train_epoch_end", lambda t: widen(t.model))
    return trainer


class _Ours:
    """What the trainer does otherwise: its files are replaced whole, never half written."""

    model: Any
    still_norms: bool
    by_place: bool
    wdir: Path
    last: Path
    best: Path

    def _model_train(self) -> None:
        super()._model_train()  # type: ignore[misc]
        if self.still_norms:
            import torch

            for module in self.model.modules():
                if isinstance(module, torch.nn.BatchNorm2d):
                    module.eval()

    def preprocess_batch(self, batch: dict[str, Any]) -> dict[str, Any]:
        """Bring a batch to the device, points in the order to be learnt."""
        ready: dict[str, Any] = super().preprocess_batch(batch)  # type: ignore[misc]
        return _ordered(ready) if self.by_place else ready

    def get_validator(self) -> Any:
        """Judge points in the order that was learnt."""
        validator = super().get_validator()  # type: ignore[misc]
        if self.by_place:
            prepare = validator.preprocess
            validator.preprocess = lambda batch: _ordered(prepare(batch))
        return validator

    def get_dataloader(self, *args: Any, **kwargs: Any) -> Any:
        """Load the pictures without Ultralytics' own bar on the standard output."""
        with redirect_stdout(StringIO()):
            return super().get_dataloader(*args, **kwargs)  # type: ignore[misc]

    def save_model(self) -> bool:
        """Write `last.pt` and `best.pt`."""
        last, best = self.last, self.best
        self.last, self.best = self.wdir / "last.part", self.wdir / "best.part"
        try:
            saved = bool(super().save_model())  # type: ignore[misc]
            # The best first: a kill between the two repeats an epoch and loses nothing.
            for part, path in ((self.best, best), (self.last, last)):
                if part.exists():
                    part.replace(path)
        finally:
            self.last, self.best = last, best
        return saved

    def final_eval(self) -> None:
        """Leave out the validation of an epoch that was validated already."""


def _ordered(batch: dict[str, Any]) -> dict[str, Any]:
    height, width = batch["img"].shape[2:]
    return batch | {"keypoints": order_by_place(batch["keypoints"], width, height)}


def _say_by_place(trainer: Any) -> None:
    # Exports tell it to whoever uses the points.
    for network in (trainer.model, trainer.ema.ema):
        network.keypoint_order = BY_PLACE


def _listen(trainer: Any, watcher: Watcher, threads: int) -> None:
    began = 0.0
    done = 0

    def start(_: Any) -> None:
        import torch

        torch.set_num_threads(threads)

    def epoch_start(_: Any) -> None:
        nonlocal began, done
        began, done = time.monotonic(), 0

    def batch_end(t: Any) -> None:
        nonlocal done
        done += 1
        watcher.batch(done, len(t.train_loader))

    def epoch_end(t: Any) -> None:
        rows = {**t.label_loss_items(t.tloss), **t.metrics, "fitness": t.fitness}
        numbers = {key: float(value) for key, value in rows.items()}
        if watcher.epoch(t.epoch + 1, numbers, time.monotonic() - began):
            t.stop = True

    trainer.add_callback("on_train_start", start)
    trainer.add_callback("on_train_epoch_start", epoch_start)
    trainer.add_callback("on_train_batch_end", batch_end)
    trainer.add_callback("on_fit_epoch_end", epoch_end)


def _share_of_heads(trainer: Any, span: tuple[float, float]) -> None:
    """Let the one-to-many head's share of the loss fall over the plan's part that is this stage."""
    model = trainer.model
    if getattr(model, "criterion", None) is None:
        model.criterion = model.init_criterion()
    loss = model.criterion
    if not hasattr(loss, "o2m_copy"):
        return
    fall = _O2M_FIRST - _O2M_LAST
    loss.o2m_copy = _O2M_FIRST - span[0] * fall
    loss.final_o2m = _O2M_FIRST - span[1] * fall
    loss.o2m = loss.decay(loss.updates)
    loss.o2o = loss.total - loss.o2m


def _be_stricter(trainer: Any, span: tuple[float, float]) -> None:
    """Let the points' tolerance fall over the plan."""
    begin, end = span
    progress = begin + (end - begin) * trainer.epoch / max(trainer.epochs, 1)
    set_tolerance(trainer.model, tolerance_at(progress))


def strip(checkpoint: Path, out: Path) -> None:
    """Write a checkpoint without its optimiser, in half precision; replaces `out` whole.

    Of paths on this machine only the names stay, and nothing of the folder's repository.
    """
    import torch
    from ultralytics.utils.torch_utils import strip_optimizer

    part = out.with_suffix(".part")
    strip_optimizer(str(checkpoint), str(part))
    # Our own file, just written.
    kept = torch.load(part, map_location="cpu", weights_only=False)
    kept.pop("git", None)
    kept["train_args"] = _named(kept.get("train_args") or {})
    network = kept["model"]
    for holder in ("args", "yaml"):
        value = getattr(network, holder, None)
        if isinstance(value, dict):
            setattr(network, holder, _named(value))
    network.pt_path = None
    torch.save(kept, part)
    part.replace(out)


def _named(values: dict[str, Any]) -> dict[str, Any]:
    """Give paths as their last name."""
    return {
        key: Path(value).name if isinstance(value, str) and "/" in value else value
        for key, value in values.items()
    }
