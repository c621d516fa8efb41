"""The typed tables between a round and every file that is written of it, and all their columns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, cast

from cucumbervision.measurement.result import Method
from cucumbervision.pipeline.fields import FIELDS, Cell, Column, Field
from cucumbervision.pipeline.fields import field as fruit_field
from cucumbervision.store.records import DetectionRecord

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from cucumbervision.pipeline.fields import CellType

_NUMBER: dict[str, type] = {"text": str, "whole": int, "number": float, "yes/no": bool}


class ExportColumn(Field):
    """A column of a round's tables: its path leads through a line of them; times are UTC.

    Examples
    --------
    >>> column = ExportColumn("chord_cm", "cm", "number", "straight", "record.chord_m")
    >>> column.of({"record": {"chord_m": 0.31234567}}), column.of({"record": None})
    (31.235, None)
    """

    def of(self, line: Any) -> Cell:
        """Return a line's cell."""
        value = self.value(line)
        if value is None or value == "" or value != value:  # not a number
            return None
        if self.type == "number":
            return float(self.cell(value, self.digits))
        if self.name.endswith("_utc") and not isinstance(value, str):
            return utc(value)
        return cast("Cell", _NUMBER[self.type](value))


def utc(seconds: float) -> str:
    """Return a time as people and programs read it.

    Examples
    --------
    >>> utc(86400.5)
    '1970-01-02T00:00:00Z'
    """
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


@dataclass(frozen=True)
class ExportTable:
    """One table.

    Parameters
    ----------
    name : str
        Of its file or sheet.
    columns : tuple of Column
        Its columns.
    rows : tuple of tuple
        A cell for each column.

    Raises
    ------
    ValueError
        If a row has another number of cells, or a cell another type.

    Examples
    --------
    >>> column = Column("stops", "", "whole", "number of stops")
    >>> ExportTable("summary", (column,), (("3",),))
    Traceback (most recent call last):
    ...
    ValueError: summary.stops holds '3', which is not whole
    """

    name: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"a row of {self.name} has {len(row)} cells")
            for column, cell in zip(self.columns, row, strict=True):
                if cell is not None and type(cell) is not _NUMBER[column.type]:
                    raise ValueError(
                        f"{self.name}.{column.name} holds {cell!r}, which is not {column.type}"
                    )

    def records(self) -> list[dict[str, Cell]]:
        """Return the rows as mappings by column."""
        names = [column.name for column in self.columns]
        return [dict(zip(names, row, strict=True)) for row in self.rows]

    @classmethod
    def of(cls, name: str, lines: Iterable[Any]) -> ExportTable:
        """Fill one of the tables of `COLUMNS`."""
        columns = COLUMNS[name]
        return cls(name, columns, tuple(tuple(c.of(line) for c in columns) for line in lines))


@dataclass(frozen=True)
class Charts:
    """What is drawn, the same in every file.

    Parameters
    ----------
    bins : tuple of (from_cm, to_cm, fruit)
        Histogram of the lengths on the plant.
    classes : tuple of str
        Classes of the forecast.
    days : tuple of (day, expected fruit in each class)
        The house's forecast.
    """

    bins: tuple[tuple[int, int, int], ...] = ()
    classes: tuple[str, ...] = ()
    days: tuple[tuple[int, tuple[float, ...]], ...] = ()


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
    tables : mapping of str to ExportTable
        'summary' (one row), 'rows', 'fruit', 'stops', 'forecast', 'picks', 'work' and
        'provenance', in this order.
    charts : Charts
        What is drawn.
    pictures : mapping of str to callable
        What makes the JPEG files beside the tables, by the name that the column `picture` gives.
    note : str
        Why there is no forecast, if there is none.
    """

    title: str
    provenance: Mapping[str, Any]
    tables: Mapping[str, ExportTable]
    charts: Charts
    pictures: Mapping[str, Callable[[], bytes]] = field(default_factory=dict)
    note: str = ""

    def __getitem__(self, name: str) -> ExportTable:
        """Return a table by its name."""
        return self.tables[name]

    @property
    def summary(self) -> dict[str, Cell]:
        """The one row of the summary."""
        return self.tables["summary"].records()[0]


def _columns(*lines: str) -> tuple[ExportColumn, ...]:
    """Read lines of 'name | unit | type, or type and digits | what it is | path, if another'."""
    found = []
    for line in lines:
        name, unit, kind, says, *path = (part.strip() for part in line.split("|"))
        kind, _, digits = kind.partition(" ")
        found.append(
            ExportColumn(
                name,
                unit,
                cast("CellType", kind),
                says,
                path[0] if path else name,
                int(digits) if digits else None,
            )
        )
    return tuple(found)


def _measured(*names: str) -> tuple[ExportColumn, ...]:
    """Return columns of `measurements.csv`, filled from the store's record of a fruit."""
    return tuple(
        ExportColumn(f.name, f.unit, f.type, f.says, f"view.record.{_path(f)}", f.digits)
        for f in map(fruit_field, names)
    )


