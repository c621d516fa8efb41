"""Train YOLO26 for cucumbers; runs can be resumed, moved to another machine and extended."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Protocol

from cucumbervision.errors import TrainingError
from cucumbervision_lab.training.checkpoint import (
    import_ultralytics,
    load_checkpoint,
    read_rows,
    stored_run_state,
    strip_checkpoint,
    write_rows,
)
from cucumbervision_lab.training.data import TASKS, prepare_data
from cucumbervision_lab.training.losses import choose_precision, has_keypoint_head
from cucumbervision_lab.training.plan import RunState, extend_plan, parse_plan
from cucumbervision_lab.training.settings import (
    FIXED_OPTIONS,
    TrainOptions,
    choose_device,
    trainer_settings,
)
from cucumbervision_lab.training.trainer import TrainerSettings, make_trainer

_LEAST_NORM_BATCH = 4

_DEFAULT_PLAN = "448x16000,640x4000"
"""Default plan."""

NETWORK = "network.pt"
"""File in a run's folder with the latest weights and the run state, without optimiser state."""


@dataclass(frozen=True)
class EpochReport:
    """Progress and metrics after an epoch.

    Parameters
    ----------
    pictures, of : int
        Number of pictures seen so far, and in the whole plan.
    size_px : int
        Size of the training pictures.
    seconds : float
        Duration of the epoch.
    metrics : mapping of str to float
        Ultralytics' losses and, if the epoch was validated, its metrics.
    """

    pictures: int
    of: int
    size_px: int
    seconds: float
    metrics: Mapping[str, float]


class TrainCallbacks(Protocol):
    """Progress callbacks of a training."""

    def batch(self, fraction: float, size_px: int) -> None:
        """Report the completed share of the current epoch."""

    def epoch(self, report: EpochReport) -> None:
        """Report a completed epoch, after its weights have been written to `NETWORK`."""


class _NoCallbacks:
    def batch(self, fraction: float, size_px: int) -> None:
        """Do nothing."""

    def epoch(self, report: EpochReport) -> None:
        """Do nothing."""


def train(
    task: str,
    data: Path | None,
    out: Path,
    *,
    init: str | None = None,
    plan: str | None = None,
    per_epoch: int = 500,
    resume: bool = False,
    options: TrainOptions | None = None,
    callbacks: TrainCallbacks | None = None,
) -> Path:
    """Train a network for one task.

    Parameters
    ----------
    task : str
        'seg' or 'pose'.
    data : Path, optional
        Folder or data.yaml of a data set. When resuming, needed only if the data set has moved.
    out : Path
        The run's folder: `state.json`, `metrics.csv`, `weights/last.pt` and `network.pt`.
    init : str, optional
        Initial weights (.pt), or an Ultralytics .yaml for random weights. From a checkpoint of
        the other task, matching layers are used. The `network.pt` of an unfinished run for the
        same task resumes that run, unless another plan is given.
    plan : str, optional
        Plan in the format of `parse_plan`. To extend a run, give a longer plan.
    per_epoch : int
        Pictures between two checkpoints.
    resume : bool
        Resume the run in `out`.
    options : TrainOptions, optional
        Training options. A resumed run keeps its `FIXED_OPTIONS`.
    callbacks : TrainCallbacks, optional
        Called after every batch and epoch.

    Returns
    -------
    Path
        `out / NETWORK`; the file exists after the first epoch.

    Raises
    ------
    TrainingError
        If the plan, the data, the weights or the folder are invalid.
    DataSetError
        If the data set has faults; the error lists them.
    MissingExtraError
        If the extra `train` is not installed.
    """
    options, callbacks = options or TrainOptions(), callbacks or _NoCallbacks()
    if task not in TASKS:
        raise TrainingError(f"unknown task {task!r}", remedy="use seg or pose")
    out = out.resolve()
    import_ultralytics()
    if resume:
        state = _resume_state(task, out, plan)
        if data is not None:
            written = prepare_data(data, task, out, check=options.check)
            state = replace(state, data=str(written))
    else:
        state = _new_state(task, data, out, init, plan, per_epoch, options)
    fixed = {name: value for name, value in state.learning.items() if name in FIXED_OPTIONS}
    options = replace(options, **fixed)
    state.save(out)
    while not state.is_done:
        state = _run_part(state, out, options, callbacks)
    return out / NETWORK


