"""Training recipes: sources of pictures, their mixture and the plans, read from a TOML file."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from cucumbervision.errors import TrainingError
from cucumbervision_lab.training.plan import parse_plan

_KINDS = ("photos", "set", "drawn", "montage", "windows", "sheets", "d435-colors")
"""What a source can be made of; see `Source`."""

ORIGINAL = ("photos", "set", "drawn")
"""Those that are not made of others."""


@dataclass(frozen=True)
class Source:
    """Where some of the pictures come from.

    Parameters
    ----------
    name : str
        Folder that it is built in, and how others name it.
    kind : str
        'photos': the audited photos found below a folder, with masks by SAM; 'set': a labelled
        set, with masks by SAM where it has boxes only; 'drawn': by `synth`, with fruit of
        another source pasted in if `paste` names one; 'montage': fruit of `paste` on the
        fruitless photos of `of`; 'windows' and 'sheets': cut out of, and shrunk from, `of`;
        'd435-colors': the pictures of `of`, as a D435 sees them in a greenhouse.
    weight : float
        Share of the pictures seen; 0 for what others are made of only.
    folder : str
        Of 'photos' and 'set', below the recipe's data folder.
    of, paste : tuple of str
        Names of earlier sources.
    count : int
        Of frames, montages or sheets.
    size : tuple of int
        Width and height of frames and montages; the sides of windows; the side of sheets.
    shares : str
        Of 'drawn': weights of hanging, bench and crate.
    hard : bool
        Of 'drawn': as `synth --hard`.
    most : int
        Of 'photos' and 'set': pictures of one scene at most.
    seed : int
        Of the random numbers.
    validate : int
        How many of its pictures to validate with; of 'photos' and 'set' all of their split `val`,
        if it is not 0.
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
    """How one network is trained.

    Parameters
    ----------
    init : str
        Weights to begin with, below the folder of the recipe's weights.
    plan : str
        As `parse_plan` reads it.
    per_epoch : int
        Pictures between two checkpoints.
    validate_every, judge_every : int
        Epochs between two validations, and between two points of the curve.
    learning_rate, one_to_many, freeze
        As `TrainOptions`.
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
    """All of it.

    Parameters
    ----------
    sources : tuple of Source
        In the order in which they are built.
    schedules : dict of str to Schedule
        By task, 'seg' and 'pose'.
    """

    sources: tuple[Source, ...]
    schedules: dict[str, Schedule] = field(default_factory=dict)

    def source(self, name: str) -> Source:
        """Return a source by its name."""
        return next(source for source in self.sources if source.name == name)


def read_recipe(path: Path) -> Recipe:
    """Read a recipe.

    Parameters
    ----------
    path : Path
        A TOML file: a table `[seg]`, `[pose]` or both, as `Schedule`, and `[[source]]` tables as
        `Source`.

    Raises
    ------
    TrainingError
        If it cannot be read, or a name, a plan or a kind is not known; with what is wrong.
    """
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise TrainingError(
            f"the recipe cannot be read ({error})", source=path, remedy="give a TOML file"
        ) from error
    try:
        tables = values.pop("source", [])
        sources = tuple(Source(**_typed(Source, table)) for table in tables)
        schedules = {task: Schedule(**table) for task, table in values.items()}
        for task, schedule in schedules.items():
            if task not in ("seg", "pose"):
                raise ValueError(f"no task is called {task!r}")
            parse_plan(schedule.plan, schedule.per_epoch)
        _check(sources)
    except (TypeError, ValueError, AttributeError, LookupError, OverflowError) as error:
        raise TrainingError(str(error), source=path, remedy="correct the recipe") from error
    except TrainingError as error:
        raise error.at(path) from error
    return Recipe(sources, schedules)


def _typed(kind: type, table: dict[str, Any]) -> dict[str, Any]:
    """Make tuples of lists, and of single names where several may be given."""
    many = {one.name for one in fields(kind) if str(one.type).startswith("tuple")}
    return {
        key: tuple(value if isinstance(value, list) else [value]) if key in many else value
        for key, value in table.items()
    }


def _check(sources: tuple[Source, ...]) -> None:
    known: set[str] = set()
    for source in sources:
        if source.kind not in _KINDS:
            raise ValueError(f"{source.name}: no kind is called {source.kind!r}")
        if source.name in known:
            raise ValueError(f"two sources are called {source.name!r}")
        for other in (*source.of, *source.paste):
            if other not in known:
                raise ValueError(f"{source.name}: no source before it is called {other!r}")
        if source.kind not in ORIGINAL and not source.of:
            raise ValueError(f"{source.name}: say of which source it is made")
        known.add(source.name)
    if not sum(source.weight for source in sources) > 0:
        raise ValueError("no source has a weight")
    if not any(source.validate for source in sources):
        raise ValueError("no source has pictures to validate with")
