"""Read a training recipe from a TOML file, and build each of its sources once."""

from __future__ import annotations

import tomllib
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from cucumbervision.capture.pictures import read_color, write_jpeg
from cucumbervision.errors import TrainingError
from cucumbervision.files import read_text
from cucumbervision.perception.keypoint_axis import keypoints_between
from cucumbervision.perception.yolo_layout import BY_PLACE
from cucumbervision_lab.datasets.coco import read_coco, write_coco
from cucumbervision_lab.datasets.derive import add_pseudo_masks, merge_datasets
from cucumbervision_lab.datasets.labels import KEYPOINT_ORDER, DataSet, Label, LabelledPicture
from cucumbervision_lab.datasets.polygons import DIRECTIONS, keypoints_of_mask
from cucumbervision_lab.datasets.windows import write_sheets, write_windows
from cucumbervision_lab.detection.photo_audit import audited
from cucumbervision_lab.detection.pictures import spread
from cucumbervision_lab.synthesis.colors import d435_colors
from cucumbervision_lab.synthesis.generate import generate, parse_options
from cucumbervision_lab.training.plan import parse_plan

_ASSETS = ("backgrounds", "textures", "hdri*")
_MOST_HIDDEN = 0.05


def build_sources(
    recipe: Recipe, data: Path, out: Path, workers: int = 1, log: Callable[[str], None] = print
) -> dict[str, Path]:
    """Build the sources of a recipe that are missing or out of date.

    Parameters
    ----------
    recipe : Recipe
        The recipe.
    data : Path
        Folder that contains the picture folders of the recipe. Assets for synthetic frames are read
        from its `backgrounds`, `textures` and `hdri*`.
    out : Path
        Folder for the built sources, one subfolder each.
    workers : int
        Number of processes that draw synthetic frames.
    log : callable
        Called with a line of text for each source.

    Returns
    -------
    dict of str to Path
        Folders of the sets, by source name.

    Raises
    ------
    TrainingError, DataSetError, CaptureError
        If the pictures of a source are missing or unusable.
    """
    built: dict[str, Path] = {}
    for source in recipe.sources:
        folder = out / source.name
        done = folder / "built.json"
        description = repr(source)
        if not (done.is_file() and done.read_text(encoding="utf-8") == description):
            log(f"building {source.name}")
            _build(source, built, data, folder, workers)
            done.write_text(description, encoding="utf-8")
        built[source.name] = folder
    return built


def _build(
    source: Source, built: dict[str, Path], data: Path, folder: Path, workers: int
) -> DataSet:
    if source.kind in ("photos", "set"):
        return _photos(source, data, folder)
    if source.kind == "drawn":
        return _drawn(source, built, data, folder, workers)
    if source.kind == "montage":
        return _montage(source, built, folder, workers)
    (dataset,) = (read_coco(built[name]) for name in source.of)
    if source.kind == "windows":
        return _windows(source, dataset, folder)
    if source.kind == "d435-colors":
        return _d435_colors(source, dataset, folder)
    return _sheets(source, dataset, folder)


def _photos(source: Source, data: Path, folder: Path) -> DataSet:
    """Collect real pictures except test scenes, and segment fruit that have no mask."""
    from cucumbervision.perception.networks import open_segmenter

    place = data / source.folder
    if source.kind == "photos":
        audit = audited(place, outlines=True)
        pictures = [p for p in audit.pictures if p.extras["fully_labelled"] or p.shows_fruit]
    else:
        audit = read_coco(place)
        pictures = list(audit.pictures)
    split_pictures = [p for p in pictures if p.split in ("train", "val")]
    limited = _limit_per_scene(split_pictures, source.most)
    if not limited:
        raise TrainingError(
            "contains no training pictures", source=place, remedy="give another folder"
        )
    plain = tuple(replace(p, extras={}) for p in limited)
    outlined = _known_labels(folder)
    plain = tuple(replace(p, labels=outlined.get(_identity(p), p.labels)) for p in plain)
    boxed = replace(audit, pictures=plain, refused=())
    drawn = add_pseudo_masks(boxed, open_segmenter())
    return write_coco(with_axis_points(drawn.dataset), folder)


def _known_labels(folder: Path) -> dict[tuple[object, ...], tuple[Label, ...]]:
    """Return the labels with masks from an earlier build of the folder."""
    if not (folder / "annotations.json").is_file():
        return {}
    return {_identity(p): p.labels for p in read_coco(folder).pictures if p.labels}


def _identity(picture: LabelledPicture) -> tuple[object, ...]:
    boxes = tuple(tuple(np.round(label.box, 1).tolist()) for label in picture.labels)
    return picture.source, picture.width, picture.height, boxes


def _limit_per_scene(pictures: Sequence[LabelledPicture], limit: int) -> list[LabelledPicture]:
    """Keep at most `most` evenly spaced pictures per scene, because near-duplicates add little."""
    scenes: dict[str, list[LabelledPicture]] = defaultdict(list)
    for picture in pictures:
        scenes[picture.scene or picture.file].append(picture)
    limited: list[LabelledPicture] = []
    for members in scenes.values():
        limited += spread(members, limit)
    return limited


