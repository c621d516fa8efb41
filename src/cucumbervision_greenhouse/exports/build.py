"""Build the tables of a round from the store: their columns and cells."""

from __future__ import annotations

import hashlib
import math
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from cucumbervision._version import __version__
from cucumbervision.about import LICENCE, source_offer
from cucumbervision.crop.grades import Grade
from cucumbervision.crop.profiles import CropProfile
from cucumbervision.errors import CucumberVisionError
from cucumbervision.methods.flags import flag_remarks
from cucumbervision.run.fields import FIELDS, Cell, Field, read_fields, utc
from cucumbervision_greenhouse.forecast.forecast import Counts, Forecast
from cucumbervision_greenhouse.forecast.picking import Rates, pick_list, plan_work, ready_on
from cucumbervision_greenhouse.rounds import forecasting, fruit_table
from cucumbervision_greenhouse.rounds.merge_and_link import DAY_S, row_counts
from cucumbervision_greenhouse.store.records import ArtifactRecord, FruitRow, Round, StopRecord
from cucumbervision_greenhouse.store.repository import Store

_BIN_CM = 2

Line = dict[str, Any]


def round_tables(
    store: Store,
    round_key: str,
    profile: CropProfile | None = None,
    *,
    profile_name: str = "",
    days: int = 7,
    rates: Rates | None = None,
) -> RoundTables:
    """Build all tables of a round.

    Parameters
    ----------
    store : Store
        The store.
    round_key : str
        Key of the round.
    profile : CropProfile, optional
        Crop profile for grades and forecast, which are empty without it.
    profile_name : str
        Name of the profile; by default its title.
    days : int
        Number of days of the forecast.
    rates : Rates, optional
        Picking rates for hours and crates.

    Raises
    ------
    StoreError, RoundError
        If the round does not exist or cannot be read.
    """
    view = store.round(round_key)
    if view is None:
        raise CucumberVisionError(
            f"no round has the key {round_key}", source=store.name, remedy="see `round list`"
        )
    content = fruit_table.read_round(store, round_key)
    table = fruit_table.fruit_table(content)
    now_s = time.time()
    forecast = None
    if profile is not None:
        forecast = forecasting.forecast_today(store, view, profile, now_s, content, days=days)
    measured_with = {stop.key: stop.artifacts for stop in content.stops}
    called = profile_name or (profile.title if profile else view.profile)
    provenance = _provenance(measured_with.values(), profile, called, len(content.stops))
    hashes = {key: _hashes(used) for key, used in measured_with.items()}
    shapes = {x.key: x.shape for x in store.detections(round_key, shapes=True)}
    today_s = forecasting.day_0_s(view, now_s)
    grades = {} if profile is None else forecasting.grades_today(table, profile, forecast)
    lines: dict[str, Iterable[Any]] = {
        "summary": [_summary(view, content, table, forecast, called)],
        "rows": row_counts(content),
        "fruit": (
            {**line, "hashes": hashes.get(line["stop_key"])}
            for line in _fruit_lines(table, grades, forecast)
        ),
        "stops": (
            {"number": n, "stop": stop, "hashes": hashes.get(stop.key)}
            | {"captures": len(stop.captures), "failures": len(stop.failures)}
            for n, stop in enumerate(content.stops, 1)
        ),
        "forecast": [] if forecast is None else _forecast_lines(forecast, today_s),
        "picks": [] if forecast is None else _pick_lines(forecast, table),
        "work": [] if forecast is None else _work_lines(forecast, today_s, rates),
        "provenance": provenance,
    }
    return RoundTables(
        title=view.name or view.key,
        walked=forecasting.date_after(view.walked_s, 0).isoformat(),
        provenance=_about(view, provenance),
        tables={
            name: [_cells(name, line) for line in of_table] for name, of_table in lines.items()
        },
        fruit=tuple(
            (fruit.with_(**shapes.get(fruit.key, {})), grades.get(fruit.key)) for fruit in table
        ),
        crop=profile.title if profile else called,
        bins=_length_bins([100 * x for x in fruit_table.hanging_lengths_m(table)]),
        note="no crop profile was named" if profile is None else "",
        stops=content.stops,
    )


def _hashes(used: Sequence[ArtifactRecord]) -> dict[str, str]:
    """Return hashes by kind, several separated by spaces."""
    return {
        kind: " ".join(
            artifact.sha256 for artifact in used if artifact.kind == kind and artifact.sha256
        )
        for kind in ("config", "model", "calibration")
    }


