"""Training plans counted in pictures, the state of a run, and sampling from weighted sources."""

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

from cucumbervision.errors import TrainingError
from cucumbervision.files import parse_model, read_json
from cucumbervision_lab.datasets.labels import write_text

_STATE_FILE = "state.json"
_STRIDE_PX = 32
_TOO_MANY = 10**12  # pictures
_FORM = re.compile(r"(\d+)\s*[x×]\s*(\d+)")


@dataclass(frozen=True)
class Part:
    """One stage of a plan: a number of pictures at one size.

    Parameters
    ----------
    size_px : int
        Side of the square training pictures; a multiple of 32.
    pictures : int
        Number of pictures.
    """

    size_px: int
    pictures: int


@dataclass(frozen=True)
class Plan:
    """Training stages in order.

    Parameters
    ----------
    parts : tuple of Part
        Stages in order.
    per_epoch : int
        Pictures between two checkpoints; each part is rounded up to whole epochs.

    Examples
    --------
    >>> plan = Plan((Part(448, 900), Part(640, 200)), per_epoch=100)
    >>> plan.epochs, plan.size_at(8), plan.size_at(9), plan.end_of_part(8), plan.progress(11)
    (11, 448, 640, 9, 1.0)
    """

    parts: tuple[Part, ...]
    per_epoch: int = 500

    @property
    def epochs(self) -> int:
        """Total number of epochs."""
        return sum(self._epochs_of_parts())

    @property
    def text(self) -> str:
        """The plan in the format of `parse_plan`."""
        return ",".join(f"{part.size_px}x{part.pictures}" for part in self.parts)

    def size_at(self, epoch: int) -> int:
        """Return the picture size in pixels of an epoch, counted from 0."""
        return self.parts[self._part_at(epoch)].size_px

    def end_of_part(self, epoch: int) -> int:
        """Return the number of the first epoch after the part that contains `epoch`."""
        return sum(self._epochs_of_parts()[: self._part_at(epoch) + 1])

    def progress(self, epochs: int) -> float:
        """Return the completed share of the plan after `epochs` epochs, 0 to 1."""
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
    """Parse a plan such as '448x80000,640x20000'.

    Parameters
    ----------
    text : str
        Comma-separated parts, each 'size in pixels' x 'number of pictures'.
    per_epoch : int
        Pictures between two checkpoints.

    Returns
    -------
    Plan
        Parts in the given order.

    Raises
    ------
    TrainingError
        If `text` does not have this format, or a size is not a multiple of 32.

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
                f"invalid part of a plan: {words.strip()!r}",
                remedy="give sizes (multiples of 32) and pictures, as in '448x80000,640x20000'",
            )
        parts.append(Part(size_px, pictures))
    return Plan(tuple(parts), per_epoch)


def extend_plan(plan: Plan, completed_epochs: int, new_plan: Plan) -> Plan:
    """Return a plan that replaces another one from the next epoch on.

    Parameters
    ----------
    plan : Plan
        Current plan.
    completed_epochs : int
        Number of its completed epochs.
    new_plan : Plan
        The complete new plan.

    Returns
    -------
    Plan
        `new_plan` with the epoch length of `plan`.

    Raises
    ------
    TrainingError
        If the sizes of the completed epochs differ, or `new_plan` is shorter than them.

    Examples
    --------
    >>> extend_plan(parse_plan("448x1000"), 1, parse_plan("448x4000")).text
    '448x4000'
    """
    new = Plan(new_plan.parts, plan.per_epoch)
    same = all(new.size_at(k) == plan.size_at(k) for k in range(completed_epochs))
    if completed_epochs > new.epochs or not same:
        raise TrainingError(
            f"{completed_epochs * plan.per_epoch} pictures of the plan {plan.text} are completed",
            remedy="give a plan that starts with them",
        )
    return new


@dataclass(frozen=True)
class RunState:
    """State needed to resume a training run.

    Parameters
    ----------
    task : str
        'seg' or 'pose'.
    data : str
        Path of the data.yaml.
    init : str
        Initial weights (.pt), or a network definition (.yaml) for random weights.
    plan : Plan
        The training plan.
    epochs : int
        Number of completed epochs.
    seed : int
        Random seed.
    seconds : float
        Time spent in completed epochs, on all machines.
    learning : dict
        Options that must not change during a run; see `FIXED_OPTIONS` in `settings`.
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
        """Number of pictures seen."""
        return self.epochs * self.plan.per_epoch

    @property
    def is_done(self) -> bool:
        """Whether all epochs of the plan are completed."""
        return self.epochs >= self.plan.epochs

    def save(self, run: Path) -> None:
        """Write the state to the run's folder; replaces the file atomically."""
        write_text(run / _STATE_FILE, json.dumps(asdict(self), indent=2))

    @classmethod
    def exists(cls, run: Path) -> bool:
        """Return whether a folder contains a training run."""
        return (run / _STATE_FILE).is_file()

    @classmethod
    def load(cls, run: Path) -> RunState:
        """Read the state from a run's folder.

        Raises
        ------
        TrainingError
            If the folder contains no run, or its state file is invalid.
        """
        path = run / _STATE_FILE
        if not path.is_file():
            raise TrainingError(
                "no training run to resume", source=run, remedy="omit --resume to start one"
            )
        remedy = "start a new run in another folder with --init and the network.pt of this one"
        return cls.from_dict(read_json(path, TrainingError, remedy), path, remedy)

    @classmethod
    def from_dict(
        cls, values: Any, source: object = "the run state", remedy: str = "start a new run"
    ) -> RunState:
        """Create the state from the output of `dataclasses.asdict`.

        Raises
        ------
        TrainingError
            If a value is missing or has the wrong type, or a picture count is out of range.
        """
        state = parse_model(cls, values, source=source, error=TrainingError, remedy=remedy)
        counts = (state.plan.per_epoch, *(part.pictures for part in state.plan.parts))
        if not all(0 < count < _TOO_MANY for count in counts):
            fault = "a picture count of its plan is zero or too large"
            raise TrainingError(fault, source=source, remedy=remedy)
        return state