def with_axis_points(dataset: DataSet) -> DataSet:
    """Add keypoints along the mask's axis to every complete fruit that has none.

    If the stem end is unknown, the keypoints are ordered by position, and the label's extras note
    this. Such labels suit pose networks with `by_place`; they say nothing of the stem end.

    Parameters
    ----------
    dataset : DataSet
        Data set with masks.

    Returns
    -------
    DataSet
        Fruit that are hidden, cut off, round or strongly bent stay without keypoints.
    """
    pictures = tuple(
        replace(p, labels=tuple(_with_points(label) for label in p.labels))
        for p in dataset.pictures
    )
    return replace(dataset, pictures=pictures)


def _with_points(label: Label) -> Label:
    mask = label.mask
    hidden = (label.hidden_share or 0.0) > _MOST_HIDDEN
    if mask is None or label.keypoints is not None or label.ignore or label.cut_off or hidden:
        return label
    ends = label.extras.get("ends_px")
    points = None if ends is None else keypoints_between(mask, ends)
    if points is not None:
        return replace(label, keypoints=np.column_stack([points, np.full(len(points), 2.0)]))
    noted = label.extras.get("stem")
    directed = noted in DIRECTIONS
    for stem in [str(noted)] if directed else ["right", "up"]:
        points = keypoints_of_mask(mask, stem)
        if points is not None:
            extras = label.extras if directed else {**label.extras, KEYPOINT_ORDER: BY_PLACE}
            return replace(label, keypoints=points, extras=extras)
    return label


def _drawn(
    source: Source, built: dict[str, Path], data: Path, folder: Path, workers: int
) -> DataSet:
    assets = _assets(data, folder.parent / "assets")
    width, height = source.size

    def frames(out: Path, count: int, seed: int, split: str) -> DataSet:
        options = parse_options(
            frames=count,
            seed=seed,
            size=f"{width}x{height}",
            shares=source.shares,
            split=split,
            assets=assets,
            paste=built[source.paste[0]] if source.paste and split == "train" else None,
            depth=False,
            hard=source.hard and split == "train",
        )
        return generate(options, out, workers)

    made = frames(folder.parent / f"{source.name}-train", source.count, source.seed, "train")
    sets = [made]
    if source.validate:
        sets.append(
            frames(folder.parent / f"{source.name}-val", source.validate, source.seed + 1, "val")
        )
    return merge_datasets(sets, folder)


def _assets(data: Path, folder: Path) -> Path | None:
    """Link the assets for synthetic frames into `folder`, except photos of test scenes."""
    files = [
        path
        for pattern in _ASSETS
        for top in data.glob(pattern)
        for path in sorted(top.rglob("*"))
        if path.is_file()
    ]
    if not files:
        return None
    held_back = audited(data, "test")
    hidden = {held_back.path(picture).resolve() for picture in held_back.pictures}
    for path in files:
        link = folder / path.relative_to(data)
        if path.resolve() not in hidden and not link.exists():
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(path.resolve())
    return folder


def _montage(source: Source, built: dict[str, Path], folder: Path, workers: int) -> DataSet:
    width, height = source.size
    options = parse_options(
        frames=source.count,
        seed=source.seed,
        size=f"{width}x{height}",
        shares=source.shares,
        split="train",
        paste=built[source.paste[0]],
        onto=built[source.of[0]],
        depth=False,
    )
    return generate(options, folder, workers)


def _windows(source: Source, dataset: DataSet, folder: Path) -> DataSet:
    held_back = spread(dataset.in_split("val"), source.validate)
    subset = replace(dataset, pictures=(*dataset.in_split("train"), *held_back))
    sets = [
        write_windows(
            subset,
            folder.parent / f"{source.name}-{side}",
            side,
            splits=("train", "val"),
            seed=source.seed,
        )
        for side in source.size
    ]
    return merge_datasets(sets, folder)


def _sheets(source: Source, dataset: DataSet, folder: Path) -> DataSet:
    (side,) = source.size
    sets = [
        write_sheets(
            dataset,
            folder.parent / f"{source.name}-{split}",
            count,
            side,
            split=split,
            seed=source.seed,
        )
        for split, count in (("train", source.count), ("val", source.validate))
        if count and dataset.in_split(split)
    ]
    return merge_datasets(sets, folder)


def _d435_colors(source: Source, dataset: DataSet, folder: Path) -> DataSet:
    rng = np.random.default_rng(source.seed)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    pictures = []
    for number, picture in enumerate(dataset.in_split("train")):
        file = f"images/{number:05d}.jpg"
        write_jpeg(folder / file, d435_colors(read_color(dataset.path(picture)), rng))
        pictures.append(replace(picture, file=file))
    return write_coco(replace(dataset, folder=folder, pictures=tuple(pictures)), folder)


_KINDS = ("photos", "set", "drawn", "montage", "windows", "sheets", "d435-colors")
"""Kinds of sources; see `Source`."""

ORIGINAL = ("photos", "set", "drawn")
"""Kinds of sources that are not derived from other sources."""


