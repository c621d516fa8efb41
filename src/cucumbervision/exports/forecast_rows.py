"""Forecast, pick list and work of a round, as rows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from cucumbervision.agronomy.picking import pick_list
from cucumbervision.agronomy.work import plan_work
from cucumbervision.exports.fruit_rows import scaled
from cucumbervision.exports.provenance import utc
from cucumbervision.rounds.service import DAY_S

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cucumbervision.agronomy.forecast import Counts, Forecast
    from cucumbervision.agronomy.work import Rates
    from cucumbervision.rounds.service import FruitLine

__all__ = ["forecast_records", "pick_records", "work_records"]


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


def pick_records(forecast: Forecast | None, lines: Sequence[FruitLine]) -> list[dict[str, Any]]:
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
