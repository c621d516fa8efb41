"""The tables of a round: their columns, and what fills them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, cast

from cucumbervision.measurement.result import Method
from cucumbervision.pipeline.fields import FIELDS, Field
from cucumbervision.store.records import DetectionRecord

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from cucumbervision.pipeline.fields import Cell, CellType


@dataclass(frozen=True)
class Table:
    """One table.

    Parameters
    ----------
    name : str
        Of its file or sheet.
    columns : tuple of Field
        Its columns.
    rows : list of dict
        A cell for each column, by the column's name.
    """

    name: str
    columns: tuple[Field, ...]
    rows: list[dict[str, Cell]]

    @classmethod
    def of(cls, name: str, lines: Iterable[Any]) -> Table:
        """Fill one of the tables of `COLUMNS`; an empty text is an empty cell."""
        columns = COLUMNS[name]
        rows = [{one.name: _cell(one, line) for one in columns} for line in lines]
        return cls(name, columns, rows)


def _cell(column: Field, line: Any) -> Cell:
    cell = column.of(line)
    return None if cell == "" else cell


@dataclass(frozen=True)
class RoundTables:
    """A round, ready to be written.

    Parameters
    ----------
    title : str
        The round's name, or its key.
    provenance : mapping
        Software, source, when it was written, the round's key, and the hashes of configuration,
        models, calibration and profile, as JSON values.
    tables : mapping of str to Table
        'summary' (one row), 'rows', 'fruit', 'stops', 'forecast', 'picks', 'work' and
        'provenance', in this order.
    bins : tuple of (from_cm, to_cm, fruit)
        Histogram of the lengths on the plant.
    pictures : mapping of str to callable
        What makes the JPEG files beside the tables, by the name that the column `picture` gives.
    note : str
        Why there is no forecast, if there is none.
    """

    title: str
    provenance: Mapping[str, Any]
    tables: Mapping[str, Table]
    bins: tuple[tuple[int, int, int], ...] = ()
    pictures: Mapping[str, Callable[[], bytes]] = field(default_factory=dict)
    note: str = ""

    def __getitem__(self, name: str) -> Table:
        """Return a table by its name."""
        return self.tables[name]

    @property
    def summary(self) -> dict[str, Cell]:
        """The one row of the summary."""
        return self.tables["summary"].rows[0]


def _columns(*lines: str) -> tuple[Field, ...]:
    """Read lines of 'name | unit | type, or type and digits | what it is | path, if another'."""
    found = []
    for line in lines:
        name, unit, kind, says, *path = (part.strip() for part in line.split("|"))
        kind, _, digits = kind.partition(" ")
        found.append(
            Field(
                name,
                unit,
                cast("CellType", kind),
                says,
                path[0] if path else name,
                int(digits) if digits else None,
            )
        )
    return tuple(found)


def _kept(one: Field) -> Field | None:
    """Return a field of `measurements.csv` as the store keeps it of a fruit; None if it does not.

    Its lengths are values of their own there.
    """
    inside = one.path.removeprefix("fruit.")
    if not inside.startswith(("length.", "raw_length.")):
        inside = one.si_name
    known = hasattr(DetectionRecord, inside.partition(".")[0])
    return replace(one, path=f"view.record.{inside}") if known else None


_KEPT = {one.name: kept for one in FIELDS if (kept := _kept(one)) is not None}
_METHODS = tuple(
    replace(one, path=f"methods.{method}")
    for method in Method
    for one in FIELDS
    if one.name == f"{method.lower()}_cm"
)

_WITH = _columns(
    "config_sha256||text|hash of the options that it was measured with|hashes.config",
    "models_sha256||text|hashes of the networks|hashes.model",
    "calibration_sha256||text|hash of the site's calibration; empty without one|hashes.calibration",
)

_SUMMARY = _columns(
    "round||text|what the round is called",
    "round_key||text|its key in the store",
    "house||text|the greenhouse",
    "started_utc||text|when it began",
    "profile||text|crop profile of grades and forecast",
    "rows||whole|rows walked",
    "stops||whole|stops",
    "captures||whole|captures",
    "detections||whole|fruit seen, each as often as it was seen",
    "fruit||whole|fruit, each once; rejected ones left out",
    "measured||whole|of them with a length",
    "picked||whole|of them picked",
    "expected_fruit||number 2|fruit there are: false positives removed, unseen ones added",
    "expected_fruit_sd||number 2|standard deviation of that",
    "failures||whole|captures that could not be read or measured",
    "mean_length_cm|cm|number|mean of the fruit on the plant",
    "sd_length_cm|cm|number|spread of it",
    "shortest_cm|cm|number|shortest fruit on the plant",
    "longest_cm|cm|number|longest fruit on the plant",
    "ready_today||whole|fruit on the pick list that are ready today",
    "simulated||yes/no|whether drawn captures are among them",
)

_ROWS = _columns(
    "row||text|the row",
    "stops||whole|stops with a position",
    "detections||whole|fruit seen, each as often as it was seen|views",
    "fruit||whole|fruit that these are merged into",
    "expected_fruit||number 2|fruit there are: false positives removed, unseen ones added|"
    "count.expected",
    "expected_fruit_sd||number 2|standard deviation of that|count.sd",
    "unplaced||whole|detections without a position or depth",
)

_INTERVAL = ("length_cm", "interval_low_cm", "interval_high_cm")
_FRUIT = (
    # What is printed comes first.
    *_columns(
        "number||whole|number in this list, by row and position",
        "row||text|row of the house|view.row",
        "along_m|m|number 4|where along the row|view.along_m",
    ),
    *(_KEPT[name] for name in _INTERVAL),
    *_columns(
        "grade||text|likeliest class|grade.name",
        "remarks||text|what else to know, in words",
        "taken_utc||text|when it was seen|view.taken_s",
        "key||text|key of the view that stands|view.key",
        "side||text|side of the row|view.side",
        "along_sd_m|m|number 4|standard deviation of `along_m`|view.along_sd_m",
        "grade_verdict||text|in-class, out-of-grade, borderline, refused or missing|grade.verdict",
        "grade_probability||number 4|probability of that class|grade_probability",
        "grade_rule||text|the rule that decided|grade_rule",
        "ready_today||number 4|probability to be in a picked class today|ready",
        "weight_class||text|class by weight|grade.weight_class",
        "shape||text|class by crookedness|grade.shape",
        "mass_g|g|number|volume times the profile's density|mass_kg",
    ),
    *(one for name, one in _KEPT.items() if name not in _INTERVAL),
    *_METHODS,
    *_columns(
        "views||whole|how often it was seen|view.views",
        "verdict||text|accepted or rejected, where somebody said so|view.verdict",
        "corrected||yes/no|whether somebody corrected its mask|view.corrected",
        "picked_utc||text|when it was picked|view.picked_s",
        "capture||text|capture of the best view|view.capture",
        "stop_key||text|its stop|view.stop_key",
        "simulated||yes/no|whether the capture is simulated|view.simulated",
        "picture||text|picture of the fruit, beside the tables",
    ),
    *_WITH,
)

_STOPS = (
    *_columns(
        "number||whole|number of the stop, by time",
        "key||text|its key in the store|stop.key",
        "row||text|row of the house|stop.row",
        "side||text|side of the row|stop.side",
        "step||whole|number that the operator gave|stop.step",
        "position_m|m|number|position along the row as given|stop.position_m",
        "position_sd_m|m|number|standard deviation of that|stop.position_sd_m",
        "fitted_m|m|number|position after merging|stop.fitted_m",
        "fitted_sd_m|m|number|standard deviation of that|stop.fitted_sd_m",
        "taken_utc||text|when|stop.taken_s",
        "captures||whole|captures|stop.captures",
        "detections||whole|fruit seen|stop.fruit",
        "failures||whole|captures that could not be read or measured|stop.failures",
        "note||text|what the operator wrote|stop.note",
        "picture||text|small picture of its first capture, beside the tables",
    ),
    *_WITH,
)

_FORECAST = _columns(
    "scope||text|house, or a row of it",
    "row||text|the row; empty for the house",
    "day||whole|days from the round",
    "date_utc||text|the date",
    "class||text|class, or out of grade on either side",
    "picked_class||yes/no|whether the class is picked",
    "expected||number 3|fruit in the class if nothing is picked meanwhile",
    "low||number|lower end of its 80 % interval",
    "high||number|upper end of its 80 % interval",
    "newly_ready||number 3|fruit that become ready that day, in that class",
    "newly_ready_low||number|lower end of its 80 % interval",
    "newly_ready_high||number|upper end of its 80 % interval",
    "complete||yes/no|whether fruit too small to be seen today add nothing",
)

_PICKS = _columns(
    "order||whole|order of the walk",
    "number||whole|number of the fruit in the list of fruit",
    "row||text|row of the house|pick.fruit.row",
    "side||text|side of the row|pick.fruit.side",
    "along_m|m|number 4|where along the row|pick.fruit.position_m",
    "length_cm|cm|number|length believed|pick.fruit.length_m",
    "class||text|likeliest class on the day of the round|pick.name",
    "ready||number 4|probability to be in a class that is picked|pick.ready",
    "key||text|key of the fruit|pick.fruit.fruit_id",
    "simulated||yes/no|whether the fruit was drawn, not grown",
)

_WORK = _columns(
    "day||whole|days from today|work.day",
    "date_utc||text|the date",
    "fruit||number 2|fruit to pick|work.fruit.expected",
    "fruit_low||number|lower end of its interval|work.fruit.low",
    "fruit_high||number|upper end of its interval|work.fruit.high",
    "hours|h|number 3|hours of work for one person|work.hours.expected",
    "hours_low|h|number 3|lower end of its interval|work.hours.low",
    "hours_high|h|number 3|upper end of its interval|work.hours.high",
    "crates||number|crates of all classes",
    "complete||yes/no|whether fruit too small to be seen today add nothing|work.complete",
)

_PROVENANCE = _columns(
    "kind||text|config, model, calibration, profile, software",
    "name||text|what it is called",
    "sha256||text|hash of its content",
    "stops||whole|stops that were measured with it",
)

COLUMNS: dict[str, tuple[Field, ...]] = {
    "summary": _SUMMARY,
    "rows": _ROWS,
    "fruit": _FRUIT,
    "stops": _STOPS,
    "forecast": _FORECAST,
    "picks": _PICKS,
    "work": _WORK,
    "provenance": _PROVENANCE,
}
