"""Build the sources of a recipe, each as a labelled set in a folder of its own."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.capture.pictures import read_color, write_jpeg
from cucumbervision.errors import TrainingError
from cucumbervision.perception.keypoint_axis import keypoints_between
from cucumbervision.perception.yolo import BY_PLACE
from cucumbervision_lab.datasets.coco import read_coco, write_coco
from cucumbervision_lab.datasets.derive import add_pseudo_masks, merge_datasets
from cucumbervision_lab.datasets.labels import KEYPOINT_ORDER, DataSet, Label, LabelledPicture
from cucumbervision_lab.datasets.polygons import (
    DIRECTIONS,
    keypoints_of_mask,
)
from cucumbervision_lab.datasets.windows import write_sheets, write_windows
from cucumbervision_lab.detection.photo_audit import audited
from cucumbervision_lab.synthesis.d435_colors import d435_colors
from cucumbervision_lab.synthesis.generate import generate, parse_options

if TYPE_CHECKING:
    from cucumbervision_lab.training.recipe import Recipe, Source

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
        wanted = repr(source)
        if not (done.is_file() and done.read_text(encoding="utf-8") == wanted):
            log(f"building {source.name}")
            _build(source, built, data, folder, workers)
            done.write_text(wanted, encoding="utf-8")
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
    (of,) = (read_coco(built[name]) for name in source.of)
    if source.kind == "windows":
        return _windows(source, of, folder)
    if source.kind == "d435-colors":
        return _d435_colors(source, of, folder)
    return _sheets(source, of, folder)


def _photos(source: Source, data: Path, folder: Path) -> DataSet:
    """Collect real pictures except test scenes, and segment fruit that have no mask."""
    from cucumbervision.perception.networks import open_segmenter

    place = data / source.folder
    if source.kind == "photos":
        found = audited(place, outlines=True)
        pictures = [p for p in found.pictures if p.extras["fully_labelled"] or p.shows_fruit]
    else:
        found = read_coco(place)
        pictures = list(found.pictures)
    kept = [p for p in pictures if p.split in ("train", "val")]
    limited = _limit_per_scene(kept, source.most)
    if not limited:
        raise TrainingError(
            "contains no training pictures", source=place, remedy="give another folder"
        )
    plain = tuple(replace(p, extras={}) for p in limited)
    known = _known_labels(folder)
    plain = tuple(replace(p, labels=known.get(_identity(p), p.labels)) for p in plain)
    boxed = replace(found, pictures=plain, refused=())
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


def _limit_per_scene(pictures: Sequence[LabelledPicture], most: int) -> list[LabelledPicture]:
    """Keep at most `most` evenly spaced pictures per scene, because near-duplicates add little."""
    scenes: dict[str, list[LabelledPicture]] = defaultdict(list)
    for picture in pictures:
        scenes[picture.scene or picture.file].append(picture)
    kept: list[LabelledPicture] = []
    for own in scenes.values():
        places = np.unique(np.linspace(0, len(own) - 1, min(most, len(own))).round().astype(int))
        kept += [own[k] for k in places]
    return kept


def with_axis_points(dataset: DataSet) -> DataSet:
    """Add keypoints along the mask's axis to every complete fruit that has none.

    If the stem end is unknown, the keypoints are ordered by position, and the label's extras note
    this. Such labels suit pose networks with `by_place`, but not `train ends`.

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
    known = noted in DIRECTIONS
    for stem in [str(noted)] if known else ["right", "up"]:
        points = keypoints_of_mask(mask, stem)
        if points is not None:
            extras = label.extras if known else {**label.extras, KEYPOINT_ORDER: BY_PLACE}
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


def _windows(source: Source, of: DataSet, folder: Path) -> DataSet:
    held_back = _first(of, "val", source.validate)
    some = replace(of, pictures=(*of.in_split("train"), *held_back))
    sets = [
        write_windows(
            some,
            folder.parent / f"{source.name}-{side}",
            side,
            splits=("train", "val"),
            seed=source.seed,
        )
        for side in source.size
    ]
    return merge_datasets(sets, folder)


def _sheets(source: Source, of: DataSet, folder: Path) -> DataSet:
    (side,) = source.size
    sets = [
        write_sheets(
            of, folder.parent / f"{source.name}-{split}", count, side, split=split, seed=source.seed
        )
        for split, count in (("train", source.count), ("val", source.validate))
        if count and of.in_split(split)
    ]
    return merge_datasets(sets, folder)


def _d435_colors(source: Source, of: DataSet, folder: Path) -> DataSet:
    rng = np.random.default_rng(source.seed)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    pictures = []
    for number, picture in enumerate(of.in_split("train")):
        file = f"images/{number:05d}.jpg"
        write_jpeg(folder / file, d435_colors(read_color(of.path(picture)), rng))
        pictures.append(replace(picture, file=file))
    return write_coco(replace(of, folder=folder, pictures=tuple(pictures)), folder)


def _first(dataset: DataSet, split: str, count: int) -> tuple[LabelledPicture, ...]:
    """Return `count` evenly spaced pictures of a split."""
    own = dataset.in_split(split)
    places = np.linspace(0, len(own) - 1, min(count, len(own))).round().astype(int)
    return tuple(own[k] for k in np.unique(places))
