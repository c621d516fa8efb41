"""A round out of the store as typed tables."""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from statistics import fmean, stdev
from typing import TYPE_CHECKING, Any

from cucumbervision._version import __version__
from cucumbervision.about import LICENCE, source_offer
from cucumbervision.agronomy.picking import pick_list, plan_work
from cucumbervision.errors import CucumberVisionError, ForecastError
from cucumbervision.exports.tables import (
    COLUMNS,
    Charts,
    RoundTables,
    Table,
    class_days,
    length_bins,
)
from cucumbervision.measurement.result import Method
from cucumbervision.rounds.forecasting import forecast_for, grade_of
from cucumbervision.rounds.from_store import read_round
from cucumbervision.rounds.service import DAY_S, fruit_table, row_reports

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from cucumbervision.agronomy.forecast import Counts, Forecast
    from cucumbervision.agronomy.picking import Rates
    from cucumbervision.agronomy.profiles import CropProfile
    from cucumbervision.rounds.from_store import RoundContent
    from cucumbervision.rounds.service import RoundFruit, RowReport
    from cucumbervision.store.records import DetectionRecord, ImageRef, MethodRecord
    from cucumbervision.store.repository import Store
    from cucumbervision.store.views import DetectionView, RoundView, StopView

__all__ = [
    "StopArtifacts",
    "forecast_records",
    "fruit_records",
    "hashes_of",
    "pick_records",
    "round_tables",
    "scaled",
    "stop_artifacts",
    "utc",
    "work_records",
]


@dataclass(frozen=True)
class StopArtifacts:
    """What stops were measured with.

    Parameters
    ----------
    by_stop : mapping of str to tuple of (kind, name, sha256)
        By the stops' keys.
    counted : tuple of mapping
        Each once: kind, name, sha256 and the number of stops.
    """

    by_stop: Mapping[str, tuple[tuple[str, str, str], ...]]
    counted: tuple[dict[str, Any], ...]


def stop_artifacts(store: Store, round_key: str) -> StopArtifacts:
    """Read models, calibrations and options of a round's stops, in one query."""
    from sqlalchemy import select

    from cucumbervision.store.engine import begin
    from cucumbervision.store.schema import Artifact, Round, StopArtifact, StopLine

    query = (
        select(StopLine.key, Artifact.kind, Artifact.name, Artifact.sha256)
        .join(StopArtifact, StopArtifact.stop_id == StopLine.id)
        .join(Artifact, Artifact.id == StopArtifact.artifact_id)
        .join(Round, Round.id == StopLine.round_id)
        .where(Round.key == round_key)
        .order_by(StopLine.id, StopArtifact.number)
    )
    by_stop: dict[str, list[tuple[str, str, str]]] = {}
    with begin(store.engine) as connection:
        for key, kind, name, sha256 in connection.execute(query):
            by_stop.setdefault(key, []).append((kind, name, sha256))
    counts = Counter(one for used in by_stop.values() for one in used)
    return StopArtifacts(
        {key: tuple(used) for key, used in by_stop.items()},
        tuple(
            {"kind": kind, "name": name, "sha256": sha256, "stops": number}
            for (kind, name, sha256), number in sorted(counts.items())
        ),
    )


def hashes_of(artifacts: StopArtifacts, stop_key: str) -> dict[str, str]:
    """Give the hashes of a stop's options, networks and calibration; several by blanks."""
    used = artifacts.by_stop.get(stop_key, ())
    return {
        column: " ".join(sha256 for kind, _, sha256 in used if kind == wanted and sha256)
        for column, wanted in (
            ("config_sha256", "config"),
            ("models_sha256", "model"),
            ("calibration_sha256", "calibration"),
        )
    }


def utc(seconds: float | None) -> str | None:
    """Give a time as people and programs read it; None stays None.

    Examples
    --------
    >>> utc(86400.5)
    '1970-01-02T00:00:00Z'
    """
    if seconds is None:
        return None
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def fruit_records(
    lines: Sequence[RoundFruit],
    methods: Mapping[str, Sequence[MethodRecord]],
    profile: CropProfile | None,
    forecast: Forecast | None,
    artifacts: StopArtifacts,
    pictures: Mapping[str, str],
) -> list[dict[str, Any]]:
    """Fill the rows of the table 'fruit'.

    Parameters
    ----------
    lines : sequence of RoundFruit
        From `service.fruit_table`.
    methods : mapping
        `Store.measurements`.
    profile : CropProfile, optional
        For the grades.
    forecast : Forecast, optional
        For the probability to be ready.
    artifacts : StopArtifacts
        What the stops were measured with.
    pictures : mapping of str to str
        Names of small pictures by their hash.
    """
    ready = {} if forecast is None else _ready(forecast)
    return [
        {
            "number": line.number,
            **_place(line.view),
            **_lengths(line.view.record),
            "combined_cm": scaled(line.combined_m, 100),
            "combined_sd_cm": scaled(line.combined_sd_m, 100),
            **_grade(line.view.record, profile),
            "ready_today": ready.get(line.view.key),
            **_methods(methods.get(line.view.key, ())),
            **_traits(line.view.record),
            "views": line.seen,
            **_marks(line.view, pictures),
            **hashes_of(artifacts, line.view.stop_key),
        }
        for line in lines
    ]