def _new_state(
    task: str,
    data: Path | None,
    out: Path,
    init: str | None,
    plan: str | None,
    per_epoch: int,
    options: TrainOptions,
) -> RunState:
    if RunState.exists(out):
        raise TrainingError(
            "already contains a training run",
            source=out,
            remedy="add --resume, or choose another folder",
        )
    if data is None:
        raise TrainingError("no data set given", remedy="give its folder or its data.yaml")
    new_plan = parse_plan(plan or _DEFAULT_PLAN, per_epoch)
    weights = str(init or f"yolo26n-{task}.pt")
    saved = None
    if weights.endswith(".pt"):
        path = Path(weights).resolve()
        if not path.is_file():
            raise TrainingError(
                "weights not found; they are not downloaded automatically",
                source=weights,
                remedy=f"download them from Ultralytics, or use --init yolo26n-{task}.yaml",
            )
        weights, saved = str(path), stored_run_state(path)
    written = str(prepare_data(data, task, out, check=options.check))
    if saved is not None and saved["task"] == task and not RunState.from_dict(saved).is_done:
        state = replace(RunState.from_dict(saved), data=written, init=weights)
        if plan is None or state.plan == new_plan:
            return state
    fixed = {name: getattr(options, name) for name in FIXED_OPTIONS}
    return RunState(task, written, weights, new_plan, seed=options.seed, learning=fixed)


def _resume_state(task: str, out: Path, plan: str | None) -> RunState:
    state = RunState.load(out)
    if state.task != task:
        raise TrainingError(
            f"is a training run for {state.task}, not {task}",
            source=out,
            remedy=f"use train network {state.task}",
        )
    last = _last(out)
    if last.is_file():
        # If the run was killed between the checkpoint and the state file, the state lags by one.
        state = replace(state, epochs=_completed_epochs(last))
    if plan is None:
        return state
    return replace(state, plan=extend_plan(state.plan, state.epochs, parse_plan(plan)))


def _last(out: Path) -> Path:
    return out / "weights" / "last.pt"


def _run_part(
    state: RunState, out: Path, options: TrainOptions, callbacks: TrainCallbacks
) -> RunState:
    """Train until the end of the current part of the plan."""
    last = _last(out)
    device = choose_device(options.device)
    model = str(last) if last.is_file() else state.init
    recorder = _RunRecorder(state, out, callbacks)
    trainer = make_trainer(
        TASKS[state.task],
        trainer_settings(state, model, out, options, device),
        recorder,
        TrainerSettings(
            plan=state.plan,
            epochs=state.epochs,
            seed=state.seed,
            one_to_many=options.one_to_many,
            validate_every=options.validate_every,
            # Mean and variance of a layer cannot be estimated from two or three pictures.
            freeze_batch_norm=(
                options.batch_on(device) < _LEAST_NORM_BATCH and state.init.endswith(".pt")
            ),
            final_sigma=state.task == "pose" and has_keypoint_head(state.init),
            by_place=state.task == "pose",
        ),
        threads=options.threads or os.cpu_count() or 1,
        bfloat16=device == "cpu" and choose_precision(options.precision, device) == "bf16",
    )
    trainer.train()
    return recorder.state


class _RunRecorder:
    """Trainer callbacks that save the run's state, metrics and weights, and report progress."""

    def __init__(self, state: RunState, out: Path, callbacks: TrainCallbacks) -> None:
        self.state = state
        self._out, self._callbacks = out, callbacks

    def batch(self, done: int, total: int) -> None:
        plan = self.state.plan
        self._callbacks.batch(done / total, plan.size_at(self.state.epochs))

    def epoch(self, number: int, metrics: Mapping[str, float], seconds: float) -> None:
        plan = self.state.plan
        report = EpochReport(
            pictures=number * plan.per_epoch,
            of=plan.epochs * plan.per_epoch,
            size_px=plan.size_at(number - 1),
            seconds=seconds,
            metrics=metrics,
        )
        self.state = replace(self.state, epochs=number, seconds=self.state.seconds + seconds)
        self.state.save(self._out)
        strip_checkpoint(_last(self._out), self._out / NETWORK, asdict(self.state))
        _append(self._out / "metrics.csv", report, self.state.seconds)
        self._callbacks.epoch(report)


def _append(path: Path, report: EpochReport, seconds: float) -> None:
    """Append the row of an epoch."""
    row = {
        "pictures": report.pictures,
        "size_px": report.size_px,
        "seconds": round(report.seconds, 1),
        "hours": round(seconds / 3600, 3),
        **{key: f"{value:.5g}" for key, value in report.metrics.items()},
    }
    write_rows(path, [*read_rows(path), row])


def _completed_epochs(checkpoint: Path) -> int:
    return int(load_checkpoint(checkpoint)["epoch"]) + 1
