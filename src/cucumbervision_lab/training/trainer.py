"""Ultralytics trainer with a multi-size plan, weighted sources, atomic checkpoints and bfloat16.

Implemented as a subclass of Ultralytics' trainer and with its callbacks; nothing is forked.
"""

from __future__ import annotations

import math
import time
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from cucumbervision.perception.yolo_layout import BY_PLACE
from cucumbervision_lab.training.losses import (
    add_ignored,
    assign_at_half_resolution,
    assign_by_boxes_and_keypoints,
    channels_last,
    disable_bfloat16,
    enable_bfloat16,
    head_losses,
    ignore_regions,
    keypoint_sigma_at,
    learn_visibility,
    order_by_position,
    separate_ignored,
    set_keypoint_sigma,
)
from cucumbervision_lab.training.plan import MixtureSampler, group_by_source
from cucumbervision_lab.training.settings import one_to_many_at, rate_at

if TYPE_CHECKING:
    from collections.abc import Mapping

    from cucumbervision_lab.training.plan import Plan

_INTEGRATIONS = ("clearml", "comet", "dvc", "mlflow", "neptune", "raytune", "tensorboard", "wandb")
_WARMUP_STEPS = 100  # for an optimiser without restored state
_EMA_STEPS = 500  # time constant of the weights' moving average; Ultralytics uses 10,000


class TrainerCallbacks(Protocol):
    """Callbacks of the trainer."""

    def batch(self, done: int, total: int) -> None:
        """Report that `done` of the `total` batches of an epoch are completed."""

    def epoch(self, number: int, metrics: Mapping[str, float], seconds: float) -> None:
        """Report a completed epoch, counted from 1."""


@dataclass(frozen=True)
class TrainerSettings:
    """Position in the plan and training options of a trainer.

    Parameters
    ----------
    plan : Plan
        The whole plan.
    epochs : int
        Number of completed epochs.
    seed : int
        Random seed of the picture order.
    one_to_many : float
        Initial share of the one-to-many head in the loss.
    validate_every : int
        Epochs between two validations.
    freeze_batch_norm : bool
        Keep the batch norm statistics fixed; for very small batches.
    final_sigma : bool
        Use the final keypoint sigma from the beginning; for pretrained keypoint heads.
    by_place : bool
        Order keypoints by their position in the picture.
    """

    plan: Plan
    epochs: int = 0
    seed: int = 0
    one_to_many: float = 0.8
    validate_every: int = 1
    freeze_batch_norm: bool = False
    final_sigma: bool = False
    by_place: bool = False


def make_trainer(
    task: str,
    overrides: dict[str, Any],
    callbacks: TrainerCallbacks,
    settings: TrainerSettings,
    *,
    threads: int,
    bfloat16: bool,
) -> Any:
    """Create the trainer for the rest of the current part of a plan.

    Parameters
    ----------
    task : str
        'segment' or 'pose'.
    overrides : dict
        Ultralytics settings.
    callbacks : TrainerCallbacks
        Called after every batch and epoch.
    settings : TrainerSettings
        Position in the plan and options.
    threads : int
        Number of torch threads.
    bfloat16 : bool
        Run the network's layers in bfloat16 on the CPU.

    Returns
    -------
    ultralytics.engine.trainer.BaseTrainer
        Trainer whose `train()` stops at the end of the current part.
    """
    from ultralytics.models.yolo.pose import PoseTrainer
    from ultralytics.models.yolo.segment import SegmentationTrainer
    from ultralytics.utils import SETTINGS

    for name in _INTEGRATIONS:
        dict.__setitem__(SETTINGS, name, False)
    base: Any = {"segment": SegmentationTrainer, "pose": PoseTrainer}[task]

    class Training(_PlannedTraining, base):  # type: ignore[misc]
        """Trainer; Ultralytics attaches integrations to class names that contain 'Trainer'."""

    trainer = Training(overrides=overrides)
    trainer.settings = settings
    if settings.by_place:
        trainer.add_callback("on_train_start", _store_keypoint_order)
    _add_progress_callbacks(trainer, callbacks, threads)
    trainer.add_callback("on_train_start", _set_ema_decay)
    trainer.add_callback("on_train_epoch_start", _set_loss_shares)
    trainer.add_callback("on_train_batch_start", _warm_up)
    if task == "pose":
        trainer.add_callback("on_train_start", lambda t: assign_by_boxes_and_keypoints(t.model))
        trainer.add_callback("on_train_start", lambda t: learn_visibility(t.model))
        trainer.add_callback("on_train_epoch_start", _set_keypoint_sigma)
    if overrides["device"] == "cpu":
        trainer.add_callback("on_train_start", lambda t: channels_last(t.model))
        if task == "segment":
            trainer.add_callback("on_train_start", lambda t: assign_at_half_resolution(t.model))
    trainer.add_callback("on_train_start", _skip_ignored_regions)
    if bfloat16:
        trainer.add_callback("on_train_epoch_start", lambda t: enable_bfloat16(t.model))
        trainer.add_callback("on_train_epoch_end", lambda t: disable_bfloat16(t.model))
    return trainer


