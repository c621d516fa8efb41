"""Lengths measured by hand in a round: their table, and the round as they are compared with it."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cucumbervision.accuracy.own_truth import REPORTED, Measured, Reading
from cucumbervision.accuracy.truth import Line, Truth, parse_number, read_table, read_truth
from cucumbervision.errors import TruthError
from cucumbervision.methods.table import AVAILABLE
from cucumbervision_greenhouse.rounds.from_store import read_round
from cucumbervision_greenhouse.rounds.fruit_table import fruit_table
from cucumbervision_greenhouse.settings import replace_text
from cucumbervision_greenhouse.store.records import Verdict

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from cucumbervision.methods.result import LengthDefinition
    from cucumbervision_greenhouse.settings import Units
    from cucumbervision_greenhouse.store.records import FruitRow
    from cucumbervision_greenhouse.store.repository import Store

_SLIP = 2.0  # ratio to the program's length from which a length by hand is questioned
COLUMNS = ("capture", "fruit", "specimen", "length_1_cm", "length_2_cm", "kind")
_READ = ("capture", "fruit", "length_1_cm", "length_2_cm")
_RESTORE = "correct the file, or delete it and type the lengths again"
LENGTHS = 0.5, 100.0
"""Shortest and longest length that can be typed, in the unit of the page."""


def truth_folder(store: str) -> Path:
    """Return the folder of lengths by hand and calibrations: beside the store, or the user's own.

    Examples
    --------
    >>> truth_folder("house.db").name
    'house.truth'
    """
    if "://" not in store:
        return Path(store).with_suffix(".truth")
    import platformdirs

    return Path(platformdirs.user_data_dir("cucumbervision", appauthor=False)) / "truth"


def hand_file(store: str, round_key: str) -> Path:
    """Return the path of a round's lengths by hand.

    Examples
    --------
    >>> hand_file("house.db", "a").parts
    ('house.truth', 'a.csv')
    """
    return truth_folder(store) / f"{round_key}.csv"


def capture_name(view: FruitRow) -> str:
    """Return a capture's name, unique within a round."""
    return f"{view.stop_key}/{view.capture}"


def measured_round(store: Store, round_key: str) -> Measured:
    """Return a round as a run of `measure`, for evaluation and calibration.

    Parameters
    ----------
    store : Store
        Where it is.
    round_key : str
        The round.

    Returns
    -------
    Measured
        Every detection that nobody deleted a reading, captures named after stop and capture; its
        report names the cameras, as calibration asks for.
    """
    fruit = [v for v in store.detections(round_key) if v.verdict is not Verdict.REJECTED]
    table = {line.key: line for line in fruit_table(read_round(store, round_key))}
    readings = tuple(_reading(view, table.get(view.key, view)) for view in fruit)
    captures: list[dict[str, Any]] = []
    report: dict[str, Any] = {"captures": captures}
    for key in dict.fromkeys(view.stop_key for view in fruit):
        stop = store.stop(key)
        for capture in stop.captures:
            camera = dict(capture.camera)
            for name in ("fx", "fy", "cx", "cy"):
                camera[f"{name}_px"] = camera.pop(name)
            captures.append(
                {
                    "name": f"{key}/{capture.name}",
                    "intrinsics": camera,
                    "provenance": dict(capture.provenance),
                    "simulated": capture.simulated,
                    "fruit": [],
                }
            )
        report.update(_made_with(stop.artifacts))
    names = tuple(capture["name"] for capture in captures)
    return Measured(Path(f"round {round_key}"), readings, names, report)


def _made_with(artifacts: Sequence[Any]) -> dict[str, Any]:
    made_with: dict[str, Any] = {"models": []}
    for artifact in artifacts:
        if artifact.kind == "config":
            made_with |= {"config": dict(artifact.details), "config_sha256": artifact.sha256}
        elif artifact.kind == "software":
            made_with["software"] = artifact.name
        elif artifact.kind == "model":
            made_with["models"].append({"name": artifact.name, "sha256": artifact.sha256})
        elif artifact.kind == "calibration":
            made_with["calibration"] = dict(artifact.details)
    return made_with


def _reading(view: FruitRow, reported: FruitRow) -> Reading:
    """Return a find as a reading; what is reported is what all views of the fruit say."""
    lengths = {name: getattr(view, f"{name.lower()}_m") for name in AVAILABLE}
    measured = {name: length_m for name, length_m in lengths.items() if length_m is not None}
    # A method that fell back on a simpler one has its length.
    fell_back = {n for n, x in measured.items() if x in [measured[m] for m in measured if m < n]}
    if view.thread_m is not None:
        measured |= {"M6 thread": view.thread_m, "M6 chord": view.chord_m}
    return Reading(
        capture=capture_name(view),
        fruit=view.fruit,
        lengths_m={**measured, REPORTED: reported.length_m},
        fell_back=frozenset(fell_back),
        kind="" if view.length is None else str(view.length.kind),
        method=view.method or "",
        mask_source=view.mask_source or "",
        distance_m=_or_nan(view.distance_m),
        fill=_or_nan(view.fill),
        flags=view.flags,
    )


