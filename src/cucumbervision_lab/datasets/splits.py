"""Train, val and test that share no scene."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.errors import DataSetError
from cucumbervision_lab.datasets.fingerprints import take_fingerprints, views_of_one_scene
from cucumbervision_lab.datasets.labels import SPLITS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from cucumbervision_lab.datasets.labels import DataSet, LabelledPicture

__all__ = ["SHARES", "find_scenes", "scenes_by_name", "split_by_scene"]

SHARES = (0.70, 0.15, 0.15)
"""Of the pictures, in train, val and test: the paper's."""

_EXPORTED = re.compile(r"\.rf\.[0-9a-f]+$", re.IGNORECASE)


def scenes_by_name(dataset: DataSet, pattern: str) -> DataSet:
    r"""Name each picture's scene by what a regular expression finds in its file name.

    Parameters
    ----------
    dataset : DataSet
        Scenes that are known are kept.
    pattern : str
        The first group, or all that matches, is the scene. A picture without a match keeps none.

    Raises
    ------
    DataSetError
        If the pattern is no regular expression.

    Examples
    --------
    >>> from pathlib import Path
    >>> from cucumbervision_lab.datasets.labels import DataSet, LabelledPicture
    >>> one = LabelledPicture("images/round3_row12_0007.jpg", 64, 48)
    >>> scenes_by_name(DataSet(Path("x"), (one,)), r"(round\d+_row\d+)").pictures[0].scene
    'round3_row12'
    """
    try:
        compiled = re.compile(pattern)
    except re.error as error:
        raise DataSetError(f"{pattern!r} is no regular expression ({error})") from None
    pictures = []
    for picture in dataset.pictures:
        match = None if picture.scene else compiled.search(picture.file)
        scene = picture.scene if match is None else match.group(1 if compiled.groups else 0)
        pictures.append(replace(picture, scene=scene or ""))
    return replace(dataset, pictures=tuple(pictures))


def find_scenes(dataset: DataSet, progress: Callable[[int], None] | None = None) -> DataSet:
    """Name the scenes of pictures that have none: near-duplicates share one.

    Two pictures are of one scene if their colours are alike or many corners agree
    (`fingerprints`), or if Roboflow made both of one picture; so are all that chains of such pairs
    join. It rather joins two scenes than parts one: a joined pair only makes a split coarser, a
    parted one makes it worthless.

    Parameters
    ----------
    dataset : DataSet
        Scenes that are known are kept.
    progress : callable, optional
        Called with 1 after each picture looked at.

    Raises
    ------
    CaptureError
        If a picture cannot be read.
    """
    without = [p for p in dataset.pictures if not p.scene]
    prints = take_fingerprints([dataset.path(p) for p in without], progress)
    pairs = views_of_one_scene(prints) + _exports_of_one(without)
    groups = _joined(len(without), pairs)
    taken = {p.scene for p in dataset.pictures}
    names: dict[int, str] = {}
    for group in dict.fromkeys(groups):
        # The scene is called after its first picture: the same at every run.
        name = PurePosixPath(without[group].file).stem
        while name in taken:
            name += "'"
        taken.add(name)
        names[group] = name
    scenes = {p.file: names[group] for p, group in zip(without, groups, strict=True)}
    pictures = tuple(replace(p, scene=scenes.get(p.file, p.scene)) for p in dataset.pictures)
    return replace(dataset, pictures=pictures)


def _exports_of_one(pictures: Sequence[LabelledPicture]) -> list[tuple[int, int]]:
    first: dict[str, int] = {}
    pairs = []
    for k, picture in enumerate(pictures):
        stem = PurePosixPath(picture.file).stem
        original = _EXPORTED.sub("", stem)
        if original != stem and first.setdefault(original, k) != k:
            pairs.append((first[original], k))
    return pairs


def _joined(count: int, pairs: Sequence[tuple[int, int]]) -> list[int]:
    """Give each index the smallest one that a chain of pairs joins it to.

    Examples
    --------
    >>> _joined(5, [(1, 3), (3, 4)])
    [0, 1, 2, 1, 1]
    """
    group = np.arange(count)
    for i, j in pairs:
        a, b = sorted((group[i], group[j]))
        group[group == b] = a
    return [int(g) for g in group]


def split_by_scene(dataset: DataSet, shares: Sequence[float] = SHARES, *, seed: int = 0) -> DataSet:
    """Put every picture in train, val or test, whole scenes together.

    Each source is split by itself, large scenes first, each to the split that lacks most of what
    the scene holds (pictures with and without fruit). So the large scenes come to train, and val
    and test get many small ones.

    Parameters
    ----------
    dataset : DataSet
        Every picture with a scene. Splits that it has are replaced.
    shares : sequence of float, length 3
        Of train, val and test.
    seed : int
        Orders scenes of the same size.

    Returns
    -------
    DataSet
        A scene with pseudo-labels is never in test.

    Raises
    ------
    DataSetError
        If a picture has no scene, or the shares are none.

    Examples
    --------
    >>> from pathlib import Path
    >>> from cucumbervision_lab.datasets.labels import DataSet, LabelledPicture
    >>> made = [LabelledPicture(f"{k}.png", 64, 48, scene=f"s{k // 2}") for k in range(40)]
    >>> parted = split_by_scene(DataSet(Path("x"), tuple(made)))
    >>> [len(parted.in_split(split)) for split in SPLITS]
    [28, 6, 6]
    """
    parts = np.array(shares, np.float64)
    if parts.shape != (3,) or (parts < 0).any() or not np.isclose(parts.sum(), 1) or parts[0] == 0:
        raise DataSetError(
            f"{' : '.join(f'{s:g}' for s in shares)} are no shares of train, val and test",
            remedy="give three that add up to 1, the first above 0",
        )
    bare = [p.file for p in dataset.pictures if not p.scene]
    if bare:
        raise DataSetError(
            f"{len(bare)} pictures have no scene, first {bare[0]}",
            source=dataset.folder,
            remedy="find scenes first, or name them by a pattern",
        )
    split_of = _assign(dataset.pictures, parts, np.random.default_rng(seed))
    pictures = tuple(replace(p, split=split_of[p.scene]) for p in dataset.pictures)
    return replace(dataset, pictures=pictures)


def _assign(
    pictures: Sequence[LabelledPicture], shares: np.ndarray, rng: np.random.Generator
) -> dict[str, str]:
    scenes: dict[str, list[LabelledPicture]] = {}
    for picture in pictures:
        scenes.setdefault(picture.scene, []).append(picture)
    # A scene that two sources share belongs to the first.
    sources: dict[str, list[str]] = {}
    for scene, own in sorted(scenes.items()):
        sources.setdefault(own[0].source, []).append(scene)
    split_of = {}
    for _, names in sorted(sources.items()):
        counts = {name: _content(scenes[name]) for name in names}
        missing = shares[:, None] * np.sum([counts[name] for name in names], axis=0)
        order = [names[k] for k in rng.permutation(len(names))]
        for name in sorted(order, key=lambda n: -counts[n].sum()):
            content = counts[name]
            lack = missing @ content
            lack[shares == 0] = -np.inf
            if any(label.pseudo for p in scenes[name] for label in p.labels):
                lack[SPLITS.index("test")] = -np.inf
            chosen = int(np.argmax(lack))
            missing[chosen] -= content
            split_of[name] = SPLITS[chosen]
    return split_of


def _content(pictures: Sequence[LabelledPicture]) -> np.ndarray:
    fruit = sum(any(not label.ignore for label in p.labels) for p in pictures)
    return np.array([fruit, len(pictures) - fruit], np.float64)
