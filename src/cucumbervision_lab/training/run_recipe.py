"""From folders of pictures to trained networks by one recipe, resumable at any point."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from cucumbervision.errors import TrainingError
from cucumbervision_lab.datasets.card import dataset_card
from cucumbervision_lab.datasets.coco import read_coco
from cucumbervision_lab.datasets.yolo_writer import write_yolo
from cucumbervision_lab.training.curve import Curve
from cucumbervision_lab.training.data import DATA_CARD, TASKS, write_data_file
from cucumbervision_lab.training.plan import RunState
from cucumbervision_lab.training.recipe import ORIGINAL, Recipe, Source
from cucumbervision_lab.training.settings import TrainOptions
from cucumbervision_lab.training.sources import build_sources
from cucumbervision_lab.training.train import NETWORK, EpochReport, TrainWatcher, train

PACKAGED = Path(__file__).with_name("recipe.toml")
"""The recipe that the package's networks are trained by."""


@dataclass(frozen=True)
class RecipeFolders:
    """Where a recipe finds and puts things.

    Parameters
    ----------
    data : Path
        The folder of pictures.
    weights : Path
        Folder of the weights that the recipe begins with, or goes on from.
    out : Path
        The run's folder: `data/`, and `seg/` and `pose/` with a training each.
    test : Path, optional
        A drawn set whose test split the curve is judged by, beside the real photos.
    """

    data: Path
    weights: Path
    out: Path
    test: Path | None = None


def run_recipe(
    recipe: Recipe,
    kitchen: RecipeFolders,
    *,
    tasks: tuple[str, ...] = ("seg", "pose"),
    options: TrainOptions | None = None,
    watcher: TrainWatcher | None = None,
    workers: int = 1,
    say: Callable[[str], None] = print,
) -> dict[str, Path]:
    """Build the sources, then train one network after the other, each from where it stands.

    Parameters
    ----------
    recipe : Recipe
        Which pictures, and the plans.
    kitchen : RecipeFolders
        Where everything is.
    tasks : tuple of str
        Those of 'seg' and 'pose' to train, in this order.
    options : TrainOptions, optional
        Of the machine: device, batch, threads, minutes. How to learn stands in the recipe.
    watcher : TrainWatcher, optional
        Is shown every batch and epoch.
    workers : int
        Processes that draw.
    say : callable
        Told what is being done.

    Returns
    -------
    dict of str to Path
        The newest weights of each task.

    Raises
    ------
    TrainingError, DataSetError, CaptureError
        If something that the recipe needs is missing.
    """
    given = options or TrainOptions()
    unknown = [task for task in tasks if task not in recipe.schedules]
    if unknown:
        raise TrainingError(f"the recipe has no plan for {unknown[0]}", remedy="add its table")
    built = build_sources(recipe, kitchen.data, kitchen.out / "data", workers, say)
    found = {}
    for task in tasks:
        schedule, run = recipe.schedules[task], kitchen.out / task
        data = write_mixture(recipe, built, task, run)
        own = replace(
            given,
            learning_rate=schedule.learning_rate,
            one_to_many=schedule.one_to_many,
            freeze=schedule.freeze if given.freeze == 0 else given.freeze,
            validate_every=schedule.validate_every,
            # Half of a mixture are windows and sheets of other pictures: they resemble each other.
            check=False,
        )
        begun = RunState.exists(run)
        say(f"{'going on with' if begun else 'beginning'} {task}: {schedule.plan}")
        found[task] = train(
            task,
            data,
            run,
            init=None if begun else str(kitchen.weights / schedule.init),
            plan=schedule.plan,
            per_epoch=schedule.per_epoch,
            resume=begun,
            options=own,
            watcher=_Judged(watcher, Curve(task, kitchen.data, kitchen.test, run), recipe),
        )
    return found


class _Judged:
    """Adds a point to the curve every few epochs."""

    def __init__(self, watcher: TrainWatcher | None, curve: Curve, recipe: Recipe) -> None:
        self._watcher, self._curve = watcher, curve
        schedule = recipe.schedules[curve.task]
        self._every = schedule.judge_every * schedule.per_epoch

    def batch(self, fraction: float, size_px: int) -> None:
        """Pass it on."""
        if self._watcher:
            self._watcher.batch(fraction, size_px)

    def epoch(self, report: EpochReport) -> None:
        """Pass it on, and judge the network if it is time."""
        if self._watcher:
            self._watcher.epoch(report)
        if report.pictures % self._every == 0 or report.pictures >= report.of:
            self._curve.judge(self._curve.run / NETWORK, report.pictures)


def write_mixture(recipe: Recipe, built: Mapping[str, Path], task: str, run: Path) -> Path:
    """Write the sources as Ultralytics reads them, and one `data.yaml` with their weights.

    Parameters
    ----------
    recipe : Recipe
        Of the sources and their weights.
    built : mapping of str to Path
        The sets, by source.
    task : str
        'seg' or 'pose'.
    run : Path
        The training's folder.

    Returns
    -------
    Path
        The data.yaml: `train` and `val` are lists of folders, `weights` belongs to `train`.
    """
    yaml = import_module("yaml")
    values: dict[str, Any] = {"train": [], "weights": [], "val": []}
    cards = ["# Mixture", "", "| source | of the pictures seen |", "|---|--:|"]
    cards += [f"| {one.name} | {one.weight:.0%} |" for one in recipe.sources if one.weight]
    for source in recipe.sources:
        if not (source.weight or source.validate):
            continue
        folder = run / "data" / source.name
        _write_source(source, built[source.name], task, folder)
        head = yaml.safe_load((folder / "data.yaml").read_text(encoding="utf-8"))
        values |= {key: head[key] for key in head if key not in (*values, "path", "test")}
        if source.weight and "train" in head:
            values["train"].append(str(folder / "images" / "train"))
            values["weights"].append(source.weight)
        if source.validate and "val" in head:
            values["val"].append(str(folder / "images" / "val"))
        if source.kind in ORIGINAL:
            cards.append("\n#" + (folder / DATA_CARD).read_text(encoding="utf-8"))
    run.mkdir(parents=True, exist_ok=True)
    (run / DATA_CARD).write_text("\n".join(cards), encoding="utf-8")
    mixture = run / "mixture.yaml"
    mixture.write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")
    return write_data_file(mixture, task, run)


def _write_source(source: Source, built: Path, task: str, folder: Path) -> None:
    """Write one source as Ultralytics reads it, with its card, unless it is there already."""
    card = folder / DATA_CARD
    labels = built / "annotations.json"
    if card.is_file() and card.stat().st_mtime >= labels.stat().st_mtime:
        return
    dataset = read_coco(built)
    splits = [split for split in ("train", "val") if dataset.in_split(split)]
    write_yolo(dataset, folder, TASKS[task], splits=splits, paint_ignored=())
    card.write_text(dataset_card(dataset, source.name), encoding="utf-8")
