"""Train networks from a recipe, and record their accuracy curve during training."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

from cucumbervision.errors import TrainingError
from cucumbervision_lab.datasets.coco import read_coco
from cucumbervision_lab.datasets.yolo import write_yolo
from cucumbervision_lab.detection.average_precision import IouType, average_precision
from cucumbervision_lab.detection.photos import Photo, audited_photos, evaluate_photos
from cucumbervision_lab.detection.picture_result import Networks, detect_set, open_networks
from cucumbervision_lab.detection.pictures import Stage, read_held_out
from cucumbervision_lab.detection.run import chosen_networks
from cucumbervision_lab.training.checkpoint import read_rows, write_rows
from cucumbervision_lab.training.data import DATA_CARD, TASKS, data_card, write_data_file
from cucumbervision_lab.training.export import export_yolo, load_yolo
from cucumbervision_lab.training.plan import RunState
from cucumbervision_lab.training.recipe import ORIGINAL, Recipe, Source, build_sources
from cucumbervision_lab.training.settings import TrainOptions
from cucumbervision_lab.training.train import NETWORK, EpochReport, TrainCallbacks, train

PACKAGED = Path(__file__).with_name("recipe.toml")
"""The recipe of the packaged networks."""


@dataclass(frozen=True)
class RecipeFolders:
    """Input and output folders of a recipe.

    Parameters
    ----------
    data : Path
        Folder of the pictures.
    weights : Path
        Folder of the initial weights.
    out : Path
        The run's folder: `data/`, and one training run each in `seg/` and `pose/`.
    test : Path, optional
        Synthetic set whose test split is evaluated for the accuracy curve, in addition to photos.
    """

    data: Path
    weights: Path
    out: Path
    test: Path | None = None


def run_recipe(
    recipe: Recipe,
    folders: RecipeFolders,
    *,
    tasks: tuple[str, ...] = ("seg", "pose"),
    options: TrainOptions | None = None,
    callbacks: TrainCallbacks | None = None,
    workers: int = 1,
    log: Callable[[str], None] = print,
) -> dict[str, Path]:
    """Build the sources, then train or resume one network after the other.

    Parameters
    ----------
    recipe : Recipe
        Sources and schedules.
    folders : RecipeFolders
        Input and output folders.
    tasks : tuple of str
        Tasks to train in this order, 'seg' and 'pose'.
    options : TrainOptions, optional
        Machine options: device, batch, threads. The recipe sets the others.
    callbacks : TrainCallbacks, optional
        Called after every batch and epoch.
    workers : int
        Number of processes that draw synthetic frames.
    log : callable
        Called with a line of text for each step.

    Returns
    -------
    dict of str to Path
        Latest weights of each task.

    Raises
    ------
    TrainingError, DataSetError, CaptureError
        If pictures, weights or schedules that the recipe needs are missing.
    """
    base_options = options or TrainOptions()
    unknown = [task for task in tasks if task not in recipe.schedules]
    if unknown:
        raise TrainingError(
            f"the recipe has no schedule for {unknown[0]}", remedy=f"add a table [{unknown[0]}]"
        )
    built = build_sources(recipe, folders.data, folders.out / "data", workers, log)
    results = {}
    for task in tasks:
        schedule, run = recipe.schedules[task], folders.out / task
        data = write_mixture(recipe, built, task, run)
        task_options = replace(
            base_options,
            learning_rate=schedule.learning_rate,
            one_to_many=schedule.one_to_many,
            freeze=schedule.freeze if base_options.freeze == 0 else base_options.freeze,
            validate_every=schedule.validate_every,
            # Windows and sheets are crops of other sources, so duplicates are expected.
            check=False,
        )
        exists = RunState.exists(run)
        log(f"{'resuming' if exists else 'starting'} {task}: {schedule.plan}")
        results[task] = train(
            task,
            data,
            run,
            init=None if exists else str(folders.weights / schedule.init),
            plan=schedule.plan,
            per_epoch=schedule.per_epoch,
            resume=exists,
            options=task_options,
            callbacks=_CurveCallbacks(
                callbacks, Curve(task, folders.data, folders.test, run), recipe
            ),
        )
    return results


class _CurveCallbacks:
    """Callbacks that evaluate the network every few epochs, and forward to other callbacks."""

    def __init__(self, callbacks: TrainCallbacks | None, curve: Curve, recipe: Recipe) -> None:
        self._callbacks, self._curve = callbacks, curve
        schedule = recipe.schedules[curve.task]
        self._every = schedule.judge_every * schedule.per_epoch

    def batch(self, fraction: float, size_px: int) -> None:
        """Forward the progress."""
        if self._callbacks:
            self._callbacks.batch(fraction, size_px)

    def epoch(self, report: EpochReport) -> None:
        """Forward the report, and evaluate the network if due."""
        if self._callbacks:
            self._callbacks.epoch(report)
        if report.pictures % self._every == 0 or report.pictures >= report.of:
            self._curve.judge(self._curve.run / NETWORK, report.pictures)


def write_mixture(recipe: Recipe, built: Mapping[str, Path], task: str, run: Path) -> Path:
    """Export the sources in YOLO format, and write a `data.yaml` with their weights.

    Parameters
    ----------
    recipe : Recipe
        Sources and their weights.
    built : mapping of str to Path
        Folders of the built sources, by name.
    task : str
        'seg' or 'pose'.
    run : Path
        Folder of the training run.

    Returns
    -------
    Path
        The data.yaml: `train` and `val` are lists of folders, `weights` has a weight for each
        folder of `train`.
    """
    yaml = import_module("yaml")
    run = run.resolve()  # Ultralytics resolves relative paths against the folder of the YAML file
    values: dict[str, Any] = {"train": [], "weights": [], "val": []}
    cards = ["# Mixture", "", "| source | of the pictures seen |", "|---|--:|"]
    cards += [
        f"| {source.name} | {source.weight:.0%} |" for source in recipe.sources if source.weight
    ]
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
    """Export a source in YOLO format with its card, unless the export is up to date."""
    card = folder / DATA_CARD
    labels = built / "annotations.json"
    if card.is_file() and card.stat().st_mtime >= labels.stat().st_mtime:
        return
    dataset = read_coco(built)
    splits = [split for split in ("train", "val") if dataset.in_split(split)]
    write_yolo(dataset, folder, TASKS[task], splits=splits)
    card.write_text(data_card(dataset, source.name), encoding="utf-8")


_PLOTTED = ("photos all", "half all: recall", "drawn")  # prefixes of the plotted columns
_TEST_FRAMES = 40


class Curve:
    """Accuracy curve of a training run.

    Parameters
    ----------
    task : str
        'seg' or 'pose'.
    photos : Path
        Folder of the audited photos; those of test scenes are evaluated.
    drawn : Path, optional
        Synthetic set; 40 pictures of its test split are evaluated.
    run : Path
        Folder for `curve.csv` and `curve.png`.
    """

    def __init__(self, task: str, photos: Path, drawn: Path | None, run: Path) -> None:
        self.task, self.run = task, run
        self._photos, self._drawn = photos, drawn

    def judge(self, network: Path, pictures: int) -> dict[str, float]:
        """Evaluate a checkpoint and add a point to the curve.

        Parameters
        ----------
        network : Path
            A checkpoint (.pt).
        pictures : int
            Number of pictures it has been trained on.

        Returns
        -------
        dict of str to float
            Recall and precision on photos, by test and at half size, at the default confidence
            threshold; mAP on synthetic frames, of boxes and of masks or keypoints.
        """
        onnx = export_yolo(load_yolo(network), self.run / "curve.onnx")
        point = self._on_photos(onnx) | self._on_drawn(onnx)
        rows = [
            row for row in read_rows(self.run / "curve.csv") if int(row["pictures"]) != pictures
        ]
        rows.append({"pictures": pictures, **{k: f"{v:.4f}" for k, v in point.items()}})
        rows.sort(key=lambda row: int(row["pictures"]))
        write_rows(self.run / "curve.csv", rows)
        draw_curve(self.run / "curve.csv", self.run / "curve.png")
        return point

    def _networks(self, onnx: Path, *, ranked: bool) -> Networks:
        """Load a detector with the pose network in use, or a pose network alone."""
        pair = chosen_networks(onnx, None) if self.task == "seg" else (None, onnx)
        return open_networks(*pair, None, ranked=ranked)

    @cached_property
    def _audited(self) -> list[Photo]:
        return audited_photos(self._photos)[0]

    def _on_photos(self, onnx: Path) -> dict[str, float]:
        evaluation = evaluate_photos(self._audited, self._networks(onnx, ranked=False))
        point = {}
        for words, scores in (
            ("photos", evaluation.scores[:1] + evaluation.tests),
            ("half", evaluation.small),
        ):
            for name, score in scores:
                head = f"{words} {name}"
                for what, estimate in (("recall", score.recall), ("precision", score.precision)):
                    point[f"{head}: {what}"] = math.nan if estimate is None else estimate.value
        return point

    def _on_drawn(self, onnx: Path) -> dict[str, float]:
        if self._drawn is None:
            return {}
        networks = self._networks(onnx, ranked=True)
        frames = detect_set(read_held_out(self._drawn, "test", _TEST_FRAMES), networks)
        seg = self.task == "seg"
        stage = Stage.SEGMENTED if seg else Stage.POSED
        boxes = average_precision(frames, IouType.BOXES, stage)
        precision = average_precision(frames, IouType.MASKS if seg else IouType.KEYPOINTS, stage)
        return {
            "drawn_map50": boxes.map50,
            "drawn_map50_95": boxes.map50_95,
            "drawn_masks_map50_95" if seg else "drawn_points_map50_95": precision.map50_95,
        }


def draw_curve(table: Path, out: Path) -> None:
    """Plot the curve's CSV file as a PNG.

    Parameters
    ----------
    table : Path
        `curve.csv`.
    out : Path
        The file to write; skipped if matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return
    rows = read_rows(table)
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot()
    thousands = [int(row["pictures"]) / 1000 for row in rows]
    keys = dict.fromkeys(key for row in rows for key in row)
    names = [key for key in keys if key.startswith(_PLOTTED)]
    for name in names:
        axes.plot(
            thousands, [float(row.get(name) or "nan") for row in rows], marker=".", label=name
        )
    axes.set(xlabel="pictures seen, thousands", ylabel="share", ylim=(0, 1))
    axes.grid(visible=True, alpha=0.3)
    axes.legend(fontsize="small", loc="lower right")
    figure.savefig(out, dpi=120)
