"""The fruit of a round, one row each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from cucumbervision.exports.provenance import hashes_of, utc
from cucumbervision.measurement.result import Method
from cucumbervision.rounds.forecasting import grade_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from cucumbervision.agronomy.forecast import Forecast
    from cucumbervision.agronomy.profiles import CropProfile
    from cucumbervision.exports.provenance import StopArtifacts
    from cucumbervision.rounds.service import FruitLine
    from cucumbervision.store.records import FruitRecord, MethodRecord
    from cucumbervision.store.views import FruitView

__all__ = ["fruit_records", "scaled"]


def fruit_records(
    lines: Sequence[FruitLine],
    methods: Mapping[str, Sequence[MethodRecord]],
    profile: CropProfile | None,
    forecast: Forecast | None,
    artifacts: StopArtifacts,
    pictures: Mapping[str, str],
) -> list[dict[str, Any]]:
    """Fill the rows of the table 'fruit'.

    Parameters
    ----------
    lines : sequence of FruitLine
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


def _place(view: FruitView) -> dict[str, Any]:
    return {
        "key": view.key,
        "row": view.row,
        "side": view.side,
        "along_m": scaled(view.along_m, 1, 4),
        "along_sd_m": scaled(view.along_sd_m, 1, 4),
    }


def _lengths(record: FruitRecord) -> dict[str, Any]:
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


def _grade(record: FruitRecord, profile: CropProfile | None) -> dict[str, Any]:
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


def _traits(record: FruitRecord) -> dict[str, Any]:
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


def _marks(view: FruitView, pictures: Mapping[str, str]) -> dict[str, Any]:
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
