"""Read the results of a `measure` run from its folder, JSON or CSV file."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cucumbervision.accuracy.truth import parse_number, read_table
from cucumbervision.errors import CucumberVisionError, wrap_reader_errors
from cucumbervision.files import read_json
from cucumbervision.measurement.flags import LOWER_BOUND, NO_DEPTH

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

REPORTED = "reported"
_TUBE_COLUMNS = {"M6 thread": "thread_cm", "M6 chord": "chord_cm"}
_METHOD_COLUMNS = {f"M{k}": f"m{k}_cm" for k in range(1, 7)}
_LONGEST_CM = 10_000
_REMEDY = "give the folder of a `measure` run, or its measurements.json or measurements.csv"


@dataclass(frozen=True)
class Reading:
    """One measured fruit.

    Parameters
    ----------
    capture : str
        Name of the capture.
    fruit : int
        Number of the fruit in it, from 1.
    lengths_m : dict of str to float or None
        Uncorrected lengths of 'M1' … 'M6' (centreline), 'M6 thread' and 'M6 chord', and 'reported'
        (`length_cm`); None if the method failed, no key if it was not run.
    fell_back : frozenset of str
        Methods that fell back to another method.
    kind, method, mask_source : str
        Definition, method and mask source of the reported length; empty if unknown.
    distance_m, fill : float
        Distance and depth fill of the fruit; NaN if unknown.
    flags : str
        Flags of the row.
    """

    capture: str
    fruit: int
    lengths_m: dict[str, float | None]
    fell_back: frozenset[str] = frozenset()
    kind: str = ""
    method: str = ""
    mask_source: str = ""
    distance_m: float = math.nan
    fill: float = math.nan
    flags: str = ""

    @property
    def is_whole(self) -> bool:
        """Whether all of the fruit was measured, and at its distance.

        Examples
        --------
        >>> Reading("a", 1, {}, flags="ends-unsure").is_whole
        True
        >>> Reading("a", 1, {}, flags="end-hidden").is_whole
        False
        """
        return (LOWER_BOUND | NO_DEPTH).isdisjoint(self.flags.split())


@dataclass(frozen=True)
class Measured:
    """Results of a run.

    Parameters
    ----------
    path : Path
        The file that was read.
    readings : tuple of Reading
        Readings in the order of the file.
    captures : tuple of str
        All captures, including those without fruit if the file lists them.
    report : mapping
        Contents of `measurements.json`, for camera and provenance; empty without it.
    """

    path: Path
    readings: tuple[Reading, ...]
    captures: tuple[str, ...]
    report: Mapping[str, Any] = field(default_factory=dict)


def read_measured(path: Path) -> Measured:
    """Read the measurements of a run.

    Parameters
    ----------
    path : Path
        Folder of a `measure` run, its `measurements.json`, or its `measurements.csv`. With the CSV,
        camera and provenance come from the JSON in the same folder, if there is one.

    Raises
    ------
    CucumberVisionError
        If the file is not the output of a run, or contains no fruit.
    """
    if path.is_dir():
        tables = [p for n in ("json", "csv") if (p := path / f"measurements.{n}").exists()]
        if not tables:
            raise CucumberVisionError("holds no measurements", source=path, remedy=_REMEDY)
        path = tables[0]
    report_path = path.with_suffix(".json")
    report = _read_report(report_path) if report_path.exists() else {}
    with wrap_reader_errors(path, remedy=_REMEDY):
        if path.suffix.lower() == ".json":
            if not report:
                raise CucumberVisionError("is missing", source=path, remedy=_REMEDY)
            rows = [row for capture in report["captures"] for row in capture["fruit"]]
            names = [str(capture["name"]) for capture in report["captures"]]
        else:
            table = read_table(path)
            rows = [_parsed_cells(line.cells) for line in table.lines]
            names = []
            if not {"capture", "fruit", "length_cm"} <= set(table.columns):
                raise CucumberVisionError("holds no measurements", source=path, remedy=_REMEDY)
        ran = _keys_that_ran(rows, report)
        readings = tuple(_reading(row, ran) for row in rows)
    if not readings:
        raise CucumberVisionError("holds no fruit", source=path, remedy="measure captures first")
    captures = tuple(dict.fromkeys([*names, *(r.capture for r in readings)]))
    return Measured(path, readings, captures, report)


def _read_report(path: Path) -> dict[str, Any]:
    report = read_json(path, CucumberVisionError, _REMEDY)
    captures = report.get("captures") if isinstance(report, dict) else None
    is_report = isinstance(captures, list) and all(
        isinstance(c, dict)
        and {"name", "fruit", "intrinsics"} <= set(c)
        and isinstance(c["intrinsics"], dict)
        for c in captures
    )
    if not is_report:
        raise CucumberVisionError("holds no measurements", source=path, remedy=_REMEDY)
    return dict(report)


def _parsed_cells(cells: Mapping[str, str]) -> dict[str, Any]:
    numbers = {"fruit", "fill"} | {name for name in cells if name.endswith("_cm")}
    return {k: parse_number(v) if k in numbers else v for k, v in cells.items()}


def _keys_that_ran(rows: Sequence[Mapping[str, Any]], report: Mapping[str, Any]) -> list[str]:
    """Return the methods that were run, according to the report or because they have lengths."""
    columns = {**_METHOD_COLUMNS, **_TUBE_COLUMNS}
    asked = report.get("config", {}).get("methods", [])
    return [
        key
        for key, column in columns.items()
        if key in asked or any(row.get(column) is not None for row in rows)
    ]


def _reading(row: Mapping[str, Any], ran: Sequence[str]) -> Reading:
    columns = {**_METHOD_COLUMNS, **_TUBE_COLUMNS}
    lengths = {key: _metres(row.get(columns[key])) for key in ran}
    methods = row.get("methods", {})
    distance = _metres(row.get("distance_cm"))
    return Reading(
        capture=str(row["capture"]),
        fruit=int(row["fruit"]),
        lengths_m={**lengths, REPORTED: _metres(row.get("length_cm"))},
        fell_back=frozenset(m for m, outcome in methods.items() if outcome.get("fallback")),
        kind=_word(row, "length_kind"),
        method=_word(row, "method"),
        mask_source=_word(row, "mask_source"),
        distance_m=math.nan if distance is None else distance,
        fill=math.nan if row.get("fill") is None else float(row["fill"]),
        flags=_word(row, "flags"),
    )


def _word(row: Mapping[str, Any], name: str) -> str:
    text = row.get(name) or ""
    if not isinstance(text, str):
        raise ValueError(f"{name} is not text")
    return text


def _metres(length_cm: float | None) -> float | None:
    if length_cm is not None and not 0 < length_cm < _LONGEST_CM:
        raise ValueError(f"{length_cm:g} cm is not a valid length")
    return None if length_cm is None else length_cm / 100
