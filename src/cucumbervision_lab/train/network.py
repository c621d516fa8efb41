"""Train YOLO26 on labelled sets by Ultralytics, offline; load and average its checkpoints."""

from __future__ import annotations

import importlib
import json
import math
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from cucumbervision.errors import MissingExtraError, ModelError, TrainingError
from cucumbervision.networks.keypoint_axis import keypoints_between
from cucumbervision.networks.runtime import import_onnxruntime
from cucumbervision.networks.yolo import BY_PLACE
from cucumbervision_lab.data.checks import check_dataset, open_dataset, require_clean
from cucumbervision_lab.data.coco import write_coco
from cucumbervision_lab.data.derive import add_pseudo_masks
from cucumbervision_lab.data.labels import (
    DIRECTIONS,
    KEYPOINT_ORDER,
    DataSet,
    Label,
    LabelledPicture,
    keep_classes,
    keypoints_of_mask,
)
from cucumbervision_lab.data.yolo import write_yolo
from cucumbervision_lab.evaluate.scenes import audited

_INTEGRATIONS = ("clearml", "comet", "dvc", "mlflow", "neptune", "raytune", "tensorboard", "wandb")

# Torch removes an operator's definition when its Library object is garbage-collected.
_libraries: list[Any] = []


def _import_torchvision() -> None:
    """Import torchvision, which Ultralytics needs for validation.

    A torchvision built for another torch fails to import because its operators are missing.
    Declaring the two operators lets the import succeed. They are never called here, because the
    one-to-one head needs no non-maximum suppression.
    """
    import torch

    try:
        importlib.import_module("torchvision")
    except RuntimeError as error:
        if "torchvision::nms" not in str(error):
            raise
        _libraries.append(torch.library.Library("torchvision", "DEF"))
        for name in ("nms", "qnms"):
            _libraries[-1].define(f"{name}(Tensor dets, Tensor scores, float iou) -> Tensor")
        # The failed import leaves partly initialised modules behind.
        for name in [n for n in sys.modules if n.partition(".")[0] == "torchvision"]:
            del sys.modules[name]
        importlib.import_module("torchvision")


def import_ultralytics() -> Any:
    """Import Ultralytics with telemetry, integrations, downloads and installs disabled.

    Returns
    -------
    module
        The `ultralytics` package.

    Raises
    ------
    MissingExtraError
        If Ultralytics is not installed.
    """
    os.environ["YOLO_OFFLINE"] = "1"
    os.environ["YOLO_AUTOINSTALL"] = "False"
    os.environ.setdefault("YOLO_VERBOSE", "False")
    # Imported first, because Ultralytics would import it with telemetry enabled.
    import_onnxruntime()
    try:
        # Ultralytics changes NumPy's print options globally.
        with np.printoptions():
            _import_torchvision()
            import ultralytics
            from ultralytics.utils import SETTINGS, events
    except ImportError as error:
        raise MissingExtraError(error.name or "ultralytics", "train") from error
    # `dict.__setitem__` changes the setting in this process only, not in the user's file.
    for name in ("sync", *_INTEGRATIONS):
        dict.__setitem__(SETTINGS, name, False)
    events.events.enabled = False
    return ultralytics


def load_yolo(checkpoint: Path | str) -> Any:
    """Load a YOLO26 .pt file, or random weights from an Ultralytics .yaml.

    A checkpoint is a pickle, which can contain code: load only what you trust.

    Raises
    ------
    ModelError
        If the checkpoint cannot be loaded.
    MissingExtraError
        If the extra `train` is not installed.
    """
    ultralytics = import_ultralytics()
    try:
        return ultralytics.YOLO(str(checkpoint))
    # Unpickling a broken checkpoint can raise anything.
    except Exception as error:
        raise ModelError(
            f"Ultralytics cannot load the checkpoint ({error})",
            source=checkpoint,
            remedy="give a YOLO26 checkpoint (.pt)",
        ) from error