def group_by_source(files: Sequence[str], folders: Sequence[str]) -> list[NDArray[np.int64]]:
    """Group pictures by the source folder that contains them.

    Parameters
    ----------
    files : sequence of str
        Paths of all pictures.
    folders : sequence of str
        Folders of the sources; they must not be nested.

    Returns
    -------
    list of ndarray of int64
        Indices into `files` for each folder.

    Examples
    --------
    >>> files = ["a/1.jpg", "b/2.jpg", "a/3.jpg"]
    >>> [group.tolist() for group in group_by_source(files, ["a", "b"])]
    [[0, 2], [1]]
    """
    parents = [Path(file).parents for file in files]
    return [
        np.array([k for k, above in enumerate(parents) if Path(folder) in above], np.int64)
        for folder in folders
    ]


def epoch_pictures(
    sources: Sequence[NDArray[np.int64]],
    weights: Sequence[float],
    count: int,
    epoch: int,
    seed: int = 0,
) -> NDArray[np.int64]:
    """Sample the pictures of one epoch from weighted sources.

    Parameters
    ----------
    sources : sequence of ndarray of int64
        Picture indices of each source.
    weights : sequence of float
        Weight of each source; the weight of an empty source is ignored.
    count : int
        Number of pictures in the epoch.
    epoch : int
        Number of the epoch, from 0.
    seed : int
        Random seed.

    Returns
    -------
    ndarray of int64, shape (count,)
        Shuffled picture indices. Across epochs, every picture of a source is used once before any
        is used again.

    Examples
    --------
    >>> a, b = np.arange(4), np.arange(4, 6)
    >>> first = epoch_pictures([a, b], [0.5, 0.5], 4, 0)
    >>> second = epoch_pictures([a, b], [0.5, 0.5], 4, 1)
    >>> sorted([*first.tolist(), *second.tolist()])
    [0, 1, 2, 3, 4, 4, 5, 5]
    """
    shares = np.array([w if len(s) else 0.0 for s, w in zip(sources, weights, strict=True)])
    shares = shares / shares.sum()
    # Ranges in an endless shuffled stream per source, so that an epoch needs no history.
    bounds = np.rint(np.outer([epoch, epoch + 1], shares) * count).astype(int)
    bounds[1, shares.argmax()] += count - int((bounds[1] - bounds[0]).sum())
    chosen = [
        _stream_range(source, start, stop, (seed, number))
        for number, (source, start, stop) in enumerate(zip(sources, *bounds, strict=True))
        if stop > start
    ]
    pictures = np.concatenate(chosen)
    return np.random.default_rng([seed, len(sources), epoch]).permutation(pictures)


def _stream_range(
    source: NDArray[np.int64], start: int, stop: int, seed: tuple[int, int]
) -> NDArray[np.int64]:
    """Return items `low` to `high` of an endless stream of shuffled passes through a source."""
    size = len(source)
    rounds = range(start // size, (stop - 1) // size + 1)
    row = np.concatenate([np.random.default_rng([*seed, k]).permutation(source) for k in rounds])
    return row[start - rounds[0] * size : stop - rounds[0] * size]


class MixtureSampler:
    """Torch sampler that yields the pictures of consecutive epochs.

    Parameters
    ----------
    sources, weights, count, seed
        See `epoch_pictures`.
    epoch : int
        First epoch.
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
        row = epoch_pictures(self._sources, self._weights, self._count, epoch, self._seed)
        yield from row.tolist()