class _PlannedTraining:
    """Overrides of Ultralytics' trainer: schedule over the whole plan, atomic checkpoints."""

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
    warmup_steps: int = _WARMUP_STEPS

    def _setup_scheduler(self) -> None:
        """Decrease the learning rate over the whole plan."""
        import torch

        self.lf = lambda epoch: rate_at(self.settings.plan.progress(epoch))
        self.scheduler = torch.optim.lr_scheduler.LambdaLR(self.optimizer, self.lf)

    def resume_training(self, ckpt: dict[str, Any] | None) -> None:
        """Resume at the current epoch, with the optimiser state if the checkpoint contains it."""
        self.start_epoch = self.settings.epochs
        if self.settings.epochs and ckpt and ckpt.get("optimizer"):
            self._load_checkpoint_state(ckpt)  # type: ignore[attr-defined]
            self.warmup_steps = 0

    def _model_train(self) -> None:
        super()._model_train()  # type: ignore[misc]
        if self.settings.freeze_batch_norm:
            import torch

            for module in self.model.modules():
                if isinstance(module, torch.nn.BatchNorm2d):
                    module.eval()

    def preprocess_batch(self, batch: dict[str, Any]) -> dict[str, Any]:
        """Move a batch to the device, separate ignore regions and order the keypoints."""
        ready: dict[str, Any] = separate_ignored(super().preprocess_batch(batch))  # type: ignore[misc]
        return _ordered(ready) if self.settings.by_place else ready

    def get_validator(self) -> Any:
        """Return a validator that orders keypoints as in training."""
        validator = super().get_validator()  # type: ignore[misc]
        if self.settings.by_place:
            prepare = validator.preprocess
            validator.preprocess = lambda batch: _ordered(prepare(batch))
        return validator

    def get_dataloader(
        self, dataset_path: Any, batch_size: int = 16, rank: int = 0, mode: str = "train"
    ) -> Any:
        """Return a loader that samples sources by weight; hides Ultralytics' progress bar."""
        with redirect_stdout(StringIO()):
            if mode != "train":
                return super().get_dataloader(dataset_path, batch_size, rank, mode)  # type: ignore[misc]
            return self._mixed_loader(dataset_path, batch_size)

    def _mixed_loader(self, folders: Any, batch: int) -> Any:
        from ultralytics.data.build import InfiniteDataLoader

        dataset = self.build_dataset(folders, "train", batch)  # type: ignore[attr-defined]
        add_ignored(dataset, self.args.task)
        parts = folders if isinstance(folders, list) else [folders]
        sources = group_by_source(dataset.im_files, [str(part) for part in parts])
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
            num_workers=0,
            pin_memory=self.device.type == "cuda",
            collate_fn=dataset.collate_fn,
        )

    def save_model(self) -> bool:
        """Write `last.pt` atomically; `best.pt` is not kept."""
        last, best = self.last, self.best
        self.last, self.best = self.wdir / "last.part", self.wdir / "best.part"
        try:
            saved = bool(super().save_model())  # type: ignore[misc]
            self.last.replace(last)
            # The validation set is too small to select an epoch; the last epoch of a plan is used.
            self.best.unlink(missing_ok=True)
        finally:
            self.last, self.best = last, best
        return saved

    def final_eval(self) -> None:
        """Skip the final validation: the last epoch has already been validated."""


