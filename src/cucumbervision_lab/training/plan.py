"""The plan of a training, counted in pictures seen, and which of them is seen when."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cucumbervision.capture.files import parse_model, read_json
from cucumbervision.errors import TrainingError

_STATE_FILE = "state.json"
_STRIDE_PX = 32
_TOO_MANY = 10**12  # pictures
_FORM = re.compile(r"(\d+)\s*[x×]\s*(\d+)")


@dataclass(frozen=True)
class Part:
    """Some pictures at one size.

    Parameters
    ----------
    size_px : int
        Side of the square training pictures; a multiple of 32.
    pictures : int
        How many are seen.
    """

    size_px: int
    pictures: int


@dataclass(frozen=True)
class Plan:
    """Which pictures are seen at which size.

    Parameters
    ----------
    parts : tuple of Part
        In their order.
    per_epoch : int
        Pictures between two checkpoints; each part has whole epochs.

    Examples
    --------
    >>> plan = Plan((Part(448, 900), Part(640, 200)), per_epoch=100)
    >>> plan.epochs, plan.size_at(8), plan.size_at(9), plan.end_of_part(8), plan.through(11)
    (11, 448, 640, 9, 1.0)
    """

    parts: tuple[Part, ...]
    per_epoch: int = 500

    @property
    def epochs(self) -> int:
        """How many epochs the whole plan has."""
        return sum(self._epochs_of_parts())

    @property
    def text(self) -> str:
        """As `parse_plan` reads it."""
        return ",".join(f"{part.size_px}x{part.pictures}" for part in self.parts)

    def size_at(self, epoch: int) -> int:
        """Return the size of the pictures in an epoch, counted from 0."""
        return self.parts[self._part_at(epoch)].size_px

    def end_of_part(self, epoch: int) -> int:
        """Return the first epoch after the part that an epoch is in."""
        return sum(self._epochs_of_parts()[: self._part_at(epoch) + 1])

    def through(self, epochs: int) -> float:
        """Return the share of the plan that this many epochs are, 0 to 1."""
        return min(epochs / self.epochs, 1.0)

    def _epochs_of_parts(self) -> list[int]:
        return [math.ceil(part.pictures / self.per_epoch) for part in self.parts]

    def _part_at(self, epoch: int) -> int:
        end = 0
        for index, epochs in enumerate(self._epochs_of_parts()):
            end += epochs
            if epoch < end:
                return index
        return len(self.parts) - 1


def parse_plan(text: str, per_epoch: int = 500) -> Plan:
    """Read a plan such as '448x80000,640x20000'.

    Parameters
    ----------
    text : str
        Parts by commas, each the size in pixels, 'x', and how many pictures are seen.
    per_epoch : int
        Pictures between two checkpoints.

    Returns
    -------
    Plan
        In the order given.

    Raises
    ------
    TrainingError
        If it is not of that form, or a size is no multiple of 32.

    Examples
    --------
    >>> [part.size_px for part in parse_plan("448x80000, 640x20000").parts]
    [448, 640]
    """
    parts = []
    for words in text.split(","):
        match = _FORM.fullmatch(words.strip())
        size_px, pictures = map(int, match.groups()) if match else (0, 0)
        if not size_px or not pictures or size_px % _STRIDE_PX:
            raise TrainingError(
                f"no part of a plan is called {words.strip()!r}",
                remedy="give sizes that are multiples of 32 and pictures: '448x80000,640x20000'",
            )
        parts.append(Part(size_px, pictures))
    return Plan(tuple(parts), per_epoch)


def extend(known: Plan, epochs_done: int, wanted: Plan) -> Plan:
    """Change what is still to come of a plan.

    Parameters
    ----------
    known : Plan
        The plan so far.
    epochs_done : int
        How many of its epochs are through.
    wanted : Plan
        The whole plan wanted.

    Returns
    -------
    Plan
        `wanted`, with the epochs of `known`.

    Raises
    ------
    TrainingError
        If an epoch that is through had another size in the plan wanted, or it ends before.

    Examples
    --------
    >>> extend(parse_plan("448x1000"), 1, parse_plan("448x4000")).text
    '448x4000'
    """
    new = Plan(wanted.parts, known.per_epoch)
    same = all(new.size_at(k) == known.size_at(k) for k in range(epochs_done))
    if epochs_done > new.epochs or not same:
        raise TrainingError(
            f"{epochs_done * known.per_epoch} pictures of the plan {known.text} are through",
            remedy="give a plan that begins with them",
        )
    return new


@dataclass(frozen=True)
class RunState:
    """All that a run's folder must know to go on.

    Parameters
    ----------
    task : str
        'seg' or 'pose'.
    data : str
        Path of the data.yaml that it learns from.
    init : str
        Weights that it began with, or the .yaml of a network with random ones.
    plan : Plan
        What is to be seen.
    epochs : int
        How many epochs are through.
    seed : int
        Of the random numbers.
    seconds : float
        Time spent in finished epochs, on whatever machine.
    learning : dict
        Options that must not change on the way: see `LEARNING` in `settings`.
    """

    task: str
    data: str
    init: str
    plan: Plan
    epochs: int = 0
    seed: int = 0
    seconds: float = 0.0
    learning: dict[str, Any] = field(default_factory=dict)

    @property
    def pictures(self) -> int:
        """Pictures seen."""
        return self.epochs * self.plan.per_epoch

    @property
    def is_done(self) -> bool:
        """Whether the whole plan is through."""
        return self.epochs >= self.plan.epochs

    def save(self, run: Path) -> None:
        """Write it into the run's folder; a kill leaves the old or the new file, never half."""
        run.mkdir(parents=True, exist_ok=True)
        part = run / f"{_STATE_FILE}.part"
        part.write_text(json.dumps(asdict(self), indent=2), encoding="utf-8")
        part.replace(run / _STATE_FILE)

    @classmethod
    def exists(cls, run: Path) -> bool:
        """Return whether a folder holds a run."""
        return (run / _STATE_FILE).is_file()

    @classmethod
    def load(cls, run: Path) -> RunState:
        """Read it from a run's folder.

        Raises
        ------
        TrainingError
            If the folder holds no run, or its file is broken.
        """
        path = run / _STATE_FILE
        if not path.is_file():
            raise TrainingError(
                "there is no training to go on with", source=run, remedy="leave out --resume"
            )
        again = "begin in another folder with --init and this one's network.pt"
        return cls.of(read_json(path, TrainingError, again), path, again)

    @classmethod
    def of(
        cls, values: Any, source: object = "the training", remedy: str = "begin anew"
    ) -> RunState:
        """Make it of what `dataclasses.asdict` gave.

        Raises
        ------
        TrainingError
            If a value is missing or of another type, or a part of the plan has no pictures.
        """
        state = parse_model(cls, values, source=source, error=TrainingError, remedy=remedy)
        counts = (state.plan.per_epoch, *(part.pictures for part in state.plan.parts))
        if not all(0 < count < _TOO_MANY for count in counts):
            fault = "its plan has a part without pictures, or with more than there are"
            raise TrainingError(fault, source=source, remedy=remedy)
        return state


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