@dataclass(frozen=True)
class Source:
    """A source of training pictures.

    Parameters
    ----------
    name : str
        Name of the source and of its folder.
    kind : str
        'photos': the audited photos below a folder, with masks by SAM. 'set': a labelled set, with
        masks by SAM if it has boxes only. 'drawn': synthetic frames from `synth`, optionally with
        pasted fruit of the source `paste`. 'montage': fruit of `paste` on the photos without fruit
        of `of`. 'windows': crops of `of`. 'sheets': mosaics of downscaled pictures of `of`.
        'd435-colors': pictures of `of` with the colours of a D435 in a greenhouse.
    weight : float
        Share of this source in the training pictures; 0 for a source that others are derived from.
    folder : str
        Folder of 'photos' and 'set', relative to the data folder.
    of, paste : tuple of str
        Names of earlier sources.
    count : int
        Number of frames, montages or sheets.
    size : tuple of int
        Width and height of frames and montages; sides of windows; side of sheets; pixels.
    shares : str
        For 'drawn': weights of hanging, bench and crate scenes.
    hard : bool
        For 'drawn': see `synth --hard`.
    most : int
        For 'photos' and 'set': maximum number of pictures per scene.
    seed : int
        Random seed.
    validate : int
        Number of validation pictures. For 'photos' and 'set', any value but 0 uses the whole split
        `val`.
    """

    name: str
    kind: str
    weight: float = 0.0
    folder: str = ""
    of: tuple[str, ...] = ()
    paste: tuple[str, ...] = ()
    count: int = 0
    size: tuple[int, ...] = ()
    shares: str = "0.6,0.22,0.18"
    hard: bool = False
    most: int = 15
    seed: int = 0
    validate: int = 0


@dataclass(frozen=True)
class Schedule:
    """Training schedule of one network.

    Parameters
    ----------
    init : str
        Initial weights, relative to the weights folder.
    plan : str
        Plan in the format of `parse_plan`.
    per_epoch : int
        Pictures between two checkpoints.
    validate_every, judge_every : int
        Epochs between two validations, and between two points of the accuracy curve.
    learning_rate, one_to_many, freeze
        See `TrainOptions`.
    """

    init: str
    plan: str
    per_epoch: int = 500
    validate_every: int = 4
    judge_every: int = 8
    learning_rate: float = 0.0005
    one_to_many: float = 0.3
    freeze: int = -1


@dataclass(frozen=True)
class Recipe:
    """A training recipe.

    Parameters
    ----------
    sources : tuple of Source
        Sources in build order.
    schedules : dict of str to Schedule
        Schedules by task, 'seg' and 'pose'.
    """

    sources: tuple[Source, ...]
    schedules: dict[str, Schedule] = field(default_factory=dict)

    def source(self, name: str) -> Source:
        """Return the source called `name`."""
        return next(source for source in self.sources if source.name == name)


def read_recipe(path: Path) -> Recipe:
    """Read a recipe from a TOML file.

    Parameters
    ----------
    path : Path
        A file with a table `[seg]`, `[pose]` or both (see `Schedule`), and `[[source]]` tables (see
        `Source`).

    Raises
    ------
    TrainingError
        If the file cannot be read, or a key, name, plan or kind is invalid.
    """
    try:
        values = tomllib.loads(read_text(path, TrainingError))
    except (ValueError, RecursionError) as error:
        raise TrainingError(
            f"the recipe cannot be read ({error})", source=path, remedy="give a TOML file"
        ) from error
    try:
        tables = values.pop("source", [])
        sources = tuple(Source(**_typed(Source, table)) for table in tables)
        schedules = {task: Schedule(**table) for task, table in values.items()}
        for task, schedule in schedules.items():
            if task not in ("seg", "pose"):
                raise ValueError(f"unknown task {task!r}")
            parse_plan(schedule.plan, schedule.per_epoch)
        _check(sources)
    except (TypeError, ValueError, AttributeError, LookupError, OverflowError) as error:
        raise TrainingError(str(error), source=path, remedy="correct the recipe") from error
    except TrainingError as error:
        raise error.at(path) from error
    return Recipe(sources, schedules)


def _typed(kind: type, table: dict[str, Any]) -> dict[str, Any]:
    """Convert lists, and single values of tuple fields, to tuples."""
    many = {field.name for field in fields(kind) if str(field.type).startswith("tuple")}
    return {
        key: tuple(value if isinstance(value, list) else [value]) if key in many else value
        for key, value in table.items()
    }


def _check(sources: tuple[Source, ...]) -> None:
    names: set[str] = set()
    for source in sources:
        if source.kind not in _KINDS:
            raise ValueError(f"{source.name}: unknown kind {source.kind!r}")
        if source.name in names:
            raise ValueError(f"duplicate source {source.name!r}")
        for parent in (*source.of, *source.paste):
            if parent not in names:
                raise ValueError(f"{source.name}: no earlier source is called {parent!r}")
        if source.kind not in ORIGINAL and not source.of:
            raise ValueError(f"{source.name}: 'of' is missing")
        names.add(source.name)
    if not sum(source.weight for source in sources) > 0:
        raise ValueError("no source has a weight")
    if not any(source.validate for source in sources):
        raise ValueError("no source has validation pictures")
