"""The plan of a training in stages, and the file that remembers how far it got.

Small pictures first, the last epochs at full size: each stage starts from the one before. What is
done stands in `state.json` of the run's folder, so that a killed run goes on where it was.
"""

from __future__ import annotations

import json
import re
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from cucumbervision.errors import TrainingError

__all__ = ["DONE", "RUNNING", "WAITING", "RunState", "Stage", "merge_plans", "parse_stages"]

WAITING, RUNNING, DONE = "waiting", "running", "done"
"""What a stage's `status` can be."""

_STATE_FILE = "state.json"
_STRIDE_PX = 32
_FORM = re.compile(r"(\d+)\s*[x×]\s*(\d+)")


@dataclass(frozen=True)
class Stage:
    """Some epochs at one size of picture.

    Parameters
    ----------
    size_px : int
        Side of the square training pictures; a multiple of 32.
    epochs : int
        How often all pictures are seen.
    status : str
        'waiting', 'running' or 'done'.
    fitness : float, optional
        Ultralytics' fitness of the best epoch, once it is done.
    """

    size_px: int
    epochs: int
    status: str = WAITING
    fitness: float | None = None

    @property
    def plan(self) -> tuple[int, int]:
        """Size and epochs: what makes two stages the same in a plan."""
        return self.size_px, self.epochs


def parse_stages(text: str) -> tuple[Stage, ...]:
    """Read a plan such as '320x8,448x6,640x2'.

    Parameters
    ----------
    text : str
        Stages parted by commas, each size in pixels, 'x' and epochs.

    Returns
    -------
    tuple of Stage
        In the order given.

    Raises
    ------
    TrainingError
        If it is not of that form, or a size is no multiple of 32.

    Examples
    --------
    >>> [stage.plan for stage in parse_stages("320x8, 640x2")]
    [(320, 8), (640, 2)]
    """
    stages = []
    for part in text.split(","):
        match = _FORM.fullmatch(part.strip())
        size_px, epochs = map(int, match.groups()) if match else (0, 0)
        if not size_px or not epochs or size_px % _STRIDE_PX:
            raise TrainingError(
                f"no stage is called {part.strip()!r}",
                remedy="give sizes that are multiples of 32 and epochs, as in '320x8,640x2'",
            )
        stages.append(Stage(size_px, epochs))
    return tuple(stages)


def merge_plans(known: tuple[Stage, ...], wanted: tuple[Stage, ...]) -> tuple[Stage, ...]:
    """Change what is still to come of a plan; what was begun stays.

    Parameters
    ----------
    known, wanted : tuple of Stage
        The plan so far, and the whole plan wanted, which begins with the stages already begun.

    Returns
    -------
    tuple of Stage
        The plan wanted, with what is known of the stages begun.

    Raises
    ------
    TrainingError
        If a stage already begun is not in the plan wanted.

    Examples
    --------
    >>> done = (Stage(320, 8, "done", 0.5),)
    >>> [s.status for s in merge_plans(done, parse_stages("320x8,640x2"))]
    ['done', 'waiting']
    """
    begun = tuple(stage for stage in known if stage.status != WAITING)
    if [s.plan for s in wanted[: len(begun)]] != [s.plan for s in begun]:
        told = ",".join(f"{s.size_px}x{s.epochs}" for s in begun)
        raise TrainingError(
            f"the run has already begun {told}", remedy=f"give stages that begin with {told}"
        )
    return begun + wanted[len(begun) :]


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
    stages : tuple of Stage
        The plan, and how far it got.
    seed : int
        Of the random numbers.
    seconds : float
        Time spent in finished epochs.
    learning : dict
        Options that must not change on the way: see `LEARNING` in `settings`.
    """

    task: str
    data: str
    init: str
    stages: tuple[Stage, ...]
    seed: int = 0
    seconds: float = 0.0
    learning: dict[str, Any] = field(default_factory=dict)

    def folder(self, run: Path, index: int) -> Path:
        """Folder of a stage inside the run's folder."""
        return run / f"stage{index + 1}-{self.stages[index].size_px}px"

    def at(self, index: int, **changes: str | float | None) -> RunState:
        """Copy it with one stage changed."""
        stages = list(self.stages)
        stages[index] = replace(stages[index], **changes)  # type: ignore[arg-type]
        return replace(self, stages=tuple(stages))

    def save(self, run: Path) -> None:
        """Write it into the run's folder; a kill leaves the old or the new file, never half."""
        run.mkdir(parents=True, exist_ok=True)
        part = run / f"{_STATE_FILE}.part"
        part.write_text(json.dumps(asdict(self), indent=2), encoding="utf-8")
        part.replace(run / _STATE_FILE)

    @classmethod
    def exists(cls, run: Path) -> bool:
        """Tell whether a folder holds a run."""
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
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
            stages = tuple(Stage(**stage) for stage in values.pop("stages"))
            return cls(stages=stages, **values)
        except FileNotFoundError as error:
            raise TrainingError(
                "there is no training to go on with", source=run, remedy="leave out --resume"
            ) from error
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise TrainingError(
                f"the state of the training cannot be read ({error})",
                source=path,
                remedy="begin again in another folder, with --init and the last weights",
            ) from error
