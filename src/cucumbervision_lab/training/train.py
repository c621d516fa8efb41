"""Train YOLO26 for cucumbers by one plan, which can be killed, resumed, moved and prolonged."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Protocol

from cucumbervision.errors import TrainingError
from cucumbervision_lab.training.checkpoint import (
    import_ultralytics,
    load_checkpoint,
    place_in,
    read_rows,
    strip,
    write_rows,
)
from cucumbervision_lab.training.cpu import choose_precision
from cucumbervision_lab.training.data import TASKS, prepare_data
from cucumbervision_lab.training.plan import RunState, extend, parse_plan
from cucumbervision_lab.training.points import knows_points
from cucumbervision_lab.training.settings import (
    LEARNING,
    TrainOptions,
    choose_device,
    trainer_settings,
)
from cucumbervision_lab.training.trainer import TrainerSettings, make_trainer

_SOUND_BATCH = 4

_DEFAULT_PLAN = "448x16000,640x4000"
"""The plan where none is given."""

NETWORK = "network.pt"
"""In a run's folder: the newest weights and their place in the plan, without the optimiser."""


@dataclass(frozen=True)
class EpochReport:
    """What one epoch came to.

    Parameters
    ----------
    pictures, of : int
        Seen so far, and in the whole plan.
    size_px : int
        Of the pictures.
    seconds : float
        That the epoch took.
    metrics : mapping of str to float
        Ultralytics' losses, and its metrics where the epoch was validated.
    """

    pictures: int
    of: int
    size_px: int
    seconds: float
    metrics: Mapping[str, float]


class TrainWatcher(Protocol):
    """Who is shown how a training goes on."""

    def batch(self, fraction: float, size_px: int) -> None:
        """Show that this share of an epoch is through."""

    def epoch(self, report: EpochReport) -> None:
        """Show what an epoch came to; `NETWORK` holds its weights by then."""


class _Silent:
    def batch(self, fraction: float, size_px: int) -> None:
        """Show nothing."""

    def epoch(self, report: EpochReport) -> None:
        """Show nothing."""


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
    watcher: TrainWatcher | None = None,
) -> Path:
    """Train a network for one task by one plan.

    Parameters
    ----------
    task : str
        'seg' or 'pose'.
    data : Path, optional
        A data set's folder or data.yaml; to resume, only where it lies elsewhere now.
    out : Path
        The run's folder: `state.json`, `metrics.csv`, `weights/last.pt` and `network.pt`.
    init : str, optional
        Weights to begin with (.pt, also of the other task: what fits is taken), or an
        Ultralytics .yaml for random ones. A `network.pt` of an unfinished run for the same task
        resumes that run, unless another plan is given.
    plan : str, optional
        As `parse_plan` reads it. To prolong a run, give the longer plan.
    per_epoch : int
        Pictures between two checkpoints.
    resume : bool
        Go on with the run in `out`.
    options : TrainOptions, optional
        How to train. A run that is resumed keeps its own `LEARNING`.
    watcher : TrainWatcher, optional
        Is shown every batch and epoch.

    Returns
    -------
    Path
        `out / NETWORK`; it exists once an epoch is through.

    Raises
    ------
    TrainingError
        If the plan, the data, the weights or the folder cannot be used.
    DataSetError
        If the data set has faults; with the list of them.
    MissingExtraError
        If the extra `train` is not installed.
    """
    options, watcher = options or TrainOptions(), watcher or _Silent()
    if task not in TASKS:
        raise TrainingError(f"no task is called {task!r}", remedy="use seg or pose")
    out = out.resolve()
    import_ultralytics()
    if resume:
        state = _resumed(task, out, plan)
        if data is not None:
            written = prepare_data(data, task, out, check=options.check)
            state = replace(state, data=str(written))
    else:
        state = _begun(task, data, out, init, plan, per_epoch, options)
    options = replace(options, **state.learning)
    state.save(out)
    end = None if options.minutes is None else time.monotonic() + 60 * options.minutes
    while not state.is_done and (end is None or time.monotonic() < end):
        state = _run_part(state, out, options, watcher, end)
    return out / NETWORK


