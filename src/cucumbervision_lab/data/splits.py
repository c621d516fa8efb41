"""Find scenes of near-duplicate pictures, and split data sets by scene."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from cucumbervision.capture.pictures import read_color
from cucumbervision.errors import DataSetError
from cucumbervision_lab.arrays import Array32, Generator, Pixels, Progress
from cucumbervision_lab.data.labels import SPLITS, DataSet, LabelledPicture, ticked

_COPY_MOST_BITS = 6  # of 63; two photos of the same heap differ by at least 16

_COPY_MOST_COLOR = 0.3

_SCENE_COLOR = 0.42

_SCENE_CORNERS = 8

_NEAREST, _FAR_COLOR = 20, 0.6  # corners are compared only for the nearest pictures by colour

_SIDE, _COLOR_SIDE, _CORNER_SIDE = 32, 128, 320


def is_held_out(picture: LabelledPicture, every: int) -> bool:
    """Return whether a picture is for validation: one of so many scenes, and the split 'val'.

    A scene is recognised by its name, and held out in windows and sheets of other sets, too.

    Examples
    --------
    >>> from cucumbervision_lab.data.labels import LabelledPicture
    >>> scenes = [LabelledPicture("a.png", 8, 8, scene=f"scene {n}") for n in range(800)]
    >>> 80 < sum(is_held_out(picture, 8) for picture in scenes) < 120
    True
    >>> is_held_out(LabelledPicture("a.png", 8, 8, split="val"), 8)
    True
    """
    scene = crc32((picture.scene or picture.file).encode())
    return picture.split == "val" or scene % every == 0


@dataclass(frozen=True, eq=False)
class Fingerprint:
    """Features of a picture for finding near-duplicates.

    Parameters
    ----------
    hashes : ndarray of uint64, shape (8,)
        Perceptual hashes of the picture in all rotations and mirrored, 63 bits each.
    colors : ndarray of float32, shape (1536,)
        Square roots of a normalised CIELAB histogram without white and black backgrounds.
    points_px : ndarray of float32, shape (N, 2)
        Corners in the picture resized to 320 x 320.
    features : ndarray of uint8, shape (N, 32)
        ORB descriptors of the corners.
    """

    hashes: NDArray[np.uint64]
    colors: Array32
    points_px: Array32
    features: Pixels


def take_fingerprints(files: Sequence[Path], progress: Progress | None = None) -> list[Fingerprint]:
    """Compute the fingerprints of picture files.

    Raises
    ------
    CaptureError
        If a picture cannot be read.
    """
    import cv2

    corners = cv2.ORB_create(400)  # type: ignore[attr-defined,unused-ignore]
    return [_fingerprint(read_color(file), corners) for file in ticked(files, progress)]


def _fingerprint(color_rgb: Pixels, corners: Any) -> Fingerprint:
    import cv2

    def scaled(side: int) -> NDArray[Any]:
        return np.asarray(cv2.resize(color_rgb, (side, side), interpolation=cv2.INTER_AREA))

    grey = cv2.cvtColor(scaled(_SIDE), cv2.COLOR_RGB2GRAY).astype(np.float32)
    lab = cv2.cvtColor(scaled(_COLOR_SIDE), cv2.COLOR_RGB2LAB)
    shares = cv2.calcHist([lab], [0, 1, 2], None, [6, 16, 16], [0, 256, 64, 192, 64, 192])
    # Without white and black backgrounds, which would make all product photos similar.
    shares[0, 7:9, 7:9] = shares[-1, 7:9, 7:9] = 0
    colors = np.sqrt(shares.ravel() / max(float(shares.sum()), 1.0))
    points, features = corners.detectAndCompute(
        cv2.cvtColor(scaled(_CORNER_SIDE), cv2.COLOR_RGB2GRAY), None
    )
    return Fingerprint(
        np.array([_hash(turned) for turned in _turned(grey)], np.uint64),
        colors.astype(np.float32),
        np.array([p.pt for p in points], np.float32).reshape(-1, 2),
        np.zeros((0, 32), np.uint8) if features is None else features,
    )


def _turned(grey: Array32) -> Iterator[Array32]:
    for mirrored in (grey, grey[:, ::-1]):
        for quarter in range(4):
            yield np.ascontiguousarray(np.rot90(mirrored, quarter))


def _hash(grey: Array32) -> int:
    """Return the perceptual hash: low DCT frequencies above their median (Zauner 2010, pHash)."""
    import cv2

    coefficients = cv2.dct(grey)[:8, :8].ravel()[1:]
    return int.from_bytes(np.packbits(coefficients > np.median(coefficients)).tobytes(), "big")


def copies(prints: Sequence[Fingerprint]) -> list[tuple[int, int]]:
    """Return pairs of identical pictures, possibly resaved, rotated or mirrored, smaller first."""
    turned = np.array([f.hashes for f in prints], np.uint64).reshape(-1, 8)
    pairs = []
    for i, fingerprint in enumerate(prints):
        bits = np.bitwise_count(turned[i + 1 :] ^ fingerprint.hashes[0]).min(axis=1)
        for j in (i + 1 + np.flatnonzero(bits <= _COPY_MOST_BITS)).tolist():
            if float(fingerprint.colors @ prints[j].colors) >= 1 - _COPY_MOST_COLOR**2:
                pairs.append((i, j))
    return pairs


def _color_distances(prints: Sequence[Fingerprint]) -> Array32:
    """Return the pairwise Hellinger distances of the colour histograms, 0 to 1, shape (N, N)."""
    colors = np.stack([f.colors for f in prints])
    distances: Array32 = np.sqrt(np.maximum(0, 1 - colors @ colors.T))
    return distances


def _shared_corners(a: Fingerprint, b: Fingerprint) -> int:
    """Return the number of corner matches consistent with one similarity transform."""
    import cv2

    if min(len(a.features), len(b.features)) < 10:
        return 0
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(a.features, b.features, k=2)
    # Lowe 2004: a match is kept if it is clearly better than the second best.
    good = [m for m, second in pairs if m.distance < 0.75 * second.distance]
    if len(good) < _SCENE_CORNERS:
        return 0
    start, end = a.points_px[[m.queryIdx for m in good]], b.points_px[[m.trainIdx for m in good]]
    # Typed as Any, because OpenCV's stubs omit None.
    inliers: Any = cv2.estimateAffinePartial2D(start, end, ransacReprojThreshold=6)[1]
    return 0 if inliers is None else int(inliers.sum())


def views_of_one_scene(
    prints: Sequence[Fingerprint],
    *,
    color: float = _SCENE_COLOR,
    corners: int = _SCENE_CORNERS,
    wanted: Callable[[int, int], bool] | None = None,
) -> list[tuple[int, int]]:
    """Return the pairs of pictures that show the same scene.

    Parameters
    ----------
    prints : sequence of Fingerprint
        From `take_fingerprints`.
    color : float
        Maximum colour distance of pictures of one scene.
    corners : int
        Alternatively, minimum number of shared corners. Corners are compared only between
        pictures with similar colours.
    wanted : callable, optional
        Return whether a pair of indices is of interest.

    Returns
    -------
    list of (int, int)
        Pairs of indices, the smaller one first.
    """
    if len(prints) < 2:
        return []
    distances = _color_distances(prints)
    np.fill_diagonal(distances, np.inf)
    pairs = {(int(i), int(j)) for i, j in zip(*np.nonzero(distances < color), strict=True) if i < j}
    nearest = np.argsort(distances, axis=1, kind="stable")[:, :_NEAREST]
    candidates = {
        (min(i, int(j)), max(i, int(j)))
        for i, row in enumerate(nearest)
        for j in row
        if distances[i, j] < _FAR_COLOR
    }
    if wanted is not None:
        pairs = {pair for pair in pairs if wanted(*pair)}
        candidates = {pair for pair in candidates if wanted(*pair)}
    for i, j in sorted(candidates - pairs):
        if _shared_corners(prints[i], prints[j]) >= corners:
            pairs.add((i, j))
    return sorted(pairs)


_SHARES = (0.70, 0.15, 0.15)
"""Shares of train, val and test, as in the paper."""

_EXPORTED = re.compile(r"\.rf\.[0-9a-f]+$", re.IGNORECASE)


def scenes_by_name(dataset: DataSet, pattern: str) -> DataSet:
    r"""Set the scene of each picture from its file name with a regular expression.

    Parameters
    ----------
    dataset : DataSet
        Data set; existing scenes are kept.
    pattern : str
        Regular expression. The scene is the first group, or the whole match without groups.
        Pictures without a match keep no scene.

    Raises
    ------
    DataSetError
        If the pattern is not a valid regular expression.

    Examples
    --------
    >>> from pathlib import Path
    >>> from cucumbervision_lab.data.labels import DataSet, LabelledPicture
    >>> picture = LabelledPicture("images/round3_row12_0007.jpg", 64, 48)
    >>> scenes_by_name(DataSet(Path("x"), (picture,)), r"(round\d+_row\d+)").pictures[0].scene
    'round3_row12'
    """
    try:
        compiled = re.compile(pattern)
    except re.error as error:
        raise DataSetError(f"invalid regular expression {pattern!r} ({error})") from None
    pictures = []
    for picture in dataset.pictures:
        match = None if picture.scene else compiled.search(picture.file)
        scene = picture.scene if match is None else match.group(1 if compiled.groups else 0)
        pictures.append(replace(picture, scene=scene or ""))
    return replace(dataset, pictures=tuple(pictures))


def parse_shares(text: str, separator: str = ":") -> tuple[float, float, float]:
    """Parse three shares and normalise them to a sum of 1.

    Raises
    ------
    DataSetError
        If `text` does not contain three non-negative numbers with a positive sum.

    Examples
    --------
    >>> parse_shares("70:15:15")
    (0.7, 0.15, 0.15)
    """
    try:
        parts = [float(part) for part in text.split(separator)]
    except ValueError:
        parts = []
    if len(parts) != 3 or not 0 < sum(parts) < float("inf") or min(parts) < 0:
        remedy = f"give three numbers, as in 70{separator}15{separator}15"
        raise DataSetError(f"invalid shares {text!r}", source="--shares", remedy=remedy)
    a, b, c = (part / sum(parts) for part in parts)
    return a, b, c


def find_scenes(dataset: DataSet, progress: Progress | None = None) -> DataSet:
    """Group pictures without a scene into scenes of near-duplicates.

    Two pictures belong to one scene if their colours are similar or many corners match
    (`views_of_one_scene`), or if Roboflow derived both from one picture; scenes are the connected
    components. The thresholds favour merging: merged scenes only make the split coarser, whereas a
    divided scene leaks between splits.

    Parameters
    ----------
    dataset : DataSet
        Data set; existing scenes are kept.
    progress : callable, optional
        Called with 1 after each compared picture.

    Raises
    ------
    CaptureError
        If a picture cannot be read.
    """
    without = [p for p in dataset.pictures if not p.scene]
    prints = take_fingerprints([dataset.path(p) for p in without], progress)
    pairs = views_of_one_scene(prints) + _exports_of_one_picture(without)
    groups = _joined(len(without), pairs)
    taken = {p.scene for p in dataset.pictures}
    names: dict[int, str] = {}
    for group in dict.fromkeys(groups):
        # Named after the first picture, so that names are reproducible.
        name = PurePosixPath(without[group].file).stem
        while name in taken:
            name += "'"
        taken.add(name)
        names[group] = name
    scenes = {p.file: names[group] for p, group in zip(without, groups, strict=True)}
    pictures = tuple(replace(p, scene=scenes.get(p.file, p.scene)) for p in dataset.pictures)
    return replace(dataset, pictures=pictures)


def _exports_of_one_picture(pictures: Sequence[LabelledPicture]) -> list[tuple[int, int]]:
    first: dict[str, int] = {}
    pairs = []
    for k, picture in enumerate(pictures):
        stem = PurePosixPath(picture.file).stem
        original = _EXPORTED.sub("", stem)
        if original != stem and first.setdefault(original, k) != k:
            pairs.append((first[original], k))
    return pairs


def _joined(count: int, pairs: Sequence[tuple[int, int]]) -> list[int]:
    """Return the smallest index of each index's connected component.

    Examples
    --------
    >>> _joined(5, [(1, 3), (3, 4)])
    [0, 1, 2, 1, 1]
    """
    i, j = np.array(pairs, int).reshape(-1, 2).T
    links = coo_array((np.ones(len(i), bool), (i, j)), (count, count))
    _, first, group = np.unique(
        connected_components(links, directed=False)[1], return_index=True, return_inverse=True
    )
    return [int(k) for k in first[group]]


def split_by_scene(
    dataset: DataSet, shares: Sequence[float] = _SHARES, *, seed: int = 0
) -> DataSet:
    """Assign every scene to train, val or test.

    Each source is split separately. Scenes are assigned in descending order of size to the split
    that lacks most pictures of their kind (with and without fruit). Large scenes thus go to train,
    and val and test get many small ones.

    Parameters
    ----------
    dataset : DataSet
        Data set in which every picture has a scene. Existing splits are replaced.
    shares : sequence of float, length 3
        Shares of train, val and test, with a sum of 1.
    seed : int
        Random seed for the order of scenes of equal size.

    Returns
    -------
    DataSet
        The split data set; scenes with pseudo-labels are never in test.

    Raises
    ------
    DataSetError
        If a picture has no scene.

    Examples
    --------
    >>> from pathlib import Path
    >>> from cucumbervision_lab.data.labels import DataSet, LabelledPicture
    >>> made = [LabelledPicture(f"{k}.png", 64, 48, scene=f"s{k // 2}") for k in range(40)]
    >>> parted = split_by_scene(DataSet(Path("x"), tuple(made)))
    >>> [len(parted.in_split(split)) for split in SPLITS]
    [28, 6, 6]
    """
    parts = np.array(shares, np.float64)
    bare = [p.file for p in dataset.pictures if not p.scene]
    if bare:
        raise DataSetError(
            f"{len(bare)} pictures have no scene, first {bare[0]}",
            source=dataset.folder,
            remedy="find scenes first, or set them by a pattern",
        )
    split_of = _assign(dataset.pictures, parts, np.random.default_rng(seed))
    pictures = tuple(replace(p, split=split_of[p.scene]) for p in dataset.pictures)
    return replace(dataset, pictures=pictures)


def _assign(
    pictures: Sequence[LabelledPicture], shares: np.ndarray, rng: Generator
) -> dict[str, str]:
    scenes: dict[str, list[LabelledPicture]] = {}
    for picture in pictures:
        scenes.setdefault(picture.scene, []).append(picture)
    # A scene shared by several sources belongs to the first one.
    sources: dict[str, list[str]] = {}
    for scene, members in sorted(scenes.items()):
        sources.setdefault(members[0].source, []).append(scene)
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
    fruit = sum(p.shows_fruit for p in pictures)
    return np.array([fruit, len(pictures) - fruit], np.float64)