def scaled(value: float | None, per_unit: float, digits: int = 3) -> float | None:
    """Give a length or volume in another unit, rounded; None stays None.

    Examples
    --------
    >>> scaled(0.31234567, 100), scaled(None, 100)
    (31.235, None)
    """
    return None if value is None else round(per_unit * value, digits)


def _ready(forecast: Forecast) -> dict[str, float]:
    return {
        one.fruit_id: round(float(share), 4)
        for one, share in zip(forecast.fruit, forecast.ready, strict=True)
    }


def _place(view: DetectionView) -> dict[str, Any]:
    return {
        "key": view.key,
        "row": view.row,
        "side": view.side,
        "along_m": scaled(view.along_m, 1, 4),
        "along_sd_m": scaled(view.along_sd_m, 1, 4),
    }


def _lengths(record: DetectionRecord) -> dict[str, Any]:
    return {
        "length_cm": scaled(record.length_m, 100),
        "length_kind": record.length_kind,
        "interval_low_cm": scaled(record.interval_low_m, 100),
        "interval_high_cm": scaled(record.interval_high_m, 100),
        "interval_of": record.interval_of,
        "thread_cm": scaled(record.thread_m, 100),
        "centreline_cm": scaled(record.centreline_m, 100),
        "chord_cm": scaled(record.chord_m, 100),
    }


def _grade(record: DetectionRecord, profile: CropProfile | None) -> dict[str, Any]:
    if profile is None:
        names = ("grade", "grade_verdict", "grade_probability", "grade_rule")
        return dict.fromkeys((*names, "weight_class", "shape", "mass_g"))
    found = grade_of(record, profile)
    share = found.probabilities.get(found.name)
    return {
        "grade": found.name,
        "grade_verdict": str(found.verdict),
        "grade_probability": None if share is None else round(share, 4),
        "grade_rule": found.rules[0] if found.rules else "; ".join(found.missing),
        "weight_class": found.weight_class,
        "shape": found.shape,
        "mass_g": scaled(found.mass_g, 1, 1),
    }


def _methods(found: Sequence[MethodRecord]) -> dict[str, Any]:
    lengths = {one.method.upper(): one.length_m for one in found}
    return {f"{m.value.lower()}_cm": scaled(lengths.get(m.value.upper()), 100) for m in Method}


def _traits(record: DetectionRecord) -> dict[str, Any]:
    return {
        "inner_arc_mm": scaled(record.inner_arc_m, 1000),
        "diameter_max_mm": scaled(record.diameter_max_m, 1000),
        "diameter_mean_mm": scaled(record.diameter_mean_m, 1000),
        "volume_ml": scaled(record.volume_m3, 1e6),
        "method": record.method,
        "reason": record.reason,
        "fallback": record.fallback,
        "flags": record.flags,
        "score": scaled(record.score, 1, 4),
        "distance_cm": scaled(record.distance_m, 100),
        "tilt_deg": scaled(record.tilt_deg, 1),
        "hidden_share": scaled(record.hidden_share, 1, 4),
        "fill": scaled(record.fill, 1, 4),
    }


def _marks(view: DetectionView, pictures: Mapping[str, str]) -> dict[str, Any]:
    return {
        "verdict": view.verdict and str(view.verdict),
        "corrected": view.corrected,
        "picked_utc": utc(view.picked_s),
        "capture": view.capture,
        "stop_key": view.stop_key,
        "taken_utc": utc(view.taken_s),
        "simulated": view.simulated,
        "picture": view.thumbnail and pictures.get(view.thumbnail.sha256),
    }


def forecast_records(forecast: Forecast | None, started_s: float) -> list[dict[str, Any]]:
    """Fill the rows of the table 'forecast': the house, then its rows; by day and class."""
    if forecast is None:
        return []
    scopes: list[tuple[str, str | None, int | None]] = [("house", None, None)]
    scopes += [("row", row, number) for number, row in enumerate(forecast.rows)]
    return [
        {
            "scope": scope,
            "row": row,
            "day": day,
            "date_utc": _date(started_s, day),
            "class": name,
            "picked_class": name in forecast.pick,
            **_counts("", forecast.house if at is None else forecast.by_row, at, k, c),
            **_counts(
                "newly_ready", forecast.picks if at is None else forecast.row_picks, at, k, c
            ),
            "complete": bool(forecast.complete[k, c]),
        }
        for scope, row, at in scopes
        for k, day in enumerate(forecast.days.tolist())
        for c, name in enumerate(forecast.classes)
    ]