def _begun(
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
            "there is a training already", source=out, remedy="add --resume, or choose another"
        )
    if data is None:
        raise TrainingError("no data set is given", remedy="name its folder or its data.yaml")
    wanted = parse_plan(plan or _DEFAULT_PLAN, per_epoch)
    weights = str(init or f"yolo26n-{task}.pt")
    place = None
    if weights.endswith(".pt"):
        path = Path(weights).resolve()
        if not path.is_file():
            raise TrainingError(
                "there are no such weights, and none are fetched",
                source=weights,
                remedy=f"download them from Ultralytics, or begin with --init yolo26n-{task}.yaml",
            )
        weights, place = str(path), place_in(path)
    written = str(prepare_data(data, task, out, check=options.check))
    if place is not None and place["task"] == task and not RunState.of(place).is_done:
        state = replace(RunState.of(place), data=written, init=weights)
        if plan is None or state.plan == wanted:
            return state
    learning = {name: getattr(options, name) for name in LEARNING}
    return RunState(task, written, weights, wanted, seed=options.seed, learning=learning)


def _resumed(task: str, out: Path, plan: str | None) -> RunState:
    state = RunState.load(out)
    if state.task != task:
        raise TrainingError(
            f"it is a training for {state.task}, not {task}", source=out, remedy="name its task"
        )
    last = _last(out)
    if last.is_file():
        # One killed between its checkpoint and its state has come an epoch further than it says.
        state = replace(state, epochs=_epochs_done(last))
    if plan is None:
        return state
    return replace(state, plan=extend(state.plan, state.epochs, parse_plan(plan)))


def _last(out: Path) -> Path:
    return out / "weights" / "last.pt"


def _run_part(
    state: RunState, out: Path, options: TrainOptions, watcher: TrainWatcher, end: float | None
) -> RunState:
    """Train to the end of the plan's part, or until the time is over."""
    last = _last(out)
    device = choose_device(options.device)
    model = str(last) if last.is_file() else state.init
    link = _Link(state, out, watcher, end)
    trainer = make_trainer(
        TASKS[state.task],
        trainer_settings(state, model, out, options, device),
        link,
        TrainerSettings(
            plan=state.plan,
            epochs=state.epochs,
            seed=state.seed,
            one_to_many=options.one_to_many,
            validate_every=options.validate_every,
            # Two or three pictures tell too little of a layer's mean and spread.
            still_norms=options.batch_on(device) < _SOUND_BATCH and state.init.endswith(".pt"),
            strict=state.task == "pose" and knows_points(state.init),
            by_place=state.task == "pose" and options.by_place,
        ),
        threads=options.threads or os.cpu_count() or 1,
        workers=options.workers,
        bfloat16=device == "cpu" and choose_precision(options.precision, device) == "bf16",
    )
    trainer.train()
    return link.state


class _Link:
    """Turns the trainer's callbacks into reports, the CSV file, the state and `NETWORK`."""

    def __init__(
        self, state: RunState, out: Path, watcher: TrainWatcher, end: float | None
    ) -> None:
        self.state = state
        self._out, self._watcher, self._end = out, watcher, end

    def batch(self, done: int, total: int) -> None:
        plan = self.state.plan
        self._watcher.batch(done / total, plan.size_at(self.state.epochs))

    def epoch(self, number: int, metrics: Mapping[str, float], seconds: float) -> bool:
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
        strip(_last(self._out), self._out / NETWORK, asdict(self.state))
        _append(self._out / "metrics.csv", report, self.state.seconds)
        self._watcher.epoch(report)
        return self._end is not None and time.monotonic() > self._end


def _append(path: Path, report: EpochReport, seconds: float) -> None:
    """Add an epoch's row."""
    row = {
        "pictures": report.pictures,
        "size_px": report.size_px,
        "seconds": round(report.seconds, 1),
        "hours": round(seconds / 3600, 3),
        **{key: f"{value:.5g}" for key, value in report.metrics.items()},
    }
    write_rows(path, [*read_rows(path), row])


def _epochs_done(checkpoint: Path) -> int:
    return int(load_checkpoint(checkpoint)["epoch"]) + 1