def _provenance(
    measured_with: Iterable[Sequence[ArtifactRecord]],
    profile: CropProfile | None,
    called: str,
    stops: int,
) -> list[Line]:
    counts = Counter(
        (artifact.kind, artifact.name, artifact.sha256)
        for used in measured_with
        for artifact in used
    )
    lines = [(*key, number) for key, number in sorted(counts.items())]
    if profile is not None:
        sha256 = hashlib.sha256(profile.model_dump_json().encode()).hexdigest()
        lines.append(("profile", called, sha256, stops))
    return [dict(zip(("kind", "name", "sha256", "stops"), cells, strict=True)) for cells in lines]


def _about(view: Round, provenance: list[Line]) -> dict[str, Any]:
    return {
        "software": f"cucumbervision {__version__}",
        "licence": LICENCE,
        "source": source_offer(),
        "written_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "round": view.name,
        "round_key": view.key,
        "hashes": [
            {key: line[key] for key in ("kind", "name", "sha256")}
            for line in provenance
            if line["sha256"]
        ],
    }


def _summary(
    view: Round,
    content: fruit_table.RoundContent,
    table: Sequence[FruitRow],
    forecast: Forecast | None,
    profile: str,
) -> Line:
    return {
        "view": view,
        "figures": fruit_table.round_figures(content, table),
        "profile": profile,
        "rows": len({stop.row for stop in content.stops if stop.row is not None}),
        "stops": len(content.stops),
        "captures": sum(len(stop.captures) for stop in content.stops),
        "failures": sum(len(stop.failures) for stop in content.stops),
        "ready": None if forecast is None else ready_on(forecast),
        "simulated": any(line.simulated for line in table),
    }


def _fruit_lines(
    table: Sequence[FruitRow], grades: Mapping[str, Grade], forecast: Forecast | None
) -> Iterator[Line]:
    """Return what the columns of each fruit lead through: its row, and its words."""
    columns = (forecast.fruit, forecast.ready().tolist()) if forecast else ((), ())
    ready = {state.fruit_id: chance for state, chance in zip(*columns, strict=True)}
    today_m = forecasting.lengths_today(forecast)
    for fruit in table:
        yield {
            **vars(fruit),
            "inner_arc_mm_per_10cm": fruit.inner_arc_mm_per_10cm,
            # A lower bound has no upper end.
            "interval_high_m": None if fruit.at_least else fruit.interval_high_m,
            **_grade_cells(grades.get(fruit.key)),
            "length_today_m": today_m.get(fruit.key),
            "ready": ready.get(fruit.key),
            "remarks": _remarks(fruit),
        }


def _grade_cells(graded: Grade | None) -> Line:
    if graded is None:
        return {}
    return {
        "grade": graded,
        "grade_probability": graded.probabilities.get(graded.name),
        "grade_rule": graded.rules[0] if graded.rules else "; ".join(graded.missing),
        "mass_kg": None if graded.mass_g is None else graded.mass_g / 1000,
    }


def _forecast_lines(forecast: Forecast, today_s: float) -> Iterator[Line]:
    """Return the forecast of the greenhouse, then of each row, by day and class."""
    scopes: list[tuple[str, str | None, Counts, Counts, tuple[int, ...]]] = [
        ("house", None, forecast.house, forecast.picks, ())
    ]
    for n, row in enumerate(forecast.rows):
        scopes.append(("row", row, forecast.by_row, forecast.row_picks, (n,)))
    for scope, row_name, standing, ready, where in scopes:
        for k, day in enumerate(forecast.days.tolist()):
            for c, name in enumerate(forecast.classes):
                index = (*where, k, c)
                yield {
                    "scope": scope,
                    "row": row_name,
                    "day": day,
                    **_dates(today_s, day),
                    "class": name,
                    "picked_class": name in forecast.pick,
                    "expected": standing.expected[index],
                    "low": standing.low[index],
                    "high": standing.high[index],
                    "newly_ready": ready.expected[index],
                    "newly_ready_low": ready.low[index],
                    "newly_ready_high": ready.high[index],
                    "complete": forecast.complete[k, c],
                }


def _pick_lines(forecast: Forecast, table: Sequence[FruitRow]) -> Iterator[Line]:
    lines, today_m = {line.key: line for line in table}, forecasting.lengths_today(forecast)
    hanging = (pick for pick in pick_list(forecast) if not pick.fruit.picked)
    for order, pick in enumerate(hanging, 1):
        line = lines[pick.fruit.fruit_id]
        yield {
            **{"order": order, "pick": pick, "view": line},
            "length_today_m": today_m.get(line.key),
        }


