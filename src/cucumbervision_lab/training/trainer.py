"""Ultralytics' trainer with one plan, a mixture of sources, files written whole, and bfloat16.

Nothing of Ultralytics is forked: one subclass of its trainer, and its callbacks.
"""

from __future__ import annotations

import math
import time
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from cucumbervision.perception.yolo import BY_PLACE
from cucumbervision_lab.training.cpu import assign_coarsely, channels_last, losses_of, narrow, widen
from cucumbervision_lab.training.ignored import add_ignored, ignore_regions, take_out_ignored
from cucumbervision_lab.training.plan import MixtureSampler, sources_of
from cucumbervision_lab.training.points import (
    learn_to_assign,
    learn_to_see,
    order_by_place,
    set_tolerance,
    tolerance_at,
)
from cucumbervision_lab.training.settings import one_to_many_at, rate_at

if TYPE_CHECKING:
    from collections.abc import Mapping

    from cucumbervision_lab.training.plan import Plan

_OUTSIDE = ("clearml", "comet", "dvc", "mlflow", "neptune", "raytune", "tensorboard", "wandb")
_WARM_STEPS = 100  # without the optimiser's memory
_AVERAGED_STEPS = 500  # by the weights' moving average; Ultralytics' is 10,000


class Watcher(Protocol):
    """Callbacks of a training."""

    def batch(self, done: int, total: int) -> None:
        """Tell that `done` of an epoch's `total` batches are through."""

    def epoch(self, number: int, metrics: Mapping[str, float], seconds: float) -> bool:
        """Tell what an epoch, counted from 1, came to. True ends the training after it."""


@dataclass(frozen=True)
class TrainerSettings:
    """Where in a plan a trainer begins, and how it learns.

    Parameters
    ----------
    plan : Plan
        The whole plan.
    epochs : int
        How many of its epochs are through.
    seed : int
        Of the order of pictures.
    one_to_many : float
        The one-to-many head's share of the loss at the plan's beginning.
    validate_every : int
        Epochs between two validations.
    still_norms : bool
        Keep the statistics of batch norm as they are; for very small batches.
    strict : bool
        Judge points by the final tolerance from the beginning.
    by_place : bool
        Learn points in the order in which they lie in the picture.
    """

    plan: Plan
    epochs: int = 0
    seed: int = 0
    one_to_many: float = 0.8
    validate_every: int = 1
    still_norms: bool = False
    strict: bool = False
    by_place: bool = False


def make_trainer(
    task: str,
    overrides: dict[str, Any],
    watcher: Watcher,
    settings: TrainerSettings,
    *,
    threads: int,
    workers: int,
    bfloat16: bool,
) -> Any:
    """Build the trainer of what is left of a plan's part.

    Parameters
    ----------
    task : str
        'segment' or 'pose'.
    overrides : dict
        Ultralytics' own settings.
    watcher : Watcher
        Called with every batch and epoch.
    settings : TrainerSettings
        Where in the plan it begins.
    threads, workers : int
        Threads of torch, and processes that load pictures.
    bfloat16 : bool
        Run the network's layers in bfloat16 on the CPU.

    Returns
    -------
    ultralytics.engine.trainer.BaseTrainer
        Ready for `train()`; it stops at the end of the plan's part.
    """
    from ultralytics.models.yolo.pose import PoseTrainer
    from ultralytics.models.yolo.segment import SegmentationTrainer
    from ultralytics.utils import SETTINGS

    for name in _OUTSIDE:
        dict.__setitem__(SETTINGS, name, False)
    base: Any = {"segment": SegmentationTrainer, "pose": PoseTrainer}[task]

    class Training(_PlannedTraining, base):  # type: ignore[misc]
        """Named without 'Trainer', so that Ultralytics ties no outside services to it."""

    trainer = Training(overrides=overrides)
    trainer.settings = settings
    if settings.by_place:
        trainer.add_callback("on_train_start", _say_by_place)
    # Ultralytics allows the CPU one thread less than it has, and no loading beside it.
    trainer.args.workers = workers
    _listen(trainer, watcher, threads)
    trainer.add_callback("on_train_start", _average_sooner)
    trainer.add_callback("on_train_epoch_start", _share_of_heads)
    trainer.add_callback("on_train_batch_start", _warm_up)
    if task == "pose":
        trainer.add_callback("on_train_start", lambda t: learn_to_assign(t.model))
        trainer.add_callback("on_train_start", lambda t: learn_to_see(t.model))
        trainer.add_callback("on_train_epoch_start", _be_stricter)
    if overrides["device"] == "cpu":
        trainer.add_callback("on_train_start", lambda t: channels_last(t.model))
        if task == "segment":
            trainer.add_callback("on_train_start", lambda t: assign_coarsely(t.model))
    trainer.add_callback("on_train_start", _leave_out_ignored)
    if bfloat16:
        trainer.add_callback("on_train_epoch_start", lambda t: narrow(t.model))
        trainer.add_callback("on_train_epoch_end", lambda t: widen(t.model))
    return trainer