def _counts(name: str, counts: Counts, row: int | None, day: int, cls: int) -> dict[str, float]:
    at = (day, cls) if row is None else (row, day, cls)
    return {
        name or "expected": round(float(counts.expected[at]), 3),
        f"{name}_low".lstrip("_"): float(counts.low[at]),
        f"{name}_high".lstrip("_"): float(counts.high[at]),
    }


def pick_records(forecast: Forecast | None, lines: Sequence[RoundFruit]) -> list[dict[str, Any]]:
    """Fill the rows of the table 'picks', in the order of the walk."""
    if forecast is None:
        return []
    numbers = {line.view.key: line.number for line in lines}
    return [
        {
            "order": order,
            "number": numbers.get(pick.fruit.fruit_id),
            "row": pick.fruit.row,
            "side": pick.fruit.side,
            "along_m": scaled(pick.fruit.position_m, 1, 4),
            "length_cm": scaled(pick.fruit.length_m, 100),
            "class": pick.name,
            "ready": round(pick.ready, 4),
            "key": pick.fruit.fruit_id,
        }
        for order, pick in enumerate(pick_list(forecast), 1)
    ]


def work_records(
    forecast: Forecast | None, started_s: float, rates: Rates | None
) -> list[dict[str, Any]]:
    """Fill the rows of the table 'work'."""
    if forecast is None:
        return []
    return [
        {
            "day": work.day,
            "date_utc": _date(started_s, work.day),
            "fruit": round(work.fruit.expected, 2),
            "fruit_low": work.fruit.low,
            "fruit_high": work.fruit.high,
            "hours": round(work.hours.expected, 3),
            "hours_low": round(work.hours.low, 3),
            "hours_high": round(work.hours.high, 3),
            "crates": sum(crates.expected for crates in work.crates.values()),
            "complete": work.complete,
        }
        for work in plan_work(forecast, rates)
    ]


def _date(started_s: float, day: int) -> str:
    return (utc(started_s + day * DAY_S) or "")[:10]


PICTURES = "pictures"


def round_tables(
    store: Store,
    round_key: str,
    profile: CropProfile | None = None,
    *,
    profile_name: str = "",
    days: int = 7,
    rates: Rates | None = None,
    pictures: bool = True,
) -> RoundTables:
    """Make all tables of a round.

    Parameters
    ----------
    store : Store
        The store.
    round_key : str
        The round, by its key.
    profile : CropProfile, optional
        For grades and the forecast; without one they stay empty.
    profile_name : str
        What the profile is called; by default its title.
    days : int
        Days of the forecast.
    rates : Rates, optional
        Of picking, for hours and crates.
    pictures : bool
        Whether the small pictures are named, to be copied along.

    Raises
    ------
    StoreError, RoundError
        If the round is not there, or cannot be read.
    """
    view = _round(store, round_key)
    content = read_round(store, round_key)
    lines, stops = fruit_table(content), content.stops
    reports = row_reports(content)
    artifacts = stop_artifacts(store, round_key)
    forecast, note = _forecast(store, content, profile, days)
    kept = _pictures(store, [*(s.thumbnail for s in stops), *(x.view.thumbnail for x in lines)])
    names = {sha: f"{PICTURES}/{path.name}" for sha, path in kept.items()} if pictures else {}
    fruit = fruit_records(lines, store.measurements(round_key), profile, forecast, artifacts, names)
    summary = _summary(view, stops, lines, reports, forecast)
    summary["profile"] = profile_name or (profile.title if profile else view.record.profile)
    provenance = [*artifacts.counted]
    if profile is not None:
        provenance.append(_profile_line(profile, summary["profile"], len(stops)))
    records: dict[str, list[dict[str, Any]]] = {
        "summary": [summary],
        "rows": [_row(row) for row in reports],
        "fruit": fruit,
        "stops": [_stop(k, stop, artifacts, names) for k, stop in enumerate(stops, 1)],
        "forecast": forecast_records(forecast, view.record.started_s),
        "picks": pick_records(forecast, lines),
        "work": work_records(forecast, view.record.started_s, rates),
        "provenance": provenance,
    }
    return RoundTables(
        view.record.name or view.key,
        _about(view, provenance),
        {name: Table.of(name, COLUMNS[name], rows) for name, rows in records.items()},
        _charts(lines, forecast),
        {names[sha]: path for sha, path in kept.items() if sha in names},
        note,
    )