def _path(one: Field) -> str:
    """Return where a field is in the store's record: its length is a value of its own there."""
    path = one.path.removeprefix("fruit.")
    return path if path.startswith("length.") else one.si_name


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

# Every trait of the fitted tube that the store keeps; its lengths and tilt stand elsewhere.
_TRAITS = tuple(
    one.name
    for one in FIELDS
    if one.path.startswith("fruit.traits.")
    and hasattr(DetectionRecord, one.si_name)
    and one.name not in ("centreline_cm", "thread_cm", "chord_cm", "tilt_deg")
)

_FRUIT = (
    *_columns(
        "number||whole|number in this list, by row and position",
        "key||text|key of the view that stands|view.key",
        "row||text|row of the house|view.row",
        "side||text|side of the row|view.side",
        "along_m|m|number 4|where along the row|view.along_m",
        "along_sd_m|m|number 4|standard deviation of that|view.along_sd_m",
    ),
    *_measured("length_cm", "length_kind", "interval_low_cm", "interval_high_cm", "interval_of"),
    *_columns(
        "grade||text|likeliest class|grade.name",
        "grade_verdict||text|in-class, out-of-grade, borderline, refused or missing|grade.verdict",
        "grade_probability||number 4|probability of that class|grade_probability",
        "grade_rule||text|the rule that decided|grade_rule",
        "ready_today||number 4|probability to be in a picked class today|ready",
        "weight_class||text|class by weight|grade.weight_class",
        "shape||text|class by crookedness|grade.shape",
        "mass_g|g|number|volume times the profile's density|mass_kg",
    ),
    *_measured("thread_cm", "centreline_cm", "chord_cm"),
    *_columns(
        *(
            f"{one.lower()}_cm|cm|number|{fruit_field(f'{one.lower()}_cm').says}|methods.{one}"
            for one in Method
        )
    ),
    *_measured(*_TRAITS),
    *_measured("method", "reason", "fallback", "flags"),
    *_columns("views||whole|how often it was seen|view.views"),
    *_measured("score", "distance_cm", "tilt_deg", "hidden_share", "fill"),
    *_columns(
        "verdict||text|accepted or rejected, where somebody said so|view.verdict",
        "corrected||yes/no|whether somebody corrected its mask|view.corrected",
        "picked_utc||text|when it was picked|view.picked_s",
        "capture||text|capture of the best view|view.capture",
        "stop_key||text|its stop|view.stop_key",
        "taken_utc||text|when it was seen|view.taken_s",
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

COLUMNS: dict[str, tuple[ExportColumn, ...]] = {
    "summary": _SUMMARY,
    "rows": _ROWS,
    "fruit": _FRUIT,
    "stops": _STOPS,
    "forecast": _FORECAST,
    "picks": _PICKS,
    "work": _WORK,
    "provenance": _PROVENANCE,
}