class _PlannedTraining:
    """Overrides of Ultralytics' trainer: one plan for the whole training, files written whole."""

    args: Any
    data: dict[str, Any]
    device: Any
    ema: Any
    model: Any
    optimizer: Any
    settings: TrainerSettings
    wdir: Path
    last: Path
    best: Path
    cold_steps: int = _WARM_STEPS

    def _setup_scheduler(self) -> None:
        """Lower the learning rate over the plan."""
        import torch

        self.lf = lambda epoch: rate_at(self.settings.plan.through(epoch))
        self.scheduler = torch.optim.lr_scheduler.LambdaLR(self.optimizer, self.lf)

    def resume_training(self, ckpt: dict[str, Any] | None) -> None:
        """Go on where the plan stands, with the optimiser's memory if the checkpoint has it."""
        self.start_epoch = self.settings.epochs
        if self.settings.epochs and ckpt and ckpt.get("optimizer"):
            self._load_checkpoint_state(ckpt)  # type: ignore[attr-defined]
            self.cold_steps = 0

    def _model_train(self) -> None:
        super()._model_train()  # type: ignore[misc]
        if self.settings.still_norms:
            import torch

            for module in self.model.modules():
                if isinstance(module, torch.nn.BatchNorm2d):
                    module.eval()

    def preprocess_batch(self, batch: dict[str, Any]) -> dict[str, Any]:
        """Bring a batch to the device, points in the order to be learnt."""
        ready: dict[str, Any] = take_out_ignored(super().preprocess_batch(batch))  # type: ignore[misc]
        return _ordered(ready) if self.settings.by_place else ready

    def get_validator(self) -> Any:
        """Judge points in the order that was learnt."""
        validator = super().get_validator()  # type: ignore[misc]
        if self.settings.by_place:
            prepare = validator.preprocess
            validator.preprocess = lambda batch: _ordered(prepare(batch))
        return validator

    def get_dataloader(
        self, dataset_path: Any, batch_size: int = 16, rank: int = 0, mode: str = "train"
    ) -> Any:
        """Load the pictures, mixed by the sources' weights, without Ultralytics' own bar."""
        with redirect_stdout(StringIO()):
            if mode != "train":
                return super().get_dataloader(dataset_path, batch_size, rank, mode)  # type: ignore[misc]
            return self._mixed_loader(dataset_path, batch_size)

    def _mixed_loader(self, folders: Any, batch: int) -> Any:
        from ultralytics.data.build import InfiniteDataLoader, seed_worker

        dataset = self.build_dataset(folders, "train", batch)  # type: ignore[attr-defined]
        add_ignored(dataset, self.args.task)
        parts = folders if isinstance(folders, list) else [folders]
        sources = sources_of(dataset.im_files, [str(part) for part in parts])
        workers = self.args.workers
        return InfiniteDataLoader(
            dataset=dataset,
            batch_size=batch,
            sampler=MixtureSampler(
                sources,
                self.data.get("weights") or [float(len(source)) for source in sources],
                self.settings.plan.per_epoch,
                epoch=self.settings.epochs,
                seed=self.settings.seed,
            ),
            num_workers=workers,
            prefetch_factor=4 if workers else None,
            pin_memory=self.device.type == "cuda",
            collate_fn=dataset.collate_fn,
            worker_init_fn=seed_worker,
        )

    def save_model(self) -> bool:
        """Write `last.pt`."""
        last, best = self.last, self.best
        self.last, self.best = self.wdir / "last.part", self.wdir / "best.part"
        try:
            saved = bool(super().save_model())  # type: ignore[misc]
            self.last.replace(last)
            # Validation sees few pictures: of a plan that is one, the end is the best.
            self.best.unlink(missing_ok=True)
        finally:
            self.last, self.best = last, best
        return saved

    def final_eval(self) -> None:
        """Leave out the validation of an epoch that was validated already."""


def _ordered(batch: dict[str, Any]) -> dict[str, Any]:
    height, width = batch["img"].shape[2:]
    return batch | {"keypoints": order_by_place(batch["keypoints"], width, height)}


def _leave_out_ignored(trainer: Any) -> None:
    for loss in losses_of(trainer.model):
        ignore_regions(loss)


def _say_by_place(trainer: Any) -> None:
    # Exports store it for users of the points.
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
        rows = dict(t.label_loss_items(t.tloss))
        if t.args.val:
            rows |= {**t.metrics, "fitness": t.fitness}
        numbers = {key: float(value) for key, value in rows.items()}
        over = watcher.epoch(t.epoch + 1, numbers, time.monotonic() - began)
        if over or t.epoch + 1 >= t.settings.plan.end_of_part(t.epoch):
            t.stop = True

    trainer.add_callback("on_train_start", start)
    trainer.add_callback("on_train_epoch_start", epoch_start)
    trainer.add_callback("on_train_batch_end", batch_end)
    trainer.add_callback("on_fit_epoch_end", epoch_end)


def _average_sooner(trainer: Any) -> None:
    """Average the weights over hundreds of steps."""
    trainer.ema.decay = lambda step: (1 - 1 / _AVERAGED_STEPS) * (1 - math.exp(-step / 200))


def _share_of_heads(trainer: Any) -> None:
    """Lower the one-to-many head's share of the loss over the plan; say when to validate."""
    settings, model = trainer.settings, trainer.model
    last = settings.plan.end_of_part(trainer.epoch)
    trainer.args.val = (
        trainer.epoch + 1
    ) % settings.validate_every == 0 or trainer.epoch + 1 == last
    if getattr(model, "criterion", None) is None:
        model.criterion = model.init_criterion()
    loss = model.criterion
    if hasattr(loss, "o2m"):
        loss.o2m = one_to_many_at(settings.plan.through(trainer.epoch), settings.one_to_many)
        loss.o2o = loss.total - loss.o2m


def _warm_up(trainer: Any) -> None:
    """Raise the learning rate over the first steps of an optimiser without a memory."""
    if not trainer.cold_steps:
        return
    trainer.cold_steps -= 1
    share = trainer.lf(trainer.epoch) * (1 - trainer.cold_steps / _WARM_STEPS)
    for group in trainer.optimizer.param_groups:
        group["lr"] = group["initial_lr"] * share


def _be_stricter(trainer: Any) -> None:
    """Lower the points' tolerance over the plan."""
    settings = trainer.settings
    progress = 1.0 if settings.strict else settings.plan.through(trainer.epoch)
    set_tolerance(trainer.model, tolerance_at(progress))