def _round(store: Store, round_key: str) -> RoundView:
    for view in store.rounds():
        if view.key == round_key:
            return view
    raise CucumberVisionError(
        f"no round has the key {round_key}", source=store.name, remedy="see `round list`"
    )


def _forecast(
    store: Store, content: RoundContent, profile: CropProfile | None, days: int
) -> tuple[Forecast | None, str]:
    if profile is None:
        return None, "no crop profile was named"
    try:
        return forecast_for(store, content.key, profile, days, content), ""
    except ForecastError as error:
        return None, str(error)


def _pictures(store: Store, thumbnails: list[ImageRef | None]) -> dict[str, Path]:
    wanted = {ref.sha256: ref for ref in thumbnails if ref is not None}
    if not wanted:
        return {}
    paths = {sha: store.images.path(ref) for sha, ref in sorted(wanted.items())}
    return {sha: path for sha, path in paths.items() if path.is_file()}


def _summary(
    view: RoundView,
    stops: Sequence[StopView],
    lines: Sequence[RoundFruit],
    reports: Sequence[RowReport],
    forecast: Forecast | None,
) -> dict[str, Any]:
    record = view.record
    lengths = _hanging_cm(lines)
    return {
        "round": record.name,
        "round_key": view.key,
        "house": record.house,
        "started_utc": utc(record.started_s),
        "rows": len({stop.row for stop in stops if stop.row is not None}),
        "stops": len(stops),
        "captures": sum(stop.captures for stop in stops),
        "detections": view.fruit,
        "fruit": len(lines),
        "measured": sum(line.view.record.length_m is not None for line in lines),
        "picked": sum(line.view.picked_s is not None for line in lines),
        "expected_fruit": round(sum(row.expected for row in reports), 2),
        "expected_fruit_sd": round(sum(row.expected_sd**2 for row in reports) ** 0.5, 2),
        "failures": sum(stop.failures for stop in stops),
        "mean_length_cm": round(fmean(lengths), 3) if lengths else None,
        "sd_length_cm": round(stdev(lengths), 3) if len(lengths) > 1 else None,
        "shortest_cm": min(lengths, default=None),
        "longest_cm": max(lengths, default=None),
        "ready_today": None if forecast is None else round(float(forecast.ready.sum()), 2),
        "simulated": any(line.view.simulated for line in lines),
    }


def _hanging_cm(lines: Sequence[RoundFruit]) -> list[float]:
    return [
        round(100 * line.view.record.length_m, 3)
        for line in lines
        if line.view.record.length_m is not None and line.view.picked_s is None
    ]


def _row(row: RowReport) -> dict[str, Any]:
    return {
        "row": row.row,
        "stops": row.stops,
        "detections": row.views,
        "fruit": row.fruit,
        "expected_fruit": round(row.expected, 2),
        "expected_fruit_sd": round(row.expected_sd, 2),
        "unplaced": row.unplaced,
    }


def _stop(
    number: int, stop: StopView, artifacts: StopArtifacts, names: dict[str, str]
) -> dict[str, Any]:
    return {
        "number": number,
        "key": stop.key,
        "row": stop.row,
        "side": stop.side,
        "step": stop.step,
        "position_m": stop.position_m,
        "position_sd_m": stop.position_sd_m,
        "fitted_m": stop.fitted_m,
        "fitted_sd_m": stop.fitted_sd_m,
        "taken_utc": utc(stop.taken_s),
        "captures": stop.captures,
        "detections": stop.fruit,
        "failures": stop.failures,
        "note": stop.note,
        "picture": stop.thumbnail and names.get(stop.thumbnail.sha256),
        **hashes_of(artifacts, stop.key),
    }


def _profile_line(profile: CropProfile, name: object, stops: int) -> dict[str, Any]:
    text = profile.model_dump_json()
    sha256 = hashlib.sha256(text.encode()).hexdigest()
    return {"kind": "profile", "name": str(name), "sha256": sha256, "stops": stops}


def _about(view: RoundView, provenance: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "software": f"cucumbervision {__version__}",
        "licence": LICENCE,
        "source": source_offer(),
        "written_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "round": view.record.name,
        "round_key": view.key,
        "hashes": [
            {key: line[key] for key in ("kind", "name", "sha256")}
            for line in provenance
            if line["sha256"]
        ],
    }


def _charts(lines: Sequence[RoundFruit], forecast: Forecast | None) -> Charts:
    charts = Charts(length_bins(_hanging_cm(lines)))
    if forecast is None:
        return charts
    return replace(charts, classes=forecast.classes, days=class_days(forecast))
