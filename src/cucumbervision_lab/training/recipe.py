"""Training recipes: picture sources with weights, and training schedules, from a TOML file."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from cucumbervision.errors import TrainingError
from cucumbervision_lab.training.plan import parse_plan

_KINDS = ("photos", "set", "drawn", "montage", "windows", "sheets", "d435-colors")
"""Kinds of sources; see `Source`."""

ORIGINAL = ("photos", "set", "drawn")
"""Kinds of sources that are not derived from other sources."""


@dataclass(frozen=True)
class Source:
    """A source of training pictures.

    Parameters
    ----------
    name : str
        Name of the source and of its folder.
    kind : str
        'photos': the audited photos below a folder, with masks by SAM. 'set': a labelled set, with
        masks by SAM if it has boxes only. 'drawn': synthetic frames from `synth`, optionally with
        pasted fruit of the source `paste`. 'montage': fruit of `paste` on the photos without fruit
        of `of`. 'windows': crops of `of`. 'sheets': mosaics of downscaled pictures of `of`.
        'd435-colors': pictures of `of` with the colours of a D435 in a greenhouse.
    weight : float
        Share of this source in the training pictures; 0 for a source that others are derived from.
    folder : str
        Folder of 'photos' and 'set', relative to the data folder.
    of, paste : tuple of str
        Names of earlier sources.
    count : int
        Number of frames, montages or sheets.
    size : tuple of int
        Width and height of frames and montages; sides of windows; side of sheets; pixels.
    shares : str
        For 'drawn': weights of hanging, bench and crate scenes.
    hard : bool
        For 'drawn': see `synth --hard`.
    most : int
        For 'photos' and 'set': maximum number of pictures per scene.
    seed : int
        Random seed.
    validate : int
        Number of validation pictures. For 'photos' and 'set', any value but 0 uses the whole split
        `val`.
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
    """Training schedule of one network.

    Parameters
    ----------
    init : str
        Initial weights, relative to the weights folder.
    plan : str
        Plan in the format of `parse_plan`.
    per_epoch : int
        Pictures between two checkpoints.
    validate_every, judge_every : int
        Epochs between two validations, and between two points of the accuracy curve.
    learning_rate, one_to_many, freeze
        See `TrainOptions`.
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
    """A training recipe.

    Parameters
    ----------
    sources : tuple of Source
        Sources in build order.
    schedules : dict of str to Schedule
        Schedules by task, 'seg' and 'pose'.
    """

    sources: tuple[Source, ...]
    schedules: dict[str, Schedule] = field(default_factory=dict)

    def source(self, name: str) -> Source:
        """Return the source called `name`."""
        return next(source for source in self.sources if source.name == name)


def read_recipe(path: Path) -> Recipe:
    """Read a recipe from a TOML file.

    Parameters
    ----------
    path : Path
        A file with a table `[seg]`, `[pose]` or both (see `Schedule`), and `[[source]]` tables (see
        `Source`).

    Raises
    ------
    TrainingError
        If the file cannot be read, or a key, name, plan or kind is invalid.
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
                raise ValueError(f"unknown task {task!r}")
            parse_plan(schedule.plan, schedule.per_epoch)
        _check(sources)
    except (TypeError, ValueError, AttributeError, LookupError, OverflowError) as error:
        raise TrainingError(str(error), source=path, remedy="correct the recipe") from error
    except TrainingError as error:
        raise error.at(path) from error
    return Recipe(sources, schedules)


def _typed(kind: type, table: dict[str, Any]) -> dict[str, Any]:
    """Convert lists, and single values of tuple fields, to tuples."""
    many = {one.name for one in fields(kind) if str(one.type).startswith("tuple")}
    return {
        key: tuple(value if isinstance(value, list) else [value]) if key in many else value
        for key, value in table.items()
    }


def _check(sources: tuple[Source, ...]) -> None:
    known: set[str] = set()
    for source in sources:
        if source.kind not in _KINDS:
            raise ValueError(f"{source.name}: unknown kind {source.kind!r}")
        if source.name in known:
            raise ValueError(f"duplicate source {source.name!r}")
        for other in (*source.of, *source.paste):
            if other not in known:
                raise ValueError(f"{source.name}: no earlier source is called {other!r}")
        if source.kind not in ORIGINAL and not source.of:
            raise ValueError(f"{source.name}: 'of' is missing")
        known.add(source.name)
    if not sum(source.weight for source in sources) > 0:
        raise ValueError("no source has a weight")
    if not any(source.validate for source in sources):
        raise ValueError("no source has validation pictures")
