"""Train YOLO26 for cucumbers in stages, so that it can be killed, resumed and prolonged."""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from cucumbervision.errors import TrainingError
from cucumbervision_lab.training.export_yolo import import_ultralytics
from cucumbervision_lab.training.half_precision import choose_precision
from cucumbervision_lab.training.learn_from import TASKS, prepare_data
from cucumbervision_lab.training.points import knows_points
from cucumbervision_lab.training.settings import (
    LEARNING,
    TrainOptions,
    choose_device,
    stage_settings,
)
from cucumbervision_lab.training.stages import (
    DONE,
    RUNNING,
    RunState,
    Stage,
    merge_plans,
    parse_stages,
)
from cucumbervision_lab.training.trainer import make_trainer, strip

__all__ = ["DEFAULT_STAGES", "EpochReport", "TrainOptions", "TrainWatcher", "train"]

_SOUND_BATCH = 4

DEFAULT_STAGES = "320x8,448x6,640x2"
"""The plan where none is given."""


@dataclass(frozen=True)
class EpochReport:
    """What one epoch came to: stage and epoch from 1, sizes, time and Ultralytics' metrics."""

    stage: int
    stages: int
    size_px: int
    epoch: int
    epochs: int
    seconds: float
    metrics: Mapping[str, float]


class TrainWatcher(Protocol):
    """Who is shown how a training goes on."""

    def batch(self, fraction: float, stage: Stage) -> None:
        """Show that this share of an epoch of `stage` is through."""

    def epoch(self, report: EpochReport) -> None:
        """Show what an epoch came to."""


class _Silent:
    def batch(self, fraction: float, stage: Stage) -> None:
        """Show nothing."""

    def epoch(self, report: EpochReport) -> None:
        """Show nothing."""