def _ordered(batch: dict[str, Any]) -> dict[str, Any]:
    height, width = batch["img"].shape[2:]
    return batch | {"keypoints": order_by_position(batch["keypoints"], width, height)}


def _skip_ignored_regions(trainer: Any) -> None:
    for loss in head_losses(trainer.model):
        ignore_regions(loss)


def _store_keypoint_order(trainer: Any) -> None:
    # Stored in the exported file, so that users know the order of the keypoints.
    for network in (trainer.model, trainer.ema.ema):
        network.keypoint_order = BY_PLACE


def _add_progress_callbacks(trainer: Any, callbacks: TrainerCallbacks, threads: int) -> None:
    started = 0.0
    done = 0

    def start(_: Any) -> None:
        import torch

        torch.set_num_threads(threads)

    def epoch_start(_: Any) -> None:
        nonlocal started, done
        started, done = time.monotonic(), 0

    def batch_end(t: Any) -> None:
        nonlocal done
        done += 1
        callbacks.batch(done, len(t.train_loader))

    def epoch_end(t: Any) -> None:
        rows = dict(t.label_loss_items(t.tloss))
        if t.args.val:
            rows |= {**t.metrics, "fitness": t.fitness}
        numbers = {key: float(value) for key, value in rows.items()}
        callbacks.epoch(t.epoch + 1, numbers, time.monotonic() - started)
        if t.epoch + 1 >= t.settings.plan.end_of_part(t.epoch):
            t.stop = True

    trainer.add_callback("on_train_start", start)
    trainer.add_callback("on_train_epoch_start", epoch_start)
    trainer.add_callback("on_train_batch_end", batch_end)
    trainer.add_callback("on_fit_epoch_end", epoch_end)


def _set_ema_decay(trainer: Any) -> None:
    """Set a shorter time constant for the moving average of the weights."""
    trainer.ema.decay = lambda step: (1 - 1 / _EMA_STEPS) * (1 - math.exp(-step / 200))


def _set_loss_shares(trainer: Any) -> None:
    """Set the loss shares of the two heads, and whether this epoch is validated."""
    settings, model = trainer.settings, trainer.model
    last = settings.plan.end_of_part(trainer.epoch)
    trainer.args.val = (
        trainer.epoch + 1
    ) % settings.validate_every == 0 or trainer.epoch + 1 == last
    if getattr(model, "criterion", None) is None:
        model.criterion = model.init_criterion()
    loss = model.criterion
    if hasattr(loss, "o2m"):
        loss.o2m = one_to_many_at(settings.plan.progress(trainer.epoch), settings.one_to_many)
        loss.o2o = loss.total - loss.o2m


def _warm_up(trainer: Any) -> None:
    """Warm up the learning rate if the optimiser state was not restored."""
    if not trainer.warmup_steps:
        return
    trainer.warmup_steps -= 1
    share = trainer.lf(trainer.epoch) * (1 - trainer.warmup_steps / _WARMUP_STEPS)
    for group in trainer.optimizer.param_groups:
        group["lr"] = group["initial_lr"] * share


def _set_keypoint_sigma(trainer: Any) -> None:
    """Set the keypoint sigma for the current progress."""
    settings = trainer.settings
    progress = 1.0 if settings.final_sigma else settings.plan.progress(trainer.epoch)
    set_keypoint_sigma(trainer.model, keypoint_sigma_at(progress))