def write_hand_lengths(
    path: Path,
    fruit: Sequence[FruitRow],
    lengths: Mapping[str, tuple[float | None, float | None]],
    kind: LengthDefinition,
) -> int:
    """Write lengths by hand as the table that `accuracy.truth.read_truth` reads.

    Lines of other fruit, such as one that was deleted by mistake, stay in it.

    Parameters
    ----------
    path : Path
        The table; replaced in one step.
    fruit : sequence of FruitRow
        The fruit that could be measured by hand.
    lengths : mapping of str to tuple of float
        By fruit key: the first and second measurement in metres, or None.
    kind : LengthDefinition
        What was measured by hand.

    Returns
    -------
    int
        How many fruit have a length.
    """
    text = io.StringIO()
    table = csv.writer(text)
    table.writerow(COLUMNS)
    others = _lines_of_others(path, fruit)
    table.writerows(others)
    written = len(others)
    for view in fruit:
        first, second = lengths.get(view.key, (None, None))
        if first is None and second is None:
            continue
        cells = ["" if x is None else f"{100 * x:.2f}" for x in (first, second)]
        table.writerow([capture_name(view), view.fruit, view.group, *cells, str(kind)])
        written += 1
    replace_text(path, text.getvalue())
    return written


def _lines_of_others(path: Path, fruit: Sequence[FruitRow]) -> list[list[str]]:
    keys = {(capture_name(view), str(view.fruit)) for view in fruit}
    lines = read_table(path, TruthError).lines if path.exists() else ()
    cells = [[line.cells.get(name, "") for name in COLUMNS] for line in lines]
    return [line for line in cells if (line[0], line[1]) not in keys]


def truth_of(path: Path, measured: Measured) -> Truth:
    """Return the table's lengths of fruit that are measured; others were deleted since.

    Raises
    ------
    TruthError
        If the table is none.
    """
    truth, there = read_truth(path), {(r.capture, r.fruit) for r in measured.readings}
    lengths = tuple(x for x in truth.lengths if (x.capture, x.fruit) in there)
    return replace(truth, lengths=lengths)


def is_odd(record: FruitRow, hand_m: float | None) -> bool:
    """Tell whether a length by hand differs so much that it may be a slip: twice, or half.

    Examples
    --------
    >>> from cucumbervision.methods.result import Length
    >>> from cucumbervision_greenhouse.store.records import FruitRow
    >>> fruit = FruitRow(1, length=Length(0.25))
    >>> is_odd(fruit, 0.26), is_odd(fruit, 0.75), is_odd(fruit, 0.10), is_odd(fruit, None)
    (False, True, True, False)
    """
    if hand_m is None or record.length_m is None:
        return False
    ratio = hand_m / record.length_m
    return ratio < 1 / _SLIP or (ratio > _SLIP and not record.at_least)


def hand_lengths(
    path: Path, fruit: Sequence[FruitRow]
) -> dict[str, tuple[float | None, float | None]]:
    """Return the table by fruit key; empty where there is none.

    Raises
    ------
    TruthError
        If the table was changed, and is none any more.
    """
    if not path.exists():
        return {}
    table = read_table(path, TruthError)
    if missing := [name for name in _READ if name not in table.columns]:
        raise TruthError(
            "has no column {names}", source=path, remedy=_RESTORE, names=", ".join(missing)
        )
    keys = {(capture_name(view), str(view.fruit)): view.key for view in fruit}
    lengths: dict[str, tuple[float | None, float | None]] = {}
    for line in table.lines:
        key = keys.get((line.cells["capture"], line.cells["fruit"]))
        if key is not None:
            first, second = (_cell_m(line, name, path) for name in _READ[2:])
            lengths[key] = first, second
    return lengths


def _cell_m(line: Line, name: str, path: Path) -> float | None:
    if not (cell := line.cells[name]):
        return None
    value_cm = parse_number(cell)
    if value_cm is None or value_cm <= 0:
        raise TruthError(
            "line {number}: '{cell}' is no length",
            source=path,
            remedy=_RESTORE,
            number=line.number,
            cell=cell,
        )
    return value_cm / 100


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def typed_m(cell: str, units: Units) -> float | None:
    """Return a length as somebody typed it, metres; None for an empty cell.

    Raises
    ------
    ValueError
        If it is none, or far from any fruit's.

    Examples
    --------
    >>> from cucumbervision_greenhouse.settings import Units
    >>> typed_m("21.5", Units("cm")), typed_m(" 21,5 ", Units("cm")), typed_m("", Units("cm"))
    (0.215, 0.215, None)
    """
    if not cell.strip():
        return None
    value = float(cell.strip().replace(",", "."))
    if not LENGTHS[0] <= value <= LENGTHS[1]:
        raise ValueError(cell)
    return units.metres(value)
