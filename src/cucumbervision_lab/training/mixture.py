"""Which picture is seen when: sources mixed by weights, the same at every resumption."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def sources_of(files: Sequence[str], folders: Sequence[str]) -> list[NDArray[np.int64]]:
    """Return which pictures lie in which source's folder.

    Parameters
    ----------
    files : sequence of str
        Paths of all pictures.
    folders : sequence of str
        Of the sources; none lies in another.

    Returns
    -------
    list of ndarray of int64
        Indices into `files`, for each folder.

    Examples
    --------
    >>> [found.tolist() for found in sources_of(["a/1.jpg", "b/2.jpg", "a/3.jpg"], ["a", "b"])]
    [[0, 2], [1]]
    """
    parents = [Path(file).parents for file in files]
    return [
        np.array([k for k, above in enumerate(parents) if Path(folder) in above], np.int64)
        for folder in folders
    ]


def pictures_of_epoch(
    sources: Sequence[NDArray[np.int64]],
    weights: Sequence[float],
    count: int,
    epoch: int,
    seed: int = 0,
) -> NDArray[np.int64]:
    """Choose the pictures of one epoch.

    Parameters
    ----------
    sources : sequence of ndarray of int64
        The pictures of each source.
    weights : sequence of float
        Of the sources; a source without pictures has none.
    count : int
        How many pictures.
    epoch : int
        Number of the epoch, from 0.
    seed : int
        Of the random numbers.

    Returns
    -------
    ndarray of int64, shape (count,)
        Shuffled. Every picture of a source has its epoch before one comes again.

    Examples
    --------
    >>> a, b = np.arange(4), np.arange(4, 6)
    >>> first = pictures_of_epoch([a, b], [0.5, 0.5], 4, 0)
    >>> second = pictures_of_epoch([a, b], [0.5, 0.5], 4, 1)
    >>> sorted([*first.tolist(), *second.tolist()])
    [0, 1, 2, 3, 4, 4, 5, 5]
    """
    shares = np.array([w if len(s) else 0.0 for s, w in zip(sources, weights, strict=True)])
    shares = shares / shares.sum()
    # Positions in endless streams of the sources, so that no epoch need know those before it.
    bounds = np.rint(np.outer([epoch, epoch + 1], shares) * count).astype(int)
    bounds[1, shares.argmax()] += count - int((bounds[1] - bounds[0]).sum())
    chosen = [
        _stream(source, low, high, (seed, number))
        for number, (source, low, high) in enumerate(zip(sources, *bounds, strict=True))
        if high > low
    ]
    found = np.concatenate(chosen)
    return np.random.default_rng([seed, len(sources), epoch]).permutation(found)


def _stream(
    source: NDArray[np.int64], low: int, high: int, seed: tuple[int, int]
) -> NDArray[np.int64]:
    """Return a stretch of an endless row of shuffled rounds through a source."""
    size = len(source)
    rounds = range(low // size, (high - 1) // size + 1)
    row = np.concatenate([np.random.default_rng([*seed, k]).permutation(source) for k in rounds])
    return row[low - rounds[0] * size : high - rounds[0] * size]


class MixtureSampler:
    """Gives torch's loader the pictures of one epoch after the other.

    Parameters
    ----------
    sources, weights, count, seed
        As `pictures_of_epoch`.
    epoch : int
        With which to begin.
    """

    def __init__(
        self,
        sources: Sequence[NDArray[np.int64]],
        weights: Sequence[float],
        count: int,
        *,
        epoch: int = 0,
        seed: int = 0,
    ) -> None:
        self._sources, self._weights, self._count = sources, weights, count
        self._epoch, self._seed = epoch, seed

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[int]:
        epoch, self._epoch = self._epoch, self._epoch + 1
        row = pictures_of_epoch(self._sources, self._weights, self._count, epoch, self._seed)
        yield from row.tolist()
