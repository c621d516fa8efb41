"""Lengths measured by hand on a round's fruit, beside the program's own."""

from __future__ import annotations

import csv
import io
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cucumbervision.accuracy.measured import REPORTED, Measured, Reading
from cucumbervision.measurement.result import LengthDefinition

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from cucumbervision.store.records import MethodRecord
    from cucumbervision.store.repository import Store
    from cucumbervision.store.views import DetectionView

__all__ = ["capture_name", "hand_file", "hand_lengths", "measured_round", "write_hand_lengths"]

COLUMNS = ("capture", "fruit", "specimen", "length_1_cm", "length_2_cm", "kind")


def hand_file(store: str, round_key: str) -> Path:
    """Return the path of a round's lengths by hand: beside an SQLite file, else the user's own.

    Examples
    --------
    >>> hand_file("house.db", "a").parts
    ('house.truth', 'a.csv')
    """
    if "://" in store:
        import platformdirs

        folder = Path(platformdirs.user_data_dir("cucumbervision", appauthor=False)) / "truth"
    else:
        folder = Path(store).with_suffix(".truth")
    return folder / f"{round_key}.csv"


def capture_name(view: DetectionView) -> str:
    """Return a capture's name, unique within a round."""
    return f"{view.stop_key}/{view.capture}"


def measured_round(
    store: Store, round_key: str, methods: Mapping[str, Sequence[MethodRecord]]
) -> Measured:
    """Return a round as a run of `measure`, for evaluation and calibration.

    Parameters
    ----------
    store : Store
        Where it is.
    round_key : str
        The round.
    methods : mapping of str to sequence of MethodRecord
        By fruit key, as `Store.measurements` gives them.

    Returns
    -------
    Measured
        Every detection a reading, captures named after stop and capture; its report names the
        cameras, as calibration asks for.
    """
    fruit = store.detections(round_key)
    readings = tuple(_reading(view, methods.get(view.key, ())) for view in fruit)
    captures: list[dict[str, Any]] = []
    report: dict[str, Any] = {"captures": captures}
    for key in dict.fromkeys(view.stop_key for view in fruit):
        stop = store.stop(key)
        for one in stop.captures:
            camera = dict(one.camera)
            for name in ("fx", "fy", "cx", "cy"):
                camera[f"{name}_px"] = camera.pop(name)
            captures.append(
                {
                    "name": f"{key}/{one.name}",
                    "intrinsics": camera,
                    "provenance": dict(one.provenance),
                    "simulated": one.simulated,
                    "fruit": [],
                }
            )
        report.update(_made_with(stop.artifacts))
    names = tuple(one["name"] for one in captures)
    return Measured(Path(f"round {round_key}"), readings, names, report)


def _made_with(artifacts: Sequence[Any]) -> dict[str, Any]:
    found: dict[str, Any] = {"models": []}
    for one in artifacts:
        if one.kind == "config":
            found |= {"config": dict(one.details), "config_sha256": one.sha256}
        elif one.kind == "software":
            found["software"] = one.name
        elif one.kind == "model":
            found["models"].append({"name": one.name, "sha256": one.sha256})
        elif one.kind == "calibration":
            found["calibration"] = dict(one.details)
    return found


def _reading(view: DetectionView, methods: Sequence[MethodRecord]) -> Reading:
    record = view.record
    lengths = {one.method: one.length_m for one in methods}
    tube = next((one for one in methods if one.thread_m is not None), None)
    if tube is not None:
        lengths |= {"M6 thread": tube.thread_m, "M6 chord": tube.chord_m}
    return Reading(
        capture=capture_name(view),
        fruit=record.number,
        lengths_m={**lengths, REPORTED: record.length_m},
        fell_back=frozenset(one.method for one in methods if one.measured_by),
        kind=record.length_kind or "",
        method=record.method or "",
        mask_source=record.mask_source or "",
        distance_m=_or_nan(record.distance_m),
        fill=_or_nan(record.fill),
        tilt_deg=_or_nan(record.tilt_deg),
        flags=record.flags,
    )


def write_hand_lengths(
    path: Path,
    fruit: Sequence[DetectionView],
    lengths: Mapping[str, tuple[float | None, float | None]],
    kind: LengthDefinition,
) -> int:
    """Write lengths by hand as the table that `accuracy.truth.read_truth` reads.

    Parameters
    ----------
    path : Path
        The table; replaced in one step.
    fruit : sequence of DetectionView
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
    written = 0
    for view in fruit:
        first, second = lengths.get(view.key, (None, None))
        if first is None and second is None:
            continue
        cells = ["" if x is None else f"{100 * x:.2f}" for x in (first, second)]
        table.writerow([capture_name(view), view.record.number, view.group, *cells, str(kind)])
        written += 1
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_text(text.getvalue(), encoding="utf-8")
    temporary.replace(path)
    return written


def hand_lengths(
    path: Path, fruit: Sequence[DetectionView]
) -> dict[str, tuple[float | None, float | None]]:
    """Return the table by fruit key; empty where there is none."""
    if not path.exists():
        return {}
    keys = {(capture_name(view), str(view.record.number)): view.key for view in fruit}
    found: dict[str, tuple[float | None, float | None]] = {}
    with path.open(encoding="utf-8", newline="") as stream:
        for line in csv.DictReader(stream):
            key = keys.get((line["capture"], line["fruit"]))
            if key is not None:
                found[key] = (_metres(line["length_1_cm"]), _metres(line["length_2_cm"]))
    return found


def _metres(cell: str) -> float | None:
    return float(cell) / 100 if cell else None


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value