def train(
    task: str,
    data: Path | None,
    out: Path,
    *,
    init: str | None = None,
    stages: str | None = None,
    resume: bool = False,
    options: TrainOptions | None = None,
    watcher: TrainWatcher | None = None,
) -> Path:
    """Train a network for one task, stage by stage.

    Parameters
    ----------
    task : str
        'seg' or 'pose'.
    data : Path, optional
        A data set's folder or data.yaml; not needed to resume.
    out : Path
        The run's folder: `state.json`, `metrics.csv`, a folder a stage, and `best.pt`, the best
        of the last finished stage.
    init : str, optional
        Weights to begin with (.pt, also of the other task: what fits is taken), or an
        Ultralytics .yaml for random ones.
    stages : str, optional
        The plan, as `parse_stages` reads it. To prolong a run, give the longer plan.
    resume : bool
        Go on with the run in `out`.
    options : TrainOptions, optional
        How to train. A run that is resumed keeps its own `LEARNING`.
    watcher : TrainWatcher, optional
        Is shown every batch and epoch.

    Returns
    -------
    Path
        `out / "best.pt"`; it exists once a stage is finished.

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
        state = _resumed(task, out, stages)
        options = replace(options, **state.learning)
    else:
        begun = _begun(task, data, out, init, stages, check=options.check)
        learning = {name: getattr(options, name) for name in LEARNING}
        state = replace(begun, seed=options.seed, learning=learning)
    state.save(out)
    clock = _Clock(options.minutes)
    for index, stage in enumerate(state.stages):
        if stage.status == DONE:
            continue
        state = _run_stage(state, index, out, options, watcher, clock)
        if state.stages[index].status != DONE or clock.is_over():
            break
    return out / "best.pt"


def _begun(
    task: str, data: Path | None, out: Path, init: str | None, stages: str | None, *, check: bool
) -> RunState:
    if RunState.exists(out):
        raise TrainingError(
            "there is a training already", source=out, remedy="add --resume, or choose another"
        )
    if data is None:
        raise TrainingError("no data set is given", remedy="name its folder or its data.yaml")
    plan = parse_stages(stages or DEFAULT_STAGES)
    weights = str(init or f"yolo26n-{task}.pt")
    if weights.endswith(".pt"):
        path = Path(weights).resolve()
        if not path.is_file():
            raise TrainingError(
                "there are no such weights, and none are fetched",
                source=weights,
                remedy=f"download them from Ultralytics, or begin with --init yolo26n-{task}.yaml",
            )
        weights = str(path)
    written = prepare_data(data, task, out, check=check)
    return RunState(task=task, data=str(written), init=weights, stages=plan)


def _resumed(task: str, out: Path, stages: str | None) -> RunState:
    state = RunState.load(out)
    if state.task != task:
        raise TrainingError(
            f"it is a training for {state.task}, not {task}", source=out, remedy="name its task"
        )
    if stages is None:
        return state
    return replace(state, stages=merge_plans(state.stages, parse_stages(stages)))


class _Clock:
    """Knows when the time given is over."""

    def __init__(self, minutes: float | None) -> None:
        self._end = None if minutes is None else time.monotonic() + 60 * minutes

    def is_over(self) -> bool:
        return self._end is not None and time.monotonic() > self._end


def _run_stage(
    state: RunState,
    index: int,
    out: Path,
    options: TrainOptions,
    watcher: TrainWatcher,
    clock: _Clock,
) -> RunState:
    """Train one stage, from its last checkpoint if there is one."""
    stage, folder = state.stages[index], state.folder(out, index)
    last = folder / "weights" / "last.pt"
    link = _StageLink(state, index, out, watcher, clock)
    if not (last.is_file() and _epochs_done(last) >= stage.epochs):
        state = state.at(index, status=RUNNING)
        link.state = state
        state.save(out)
        device = choose_device(options.device)
        trainer = make_trainer(
            TASKS[state.task],
            stage_settings(state, index, out, options, device, last if last.is_file() else None),
            link,
            threads=options.threads or os.cpu_count() or 1,
            workers=options.workers,
            bfloat16=device == "cpu" and choose_precision(options.precision, device) == "bf16",
            span=_span(state.stages, index),
            # Two or three pictures tell too little of a layer's mean and spread.
            still_norms=options.batch < _SOUND_BATCH and state.init.endswith(".pt"),
            strict=state.task == "pose" and knows_points(state.init),
            by_place=state.task == "pose" and options.by_place,
        )
        trainer.train()
        state = link.state
        ended = trainer.epoch + 1 >= stage.epochs or trainer.stopper.possible_stop
        if clock.is_over() and not ended:
            return state
    best = folder / "weights" / "best.pt"
    strip(best, out / "best.pt")
    state = state.at(index, status=DONE, fitness=_fitness(best))
    state.save(out)
    return state


class _StageLink:
    """Turns what the trainer tells into reports, the CSV file and the state."""

    def __init__(
        self, state: RunState, index: int, out: Path, watcher: TrainWatcher, clock: _Clock
    ) -> None:
        self.state = state
        self._index, self._out, self._watcher, self._clock = index, out, watcher, clock

    def batch(self, done: int, total: int) -> None:
        self._watcher.batch(done / total, self.state.stages[self._index])

    def epoch(self, number: int, metrics: Mapping[str, float], seconds: float) -> bool:
        stages = self.state.stages
        stage = stages[self._index]
        report = EpochReport(
            stage=self._index + 1,
            stages=len(stages),
            size_px=stage.size_px,
            epoch=number,
            epochs=stage.epochs,
            seconds=seconds,
            metrics=metrics,
        )
        _append(self._out / "metrics.csv", report)
        self.state = replace(self.state, seconds=self.state.seconds + seconds)
        self.state.save(self._out)
        self._watcher.epoch(report)
        return self._clock.is_over()


def _append(path: Path, report: EpochReport) -> None:
    row = {
        "stage": report.stage,
        "size_px": report.size_px,
        "epoch": report.epoch,
        "seconds": round(report.seconds, 1),
        **{key: f"{value:.5g}" for key, value in report.metrics.items()},
    }
    new = not path.exists()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, row)
        if new:
            writer.writeheader()
        writer.writerow(row)


def _epochs_done(checkpoint: Path) -> int:
    import torch

    return int(torch.load(checkpoint, map_location="cpu", weights_only=False)["epoch"]) + 1


def _fitness(checkpoint: Path) -> float:
    import torch

    return float(torch.load(checkpoint, map_location="cpu", weights_only=False)["best_fitness"])


def _span(stages: tuple[Stage, ...], index: int) -> tuple[float, float]:
    """Where in all epochs of the plan a stage begins and ends."""
    total = sum(stage.epochs for stage in stages)
    before = sum(stage.epochs for stage in stages[:index])
    return before / total, (before + stages[index].epochs) / total