def allowed_threads() -> int:
    """Return OMP_NUM_THREADS, or the number of cores; Ultralytics would choose others."""
    asked = os.environ.get("OMP_NUM_THREADS", "")
    return int(asked) if asked.isdigit() and int(asked) else os.cpu_count() or 1


def average_networks(first: Path, second: Path, out: Path, share: float = 0.5) -> Path:
    """Write the weighted mean of two checkpoints.

    Averaging the weights before and after fine-tuning reduces forgetting and improves accuracy on
    pictures that differ from the fine-tuning data (Wortsman et al., "Robust fine-tuning of
    zero-shot models", CVPR 2022).

    Parameters
    ----------
    first, second : Path
        Checkpoints (.pt) of the same architecture: `second` was fine-tuned from `first`, or both
        were fine-tuned from a third one.
    out : Path
        The checkpoint to write, in half precision.
    share : float
        Weight of `second`, 0 to 1.

    Raises
    ------
    ModelError
        If a file is not a checkpoint.
    TrainingError
        If the two architectures differ, or `share` is out of range.
    """
    if not 0 <= share <= 1:
        raise TrainingError(
            f"the share {share} is out of range", remedy="give a number from 0 to 1"
        )
    model = load_yolo(second)
    state_1, state_2 = (x.model.float().state_dict() for x in (load_yolo(first), model))
    if {k: v.shape for k, v in state_1.items()} != {k: v.shape for k, v in state_2.items()}:
        raise TrainingError(
            f"its architecture differs from {first.name}",
            source=second,
            remedy="give two checkpoints that were trained from the same weights",
        )
    for key, value in state_2.items():
        if value.is_floating_point():
            # The state dictionary refers to the network's own tensors: update them in place.
            value.copy_(state_1[key].lerp(value, share))
    model.save(out)
    return out


NETWORK = Path("weights", "last.pt")
"""The run's weights. The last ones are used: validation sees too few pictures to choose others."""

BEGUN = "begun.json"
"""File in a run's folder with what it began with."""

_AUGMENTATION: dict[str, Any] = {
    # Fruit hang or lie at any angle, and no keypoint is a left or right one.
    "degrees": 45.0,
    "flipud": 0.5,
    "fliplr": 0.5,
    "scale": 0.5,
    "translate": 0.1,
    "hsv_h": 0.02,
    "hsv_s": 0.6,
    "hsv_v": 0.45,
    "mosaic": 0.5,
    "erasing": 0.0,
}

# Turned or mirrored pictures would change the order of keypoints by place. Without outlines, a
# turned box is the bounding box of the old corners: far too wide for thin fruit.
_POSE_AUGMENTATION: dict[str, Any] = {"degrees": 0.0, "flipud": 0.0, "fliplr": 0.0}

_BATCH, _BATCH_ON_CARD = 8, 64
_SHOWN = ("metrics/precision(B)", "metrics/recall(B)", "metrics/mAP50-95(B)")


@dataclass(frozen=True)
class TrainOptions:
    """Training options.

    Parameters
    ----------
    epochs : int
        Number of passes over the training pictures.
    size_px : int
        Side of the square training pictures; a multiple of 32.
    batch : int
        Batch size; 0 selects 8 on the CPU and 64 on a GPU. The learning rate refers to a batch of
        8 and grows with the square root of the batch size.
    device : str
        'auto' (a GPU if available), 'cpu', or a GPU number.
    seed : int
        Random seed.
    learning_rate : float
        Initial learning rate of AdamW; it falls to a twentieth.
    freeze : int
        Number of layers to freeze, from the input.
    """

    epochs: int = 50
    size_px: int = 640
    batch: int = 0
    device: str = "auto"
    seed: int = 0
    learning_rate: float = 0.001
    freeze: int = 0


