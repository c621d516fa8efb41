"""How alike two pictures are: the same picture saved again, or another view of the same scene.

Three things are taken from each picture: a perceptual hash, which a copy keeps however it is
compressed, scaled, turned or mirrored; the colours, which all views of one heap of fruit share;
and corner features, which tell the same table from another of the same colours. The thresholds
were set on 173 phone photos of 46 scenes told apart by eye; `docs/datasets.md` has the figures.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.files import read_color

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

__all__ = [
    "COPY_BITS",
    "SCENE_COLOR",
    "SCENE_CORNERS",
    "Fingerprint",
    "color_distances",
    "copies",
    "shared_corners",
    "take_fingerprints",
    "views_of_one_scene",
]

COPY_BITS = 6  # of 63: two photos of one heap differ by 16 and more
COPY_COLOR = 0.3
SCENE_COLOR = 0.42
SCENE_CORNERS = 8
_NEAREST, _FAR_COLOR = 20, 0.6  # whose corners are compared at all
_SIDE, _COLOR_SIDE, _CORNER_SIDE = 32, 128, 320


@dataclass(frozen=True, eq=False)
class Fingerprint:
    """What of a picture is compared.

    Parameters
    ----------
    hashes : ndarray of uint64, shape (8,)
        Perceptual hashes of the picture as it is, turned and mirrored; 63 bits each.
    colors : ndarray of float32, shape (1536,)
        Square roots of the shares of lightness and colour; white and black ground left out.
    points_px : ndarray of float32, shape (N, 2)
        Corners, in the picture scaled to a side of 320.
    features : ndarray of uint8, shape (N, 32)
        Their ORB descriptors.
    """

    hashes: NDArray[np.uint64]
    colors: NDArray[np.float32]
    points_px: NDArray[np.float32]
    features: NDArray[np.uint8]


def take_fingerprints(
    files: Sequence[Path], progress: Callable[[int], None] | None = None
) -> list[Fingerprint]:
    """Take the fingerprints of picture files.

    Raises
    ------
    CaptureError
        If a picture cannot be read.
    """
    import cv2

    corners = cv2.ORB_create(400)  # type: ignore[attr-defined,unused-ignore]
    found = []
    for file in files:
        found.append(_fingerprint(read_color(file), corners))
        if progress is not None:
            progress(1)
    return found


def _fingerprint(color_rgb: NDArray[np.uint8], corners: Any) -> Fingerprint:
    import cv2

    def scaled(side: int) -> NDArray[Any]:
        return np.asarray(cv2.resize(color_rgb, (side, side), interpolation=cv2.INTER_AREA))

    grey = cv2.cvtColor(scaled(_SIDE), cv2.COLOR_RGB2GRAY).astype(np.float32)
    lab = cv2.cvtColor(scaled(_COLOR_SIDE), cv2.COLOR_RGB2LAB)
    shares = cv2.calcHist([lab], [0, 1, 2], None, [6, 16, 16], [0, 256, 64, 192, 64, 192])
    # White and black ground is no scene: on it, all product photos would look alike.
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


def _turned(grey: NDArray[np.float32]) -> Iterator[NDArray[np.float32]]:
    for mirrored in (grey, grey[:, ::-1]):
        for quarter in range(4):
            yield np.ascontiguousarray(np.rot90(mirrored, quarter))


def _hash(grey: NDArray[np.float32]) -> int:
    """Give the signs of the lowest frequencies about their median (Zauner 2010, pHash)."""
    import cv2

    low = cv2.dct(grey)[:8, :8].ravel()[1:]
    return int.from_bytes(np.packbits(low > np.median(low)).tobytes(), "big")


def copies(left: Sequence[Fingerprint], right: Sequence[Fingerprint]) -> list[tuple[int, int]]:
    """Give the pairs that are one picture saved twice, turned or mirrored or not.

    Returns
    -------
    list of (int, int)
        Indices into `left` and `right`.
    """
    if not left or not right:
        return []
    turned = np.stack([f.hashes for f in right])
    found = []
    for i, one in enumerate(left):
        bits = np.bitwise_count(turned ^ one.hashes[0]).min(axis=1)
        for j in np.flatnonzero(bits <= COPY_BITS).tolist():
            if float(one.colors @ right[j].colors) >= 1 - COPY_COLOR**2:
                found.append((i, j))
    return found


def color_distances(prints: Sequence[Fingerprint]) -> NDArray[np.float32]:
    """Give the Hellinger distance of all pairs' colours, 0 to 1, shape (N, N)."""
    colors = np.stack([f.colors for f in prints])
    distances: NDArray[np.float32] = np.sqrt(np.maximum(0, 1 - colors @ colors.T))
    return distances


def shared_corners(a: Fingerprint, b: Fingerprint) -> int:
    """Count the corners of two pictures that one shift, turn and scale carries onto each other."""
    import cv2

    if min(len(a.features), len(b.features)) < 10:
        return 0
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(a.features, b.features, k=2)
    # Lowe 2004: a match is kept if it is clearly better than the second best.
    good = [m for m, second in pairs if m.distance < 0.75 * second.distance]
    if len(good) < SCENE_CORNERS:
        return 0
    start, end = a.points_px[[m.queryIdx for m in good]], b.points_px[[m.trainIdx for m in good]]
    # Its stubs do not know that there may be no answer.
    agree: Any = cv2.estimateAffinePartial2D(start, end, ransacReprojThreshold=6)[1]
    return 0 if agree is None else int(agree.sum())


def views_of_one_scene(
    prints: Sequence[Fingerprint],
    *,
    color: float = SCENE_COLOR,
    corners: int = SCENE_CORNERS,
    wanted: Callable[[int, int], bool] | None = None,
) -> list[tuple[int, int]]:
    """Give the pairs of pictures that show the same scene.

    Parameters
    ----------
    prints : sequence of Fingerprint
        From `take_fingerprints`.
    color : float
        Pairs whose colours lie nearer than this are one scene.
    corners : int
        So are pairs that share as many corners; looked for among the nearest in colour only.
    wanted : callable, optional
        Says of two indices whether the pair is of interest.

    Returns
    -------
    list of (int, int)
        The smaller index first.
    """
    if len(prints) < 2:
        return []
    distances = color_distances(prints)
    np.fill_diagonal(distances, np.inf)
    found = {(int(i), int(j)) for i, j in zip(*np.nonzero(distances < color), strict=True) if i < j}
    nearest = np.argsort(distances, axis=1, kind="stable")[:, :_NEAREST]
    candidates = {
        (min(i, int(j)), max(i, int(j)))
        for i, row in enumerate(nearest)
        for j in row
        if distances[i, j] < _FAR_COLOR
    }
    if wanted is not None:
        found = {pair for pair in found if wanted(*pair)}
        candidates = {pair for pair in candidates if wanted(*pair)}
    for i, j in sorted(candidates - found):
        if shared_corners(prints[i], prints[j]) >= corners:
            found.add((i, j))
    return sorted(found)