def _work_lines(forecast: Forecast, today_s: float, rates: Rates | None) -> Iterator[Line]:
    for work in plan_work(forecast, rates):
        ready = ready_on(forecast, work.day)
        crates = sum(crates.expected for crates in work.crates.values())
        yield {"work": work, "ready": ready, **_dates(today_s, work.day), "crates": crates}


def _dates(today_s: float, day: int) -> Line:
    date = forecasting.date_after(today_s, day).isoformat()
    return {"date": date, "date_utc": utc(today_s + day * DAY_S)[:10]}


def _remarks(fruit: FruitRow) -> str:
    """Return the remarks of a fruit as text."""
    bound = fruit.at_least and fruit.length_m is not None
    parts = (
        "picked" if fruit.picked_s else "",
        "computer-made" if fruit.simulated else "",
        flag_remarks(
            fruit.flags, f"at least {100 * (fruit.length_m or 0):.1f} cm" if bound else ""
        ),
    )
    return "; ".join(filter(None, parts))


def _cells(table: str, line: Any) -> dict[str, Cell]:
    """Return the cells of a table's line; an empty text becomes an empty cell."""
    cells = {column.name: column.of(line) for column in COLUMNS[table]}
    return {name: None if cell == "" else cell for name, cell in cells.items()}


def _length_bins(lengths_cm: Sequence[float]) -> tuple[tuple[int, int, int], ...]:
    """Count lengths in bins of 2 cm, from inclusive to exclusive, without gaps.

    Examples
    --------
    >>> _length_bins([21.0, 22.0, 27.9])
    ((20, 22, 1), (22, 24, 1), (24, 26, 0), (26, 28, 1))
    """
    # Round to 0.01 mm as in the tables, so that 0.22 m is not less than 22 cm.
    counts = Counter(math.floor(round(length, 3) / _BIN_CM) for length in lengths_cm)
    if not counts:
        return ()
    ends = range(min(counts), max(counts) + 1)
    return tuple((_BIN_CM * k, _BIN_CM * (k + 1), counts[k]) for k in ends)


@dataclass(frozen=True)
class RoundTables:
    """All tables of a round for export.

    Parameters
    ----------
    title : str
        Name of the round, or its key.
    walked : str
        The local date of its captures.
    provenance : mapping
        Software, source, time, key of the round, and hashes of configuration, models, calibration
        and profile, as JSON values.
    tables : mapping of str to list of dict
        Rows of 'summary' (one), 'rows', 'fruit', 'stops', 'forecast', 'picks', 'work' and
        'provenance', in this order, with the cells of `COLUMNS`.
    fruit : tuple of (FruitRow, Grade or None)
        The fruit of the table of that name.
    crop : str
        Title of the crop profile.
    bins : tuple of (from_cm, to_cm, fruit)
        Histogram of the lengths on the plant.
    note : str
        Reason for a missing forecast.
    stops : tuple of StopRecord
        The stops of the round.
    """

    title: str
    walked: str
    provenance: Mapping[str, Any]
    tables: Mapping[str, list[dict[str, Cell]]]
    fruit: tuple[tuple[FruitRow, Grade | None], ...] = ()
    crop: str = ""
    bins: tuple[tuple[int, int, int], ...] = ()
    note: str = ""
    stops: tuple[StopRecord, ...] = ()

    def __getitem__(self, name: str) -> list[dict[str, Cell]]:
        """Return the rows of a table."""
        return self.tables[name]

    @property
    def summary(self) -> dict[str, Cell]:
        """The row of the summary."""
        return self.tables["summary"][0]


_STORED = {
    column.name: replace(column, path=column.si_name)
    for column in FIELDS
    if column.owner == "fruit"
}


def _columns() -> dict[str, tuple[Field, ...]]:
    """Read `columns.csv`: a line without description is one of `fields.csv`, '*' all others."""
    described = read_fields(Path(__file__).with_name("columns.csv"))
    named = {line["name"] for line, _ in described if line["table"] == "fruit"}
    remaining = [column for name, column in _STORED.items() if name not in named]
    columns: dict[str, list[Field]] = {}
    for line, column in described:
        table = columns.setdefault(line["table"], [])
        of_line = remaining if column.name == "*" else [_STORED.get(column.name, column)]
        table += [column] if column.says else of_line
    return {name: tuple(table) for name, table in columns.items()}


COLUMNS = _columns()
"""Columns of each table, in order."""