def train(
    task: str,
    datasets: Sequence[DataSet],
    out: Path,
    init: str,
    options: TrainOptions,
    log: Callable[[str], None] = print,
) -> Path:
    """Train a network for one task, or go on with an interrupted training.

    Parameters
    ----------
    task : str
        'seg' or 'pose'.
    datasets : sequence of DataSet
        See `write_training_data`; not used by a training that goes on.
    out : Path
        The run's folder: Ultralytics' `results.csv`, `args.yaml` and `weights/`.
    init : str
        Initial weights (.pt), or an Ultralytics .yaml for random weights. From a checkpoint of
        the other task, matching layers are used.
    options : TrainOptions
        Training options. A training that goes on takes only `batch` and `device` from them.
    log : callable
        Called with a line of text after each epoch, when the weights are written.

    Returns
    -------
    Path
        The weights.

    Raises
    ------
    TrainingError
        If the task, the data sets or the weights are unusable.
    ModelError
        If the weights cannot be loaded.
    MissingExtraError
        If the extra `train` is not installed.
    """
    if task not in TASKS:
        raise TrainingError(f"unknown task {task!r}", remedy="use seg or pose")
    last, device = out.resolve() / NETWORK, choose_device(options.device)
    batch = options.batch or (_BATCH if device == "cpu" else _BATCH_ON_CARD)
    machine = {"device": device, "batch": batch, "save_dir": str(out.resolve()), "exist_ok": True}
    if last.is_file():
        model = load_yolo(last)
        if model.task != TASKS[task]:
            raise TrainingError(
                f"contains a training for {model.task}", source=out, remedy="choose another folder"
            )
        # Ultralytics removes the optimiser at the end.
        if not (model.ckpt or {}).get("optimizer"):
            return last
        _prepare(model, log)
        model.train(resume=True, **machine)
        return last
    if init.endswith(".pt") and not Path(init).is_file():
        raise TrainingError(
            "weights not found; they are not downloaded automatically",
            source=init,
            remedy=f"download them from Ultralytics, or use --init yolo26n-{task}.yaml",
        )
    model = load_yolo(init)
    has_keypoints = init.endswith(".pt") and model.task == "pose"
    if model.task != TASKS[task]:
        scale = str(model.model.yaml.get("scale") or "n")
        model = load_yolo(f"yolo26{scale}-{task}.yaml").load(init)
    out.mkdir(parents=True, exist_ok=True)
    data = write_training_data(datasets, task, out)
    if task == "pose" and has_keypoints:
        # Ultralytics' default, four times as tolerant, lets a new head begin to learn.
        with data.open("a", encoding="utf-8") as file:
            file.write(f"kpt_oks_sigmas: {[KEYPOINT_SIGMA] * 5}\n")
    begun = {"task": task, "init": Path(init).name, **asdict(options)}
    (out / BEGUN).write_text(json.dumps(begun, indent=2) + "\n", encoding="utf-8")
    _prepare(model, log)
    model.train(
        data=str(data.resolve()),
        epochs=options.epochs,
        imgsz=options.size_px,
        seed=options.seed,
        optimizer="AdamW",
        lr0=options.learning_rate * math.sqrt(max(batch, _BATCH) / _BATCH),
        lrf=0.05,
        momentum=0.9,
        warmup_epochs=min(1.0, options.epochs / 10),
        warmup_bias_lr=0.0,
        nbs=max(_BATCH, batch),
        freeze=options.freeze or None,
        close_mosaic=max(1, options.epochs // 10),
        patience=0,
        plots=False,
        workers=0,
        deterministic=False,
        amp=device != "cpu",
        nms=False,  # the one-to-one head, which is exported, needs no suppression
        **machine,
        **_AUGMENTATION | (_POSE_AUGMENTATION if task == "pose" else {}),
    )
    return last


def _prepare(model: Any, log: Callable[[str], None]) -> None:
    """Let a training use the user's threads, report, and note the order of keypoints."""
    import torch

    def start(trainer: Any) -> None:
        torch.set_num_threads(allowed_threads())
        if trainer.args.task == "pose":
            for network in (trainer.model, trainer.ema.ema):
                network.keypoint_order = BY_PLACE

    def report(trainer: Any) -> None:
        figures = (f"{name[8:]} {trainer.metrics.get(name, math.nan):.3f}" for name in _SHOWN)
        log(f"epoch {trainer.epoch + 1} of {trainer.epochs}  {'  '.join(figures)}")

    model.add_callback("on_train_start", start)
    model.add_callback("on_model_save", report)


def choose_device(requested: str) -> str:
    """Return the device to train on: for 'auto' the first CUDA GPU, or the CPU."""
    if requested != "auto":
        return requested
    import_ultralytics()  # raises a clear error if the extra is missing
    import torch

    return "0" if torch.cuda.is_available() else "cpu"


TASKS = {"seg": "segment", "pose": "pose"}
"""Task names of the commands, and their names in Ultralytics."""

KEYPOINT_SIGMA = 0.05
"""Standard deviation of every keypoint in object keypoint similarity (loss and validation)."""

DATA_CARD = "data.md"
"""File name of the data sets' card in the run's folder."""

_KEYPOINTS = 5
_MOST_HIDDEN = 0.05
_FRUIT = ("cucumber", "zucchini")  # classes of the audit


def open_sets(folders: Sequence[Path]) -> list[DataSet]:
    """Read and check data sets; one that is named twice is read once.

    Raises
    ------
    DataSetError
        If a data set cannot be read or has faults.
    """
    read: dict[Path, DataSet] = {}
    for folder in folders:
        if folder not in read:
            read[folder] = open_dataset(folder)
            require_clean(check_dataset(read[folder]), folder)
    return [read[folder] for folder in folders]


def write_training_data(datasets: Sequence[DataSet], task: str, run: Path) -> Path:
    """Write data sets in YOLO format to the run's folder, with one `data.yaml` and card of all.

    For 'pose', keypoints are ordered by their position in the picture, which a network learns
    within hours; `cucumber-fruit` tells the stem end later. Hidden ones become unlabelled, because
    Ultralytics' keypoint confidence separates labelled from unlabelled ones.

    Parameters
    ----------
    datasets : sequence of DataSet
        One class each. A set given twice counts twice in training.
    task : str
        'seg' or 'pose'.
    run : Path
        Folder of the training run.

    Returns
    -------
    Path
        The data.yaml.

    Raises
    ------
    DataSetError
        If a picture has no split, or a label lacks a mask for 'seg'.
    TrainingError
        If a set has more than one class, or there are no training or validation pictures.
    """
    content: dict[str, Any] = {"train": [], "val": [], "names": {0: datasets[0].categories[0]}}
    unique = list({id(dataset): dataset for dataset in datasets}.values())
    for number, dataset in enumerate(unique):
        if len(dataset.categories) != 1:
            raise TrainingError(
                f"has {len(dataset.categories)} classes, expected 1",
                source=dataset.folder,
                remedy="keep one class",
            )
        folder = (run / "data" / str(number)).resolve()
        if task == "pose":
            dataset = _each_label(dataset, _ordered_by_place)
        counts, _ = write_yolo(dataset, folder, TASKS[task], splits=("train", "val"))
        times = {"train": sum(entry is unique[number] for entry in datasets), "val": 1}
        for split in times:
            if counts[split]:
                content[split] += times[split] * [str(folder / "images" / split)]
    for split in ("train", "val"):
        if not content[split]:
            raise TrainingError(
                f"the split {split} is missing",
                source=datasets[0].folder,
                remedy=f"add {split} pictures: cucumbervision data split",
            )
    if task == "pose":
        content |= {"kpt_shape": [_KEYPOINTS, 3], "flip_idx": list(range(_KEYPOINTS))}
    cards = [data_card(dataset, f"Trained on {dataset.folder.name}") for dataset in unique]
    (run / DATA_CARD).write_text("\n\n".join(cards), encoding="utf-8")
    file = run / "data.yaml"
    file.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return file


def _each_label(dataset: DataSet, change: Any) -> DataSet:
    pictures = (
        replace(picture, labels=tuple(change(label) for label in picture.labels))
        for picture in dataset.pictures
    )
    return replace(dataset, pictures=tuple(pictures))


def _ordered_by_place(label: Label) -> Label:
    """Order keypoints so that the last is further right and up; the order flips for few fruit."""
    if label.keypoints is None:
        return label
    points = label.keypoints
    labelled = points[points[:, 2] > 0]
    if len(labelled) < 2:
        return replace(label, keypoints=None)
    x, y = labelled[-1, :2] - labelled[0, :2]
    ordered = points[::-1] if x < y else points
    return replace(label, keypoints=np.where(ordered[:, 2:] == 2, ordered, 0.0))


def data_card(dataset: DataSet, title: str) -> str:
    """Return a Markdown table of a data set's sources, licences and picture counts.

    Examples
    --------
    >>> from cucumbervision_lab.data.labels import LabelledPicture
    >>> picture = LabelledPicture("a.png", 64, 48, source="own house", licence="CC0-1.0")
    >>> print(data_card(DataSet(Path(), (picture, picture)), "Set"))
    # Set
    <BLANKLINE>
    | source | licence | pictures | with fruit | fruit |
    |---|---|--:|--:|--:|
    | own house | CC0-1.0 | 2 | 0 | 0 |
    """
    groups: dict[tuple[str, str], list[LabelledPicture]] = {}
    for picture in dataset.pictures:
        key = (picture.source or "not stated", picture.licence or "not stated")
        groups.setdefault(key, []).append(picture)
    lines = [f"# {title}", "", "| source | licence | pictures | with fruit | fruit |"]
    lines.append("|---|---|--:|--:|--:|")
    for (source, licence), members in sorted(groups.items()):
        fruit = [sum(not label.ignore for label in picture.labels) for picture in members]
        counts = len(members), np.count_nonzero(fruit), sum(fruit)
        # Escape the column separator.
        cells = (source.replace("|", "\\|"), licence.replace("|", "\\|"), *map(str, counts))
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def photo_set(folder: Path, out: Path) -> DataSet:
    """Write the audited photos below a folder, except those of test scenes, as a labelled set.

    Fruit without an outline get a mask by SAM; complete fruit get keypoints along the mask's axis,
    ordered by place where the stem end is not directed.

    Parameters
    ----------
    folder : Path
        Folder of the photos, searched recursively.
    out : Path
        Folder of the set.

    Raises
    ------
    DataSetError, CaptureError
        If there is no such photo, or one cannot be read.
    """
    from cucumbervision.networks.find import open_segmenter

    audit = keep_classes(audited(folder, outlines=True), dict.fromkeys(_FRUIT, "cucumber"))
    pictures = tuple(
        replace(picture, extras={})
        for picture in audit.pictures
        if picture.split != "test" and (picture.extras["fully_labelled"] or picture.shows_fruit)
    )
    drawn, _ = add_pseudo_masks(replace(audit, pictures=pictures), open_segmenter())
    return write_coco(_each_label(drawn, _with_axis_points), out)


def _with_axis_points(label: Label) -> Label:
    mask = label.mask
    ends = None if label.keypoints is None else label.keypoints[[0, -1], :2]
    label = replace(label, keypoints=None)
    hidden = (label.hidden_share or 0.0) > _MOST_HIDDEN
    if mask is None or label.ignore or label.cut_off or hidden:
        return label
    points = None if ends is None else keypoints_between(mask, ends)
    if points is not None:
        return replace(label, keypoints=np.column_stack([points, np.full(len(points), 2.0)]))
    stem = label.extras.get("stem")
    directed = stem in DIRECTIONS
    for direction in [str(stem)] if directed else ["right", "up"]:
        points = keypoints_of_mask(mask, direction)
        if points is not None:
            order = {} if directed else {KEYPOINT_ORDER: BY_PLACE}
            return replace(label, keypoints=points, extras={**label.extras, **order})
    return label
