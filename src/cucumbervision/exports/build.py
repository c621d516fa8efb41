"""A round out of the store as typed tables."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from datetime import UTC, datetime
from statistics import fmean, stdev
from typing import TYPE_CHECKING, Any

from cucumbervision._version import __version__
from cucumbervision.about import LICENCE, source_offer
from cucumbervision.errors import CucumberVisionError, ForecastError
from cucumbervision.exports.charts import Charts, class_days, length_bins
from cucumbervision.exports.columns import COLUMNS
from cucumbervision.exports.forecast_rows import forecast_records, pick_records, work_records
from cucumbervision.exports.fruit_rows import fruit_records
from cucumbervision.exports.provenance import StopArtifacts, hashes_of, stop_artifacts, utc
from cucumbervision.exports.tables import RoundTables, Table
from cucumbervision.rounds.forecasting import forecast_for
from cucumbervision.rounds.from_store import read_round
from cucumbervision.rounds.service import fruit_table, row_reports

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from cucumbervision.agronomy.forecast import Forecast
    from cucumbervision.agronomy.profiles import CropProfile
    from cucumbervision.agronomy.work import Rates
    from cucumbervision.rounds.service import FruitLine, RowReport
    from cucumbervision.store.records import ImageRef
    from cucumbervision.store.repository import Store
    from cucumbervision.store.views import RoundView, StopView

__all__ = ["round_tables"]

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
    lines, stops = fruit_table(store, round_key, content), content.stops
    reports = row_reports(store, round_key, content)
    artifacts = stop_artifacts(store, round_key)
    forecast, note = _forecast(store, round_key, profile, days)
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
    store: Store, round_key: str, profile: CropProfile | None, days: int
) -> tuple[Forecast | None, str]:
    if profile is None:
        return None, "no crop profile was named"
    try:
        return forecast_for(store, round_key, profile, days), ""
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
    lines: Sequence[FruitLine],
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


def _hanging_cm(lines: Sequence[FruitLine]) -> list[float]:
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


def _charts(lines: Sequence[FruitLine], forecast: Forecast | None) -> Charts:
    charts = Charts(length_bins(_hanging_cm(lines)))
    if forecast is None:
        return charts
    return replace(charts, classes=forecast.classes, days=class_days(forecast))
