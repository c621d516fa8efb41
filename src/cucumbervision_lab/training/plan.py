"""The plan of a training, counted in pictures seen, and the file that remembers the place in it.

Everything that changes on the way (size, learning rate, share of the one-to-many head, tolerance
of the points, mosaic) is a function of the share of the plan that is through, so that a training
ends alike whether it ran in one piece or in thirty.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from cucumbervision.capture.files import parse_model, read_json
from cucumbervision.errors import TrainingError

_STATE_FILE = "state.json"
_STRIDE_PX = 32
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
        if state.plan.per_epoch < 1 or not all(part.pictures > 0 for part in state.plan.parts):
            fault = "its plan has a part without pictures"
            raise TrainingError(fault, source=source, remedy=remedy)
        return state
