"""Read the lengths of a run, and compare them with manual lengths, by method."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from textwrap import shorten
from typing import Any

import numpy as np

from cucumbervision.about import code_sha256
from cucumbervision.accuracy.statistics import Metrics, ReportTable, estimate, percent_errors, score
from cucumbervision.accuracy.truth import MISSED, Floor, TrueLength, Truth, floor_of
from cucumbervision.errors import (
    CucumberVisionError,
    Message,
    TruthError,
    as_errors_of,
    wrap_os_errors,
    wrap_reader_errors,
)
from cucumbervision.files import read_json, write_csv
from cucumbervision.methods.flags import LOWER_BOUND, NO_DEPTH
from cucumbervision.methods.result import LengthDefinition, MethodName, calibration_key

_KIND_OF = {calibration_key(MethodName.M6, kind): kind for kind in LengthDefinition}

_LONGEST_M, _SHORTEST_M = 1.0, 0.01

_LEAST_FRUIT = 3

# Ratio of manual to measured length, tolerance, likely unit, remedy.
_UNITS = (
    (10.0, 1.8, "10 times that: millimetres", "divide by 10"),
    (0.1, 1.8, "a tenth of that: decimetres", "multiply by 10"),
    (0.01, 2.5, "a hundredth of that: metres", "multiply by 100"),
    (1 / 2.54, 1.1, "0.39 of that: inches", "multiply by 2.54"),
)


@dataclass(frozen=True, kw_only=True)
class MethodScore(Metrics):
    """Accuracy of one method for one definition of length.

    Its metrics are those over all captures; a missing length counts as an error of 100 %.

    Parameters
    ----------
    method : str
        A key of `Reading.lengths_m`.
    kind : LengthDefinition
        Definition of the manual length.
    low_percent, high_percent : float
        95 % bootstrap interval of the mean error, resampled by fruit; NaN with less than three
        fruit.
    fruit : int
        Number of physical fruit.
    """

    method: str
    kind: LengthDefinition
    low_percent: float
    high_percent: float
    fruit: int


@dataclass(frozen=True)
class OwnTruth:
    """Result of an evaluation.

    Parameters
    ----------
    pairs : tuple of (TrueLength, Reading)
        Manual lengths and their readings.
    scores : tuple of MethodScore
        Scores by definition and method.
    floor : Floor or None
        Repeatability of the manual measurement.
    notes : tuple of str
        Notes on the interpretation.
    """

    pairs: tuple[tuple[TrueLength, Reading], ...]
    scores: tuple[MethodScore, ...]
    floor: Floor | None
    notes: tuple[str, ...]


def evaluate_lengths(measured: Measured, truth: Truth) -> OwnTruth:
    """Evaluate every method of a run against manual lengths.

    Raises
    ------
    TruthError
        If the table refers to unknown captures or fruit, or is not in centimetres.
    """
    pairs = match_truth(measured, truth)
    floor = floor_of(truth.lengths)
    notes = _notes(truth, floor, pairs)
    if measured.report.get("code_sha256") not in (None, code_sha256()):
        notes.append(Message("Another version of this software measured these lengths."))
    simulated = {c["name"] for c in measured.report.get("captures", []) if c.get("simulated")}
    if any(length.capture in simulated for length, _ in pairs):
        notes.append(Message("Some of these captures are simulated."))
    return OwnTruth(tuple(pairs), tuple(_score_methods(pairs)), floor, tuple(notes))


def match_truth(measured: Measured, truth: Truth) -> list[tuple[TrueLength, Reading]]:
    """Return the reading of each manually measured fruit.

    A fruit that was not detected gets a reading without lengths.

    Raises
    ------
    TruthError
        With the line number, if a capture or fruit is unknown, the median ratio to the measured
        lengths indicates another unit than centimetres, or a length is implausible.
    """
    readings = {(r.capture, r.fruit): r for r in measured.readings}
    ran = sorted({key for r in measured.readings for key in r.lengths_m})
    counts = Counter(r.capture for r in measured.readings)
    pairs = []
    with as_errors_of(truth.path):
        for length in truth.lengths:
            if length.capture not in measured.captures:
                names = shorten(", ".join(measured.captures), 60, placeholder=" …")
                raise TruthError(
                    f"line {length.line}: capture '{length.capture}' is not among the measurements "
                    f"of {measured.path} ({names})",
                    remedy="measure it, correct its name, or drop the line",
                )
            if length.fruit is not None and (length.capture, length.fruit) not in readings:
                raise TruthError(
                    f"line {length.line}: capture '{length.capture}' has {counts[length.capture]} "
                    f"measured fruit, no number {length.fruit}",
                    remedy=f"see the numbers in the overlay; write '{MISSED}' for a fruit that the "
                    "run did not find",
                )
            missed = Reading(length.capture, 0, dict.fromkeys(ran), flags=MISSED)
            pairs.append((length, readings.get((length.capture, length.fruit or 0), missed)))
        _require_centimetres(pairs)
    return pairs


def comparable(method: str, kind: LengthDefinition, reported_kind: str) -> bool:
    """Return whether a method's length is comparable with a definition of length.

    The three lengths of M6 are compared with the same definition, those of M1 to M5 with every
    definition. The reported length is compared with its own definition, or with all if unknown.

    Examples
    --------
    >>> chord = LengthDefinition.CHORD
    >>> comparable("M5", chord, "thread"), comparable("M6", chord, "thread")
    (True, False)
    >>> comparable("reported", chord, "thread")
    False
    """
    if method == REPORTED:
        return reported_kind not in {str(k) for k in LengthDefinition} or reported_kind == str(kind)
    return _KIND_OF.get(method, kind) is kind


def _score_methods(pairs: Sequence[tuple[TrueLength, Reading]]) -> Iterator[MethodScore]:
    """Score each method for each comparable definition of length."""
    methods = list(dict.fromkeys(key for _, reading in pairs for key in reading.lengths_m))
    for kind, method in product(LengthDefinition, methods):
        chosen = [
            (reading.lengths_m[method] or math.nan, length.length_m, length.specimen)
            for length, reading in pairs
            if length.kind is kind
            and method in reading.lengths_m
            and comparable(method, kind, reading.kind)
        ]
        if not chosen:
            continue
        lengths, truth, fruit = zip(*chosen, strict=True)
        error = estimate(percent_errors(lengths, truth), fruit, resamples=10_000)
        if error.groups < _LEAST_FRUIT:
            error = replace(error, low=math.nan, high=math.nan)
        yield MethodScore(
            **vars(score(lengths, truth)),
            method=method,
            kind=kind,
            low_percent=error.low,
            high_percent=error.high,
            fruit=error.groups,
        )


def _require_centimetres(pairs: Sequence[tuple[TrueLength, Reading]]) -> None:
    measured = [(length, [x for x in reading.lengths_m.values() if x]) for length, reading in pairs]
    ratios = [
        length.length_m / float(np.median(lengths_m)) for length, lengths_m in measured if lengths_m
    ]
    ratio = float(np.median(ratios)) if ratios else 1.0
    for usual_ratio, factor, words, remedy in _UNITS:
        if usual_ratio / factor < ratio < usual_ratio * factor:
            raise TruthError(
                "the lengths are not in centimetres: their median is {ratio:.3g} times what "
                "was measured, about {words}",
                remedy="{advice}; the columns hold centimetres",
                ratio=ratio,
                words=words,
                advice=remedy,
            )
    for length, _ in pairs:
        for length_m in length.lengths_m:
            if not _SHORTEST_M <= length_m <= _LONGEST_M:
                raise TruthError(
                    "line {number}: {length:g} cm is not a plausible length",
                    remedy="give centimetres, between 1 and 100",
                    number=length.line,
                    length=100 * length_m,
                )


def _notes(
    truth: Truth, floor: Floor | None, pairs: Sequence[tuple[TrueLength, Reading]]
) -> list[Message]:
    notes: list[Message] = []

    def note(template: str, **parts: object) -> None:
        notes.append(Message(template, **parts))

    missed = sum(reading.flags == MISSED for _, reading in pairs)
    in_part = sum(not reading.is_whole for _, reading in pairs)
    note("Hand-measured lengths: {file}, {count} of them.", file=truth.path.name, count=len(pairs))
    if floor is None:
        note("No fruit was measured twice by hand, so the floor is not known.")
    else:
        note(
            "Floor: one measurement by hand has a standard deviation of {sd_mm:.2f} mm "
            "({sd_percent:.2f} %), from {measurements} measurements of {specimens} fruit.",
            **vars(floor),
        )
    if not truth.specimens_named:
        note(
            "No column 'specimen': each fruit of each capture counts as a fruit of its own. If "
            "some were captured several times, name them, or the intervals are too narrow."
        )
    if in_part:
        note(
            "{count} fruit go on out of sight, or have a flag of wrong depth: they count as "
            "errors here, and a calibration leaves them out.",
            count=in_part,
        )
    if missed:
        note("{count} fruit were not found at all and count as 100 % error.", count=missed)
    if truth.unused:
        note("Columns not used: {names}.", names=", ".join(truth.unused))
    return notes


def write_own_truth(evaluation: OwnTruth, out: Path) -> None:
    """Write `scores.csv` and `lengths.csv` to a folder.

    `lengths.csv` has a row for each manual length with the length of each method in centimetres.

    Raises
    ------
    CucumberVisionError
        If the folder is not writable, or there are no scores.
    """
    if not evaluation.pairs:
        raise CucumberVisionError(
            "there is nothing to report", source=out, remedy="measure at least one fruit first"
        )
    lengths = [
        {
            "capture": length.capture,
            "fruit": length.fruit,
            "specimen": length.specimen,
            "kind": str(length.kind),
            "true_cm": 100 * length.length_m,
            **{f"{key}_cm": x and 100 * x for key, x in reading.lengths_m.items()},
        }
        for length, reading in evaluation.pairs
    ]
    scores = [
        {"method": score.method, "kind": score.kind, **vars(score)} for score in evaluation.scores
    ]
    with wrap_os_errors("cannot be written", out):
        out.mkdir(parents=True, exist_ok=True)
        for name, rows in (("lengths", lengths), ("scores", scores)):
            columns = dict.fromkeys(key for row in rows for key in row)
            lines = ({key: row.get(key) for key in columns} for row in rows)
            write_csv(out / f"{name}.csv", list(columns), lines)


_SCORES = {
    "kind": "truth",
    "method": "method",
    "count": "captures",
    "fruit": "fruit",
    "measured_percent": "measured %:.0",
    "mae_cm": "MAE cm",
    "mape_percent": "MAPE %",
    "low_percent": "95 % by fruit, from",
    "high_percent": "to",
    "median_percent": "median %",
    "worst_percent": "worst %",
    "bias_percent": "bias %:+.2",
}


def scores_table(scores: Sequence[MethodScore]) -> ReportTable:
    """Return the errors of each method for each definition of length."""
    rows = [vars(score) | {"measured_percent": 100 * score.measured} for score in scores]
    return ReportTable.of_records("Errors against hand-measured lengths", _SCORES, rows)


REPORTED = "reported"
_COLUMNS = {f"M{k}": f"m{k}_cm" for k in range(1, 7)}
_COLUMNS |= {"M6 thread": "thread_cm", "M6 chord": "chord_cm"}
_LONGEST_CM = 10_000
_REMEDY = "give the folder of a `measure` run, or its measurements.json"


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
    kind, mask_source : str
        Definition and mask source of the reported length; empty if unknown.
    flags : str
        Flags of the row.
    """

    capture: str
    fruit: int
    lengths_m: dict[str, float | None]
    fell_back: frozenset[str] = frozenset()
    kind: str = ""
    mask_source: str = ""
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
        All captures, including those without fruit.
    report : mapping
        Contents of `measurements.json`, for camera and provenance.
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
        Folder of a `measure` run, its `measurements.json`, or a table beside that file.

    Raises
    ------
    CucumberVisionError
        If the file is not the output of a run, or contains no fruit.
    """
    path = path / "measurements.json" if path.is_dir() else path.with_suffix(".json")
    report = read_json(path, CucumberVisionError, _REMEDY)
    with wrap_reader_errors(path, remedy=_REMEDY):
        captures = report.get("captures", [])
        rows = [row for capture in captures for row in capture["fruit"]]
        asked = report.get("config", {}).get("methods", [])
        ran = [
            key
            for key, column in _COLUMNS.items()
            if key in asked or any(row.get(column) is not None for row in rows)
        ]
        readings = tuple(_reading(row, ran) for row in rows)
    if not readings:
        raise CucumberVisionError("holds no fruit", source=path, remedy="measure captures first")
    return Measured(path, readings, tuple(str(capture["name"]) for capture in captures), report)


def _reading(row: Mapping[str, Any], ran: Sequence[str]) -> Reading:
    lengths = {key: _metres(row.get(_COLUMNS[key])) for key in ran}
    methods = row.get("methods", {})
    return Reading(
        capture=str(row["capture"]),
        fruit=int(row["fruit"]),
        lengths_m={**lengths, REPORTED: _metres(row.get("length_cm"))},
        fell_back=frozenset(m for m, outcome in methods.items() if outcome.get("fallback")),
        kind=str(row.get("length_kind") or ""),
        mask_source=str(row.get("mask_source") or ""),
        flags=str(row.get("flags") or ""),
    )


def _metres(length_cm: float | None) -> float | None:
    if length_cm is not None and not 0 < length_cm < _LONGEST_CM:
        raise ValueError(f"{length_cm:g} cm is not a valid length")
    return None if length_cm is None else length_cm / 100
