"""The typed tables between a round and every file that is written of it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

from cucumbervision.measurement.result import Method

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cucumbervision.agronomy.forecast import Forecast

__all__ = [
    "COLUMNS",
    "Cell",
    "Charts",
    "ExportColumn",
    "RoundTables",
    "Table",
    "class_days",
    "length_bins",
]

Cell: TypeAlias = str | int | float | bool | None

_NUMBER: dict[str, type] = {"text": str, "whole": int, "number": float, "yes/no": bool}


@dataclass(frozen=True)
class ExportColumn:
    """One column.

    Parameters
    ----------
    name : str
        As in CSV, Parquet and JSON; ends with the unit where there is one.
    unit : str
        The unit; empty where there is none.
    type : str
        'text', 'whole', 'number' or 'yes/no'; every cell may also be empty.
    says : str
        What it is.
    """

    name: str
    unit: str
    type: str
    says: str

    @property
    def title(self) -> str:
        """The head that people read, with the unit.

        Examples
        --------
        >>> ExportColumn("chord_cm", "cm", "number", "straight from end to end").title
        'chord [cm]'
        """
        plain = self.name.removesuffix(f"_{self.unit}") if self.unit else self.name
        words = plain.replace("_", " ")
        return f"{words} [{self.unit}]" if self.unit else words


@dataclass(frozen=True)
class Table:
    """One table.

    Parameters
    ----------
    name : str
        Of its file or sheet.
    columns : tuple of ExportColumn
        Its columns.
    rows : tuple of tuple
        A cell for each column.

    Raises
    ------
    ValueError
        If a row has another number of cells, or a cell another type.

    Examples
    --------
    >>> column = ExportColumn("stops", "", "whole", "number of stops")
    >>> Table("summary", (column,), (("3",),))
    Traceback (most recent call last):
    ...
    ValueError: summary.stops holds '3', which is not whole
    """

    name: str
    columns: tuple[ExportColumn, ...]
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
        """Give the rows as mappings by column."""
        names = [column.name for column in self.columns]
        return [dict(zip(names, row, strict=True)) for row in self.rows]

    @classmethod
    def of(
        cls, name: str, columns: tuple[ExportColumn, ...], records: list[dict[str, Any]]
    ) -> Table:
        """Make a table of mappings; numbers become what their columns are."""
        rows = tuple(tuple(_cell(record[c.name], c.type) for c in columns) for record in records)
        return cls(name, columns, rows)


def _cell(value: Any, kind: str) -> Cell:
    if value is None or value == "" or value != value:  # not a number
        return None
    made: Cell = _NUMBER[kind](value)
    return made


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
    charts : Charts
        What is drawn.
    pictures : mapping of str to Path
        Files to copy beside the tables, by the name that the column `picture` gives.
    note : str
        Why there is no forecast, if there is none.
    """

    title: str
    provenance: Mapping[str, Any]
    tables: Mapping[str, Table]
    charts: Charts
    pictures: Mapping[str, Any] = field(default_factory=dict)
    note: str = ""

    def __getitem__(self, name: str) -> Table:
        """Give a table by its name."""
        return self.tables[name]

    @property
    def summary(self) -> dict[str, Cell]:
        """The one row of the summary."""
        return self.tables["summary"].records()[0]


def _columns(*lines: str) -> tuple[ExportColumn, ...]:
    """Read lines of 'name | unit | type | what it says'."""
    return tuple(ExportColumn(*(part.strip() for part in line.split("|"))) for line in lines)


_WITH = _columns(
    "config_sha256||text|hash of the options that it was measured with",
    "models_sha256||text|hashes of the networks",
    "calibration_sha256||text|hash of the site's calibration; empty without one",
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
    "expected_fruit||number|fruit there are: invented ones taken off, unseen ones added",
    "expected_fruit_sd||number|standard deviation of that",
    "failures||whole|captures that could not be read or measured",
    "mean_length_cm|cm|number|mean of the fruit on the plant",
    "sd_length_cm|cm|number|spread of it",
    "shortest_cm|cm|number|shortest fruit on the plant",
    "longest_cm|cm|number|longest fruit on the plant",
    "ready_today||number|fruit expected to be ready today",
    "simulated||yes/no|whether drawn captures are among them",
)

_ROWS = _columns(
    "row||text|the row",
    "stops||whole|stops with a position",
    "detections||whole|fruit seen, each as often as it was seen",
    "fruit||whole|fruit that these are merged into",
    "expected_fruit||number|fruit there are: invented ones taken off, unseen ones added",
    "expected_fruit_sd||number|standard deviation of that",
    "unplaced||whole|detections without a position or depth",
)

_FRUIT = (
    *_columns(
        "number||whole|number in this list, by row and position",
        "key||text|key of the view that stands",
        "row||text|row of the house",
        "side||text|side of the row",
        "along_m|m|number|where along the row",
        "along_sd_m|m|number|standard deviation of that",
        "length_cm|cm|number|length of the best view",
        "length_kind||text|what it is the length of",
        "interval_low_cm|cm|number|lower end of the 90 % interval",
        "interval_high_cm|cm|number|upper end of the 90 % interval",
        "interval_of||text|which length the interval is about",
        "combined_cm|cm|number|length that all whole views give together",
        "combined_sd_cm|cm|number|standard deviation of that",
        "grade||text|likeliest class",
        "grade_verdict||text|in-class, out-of-grade, borderline, refused or missing",
        "grade_probability||number|probability of that class",
        "grade_rule||text|the rule that decided",
        "ready_today||number|probability to be in a class that is picked today",
        "weight_class||text|class by weight",
        "shape||text|class by crookedness",
        "mass_g|g|number|volume times the profile's density",
        "thread_cm|cm|number|thread over the outer side, end to end",
        "centreline_cm|cm|number|central axis, stem to blossom end",
        "chord_cm|cm|number|straight from end to end",
    ),
    *_columns(*(f"{m.value.lower()}_cm|cm|number|length by {m.value}" for m in Method)),
    *_columns(
        "inner_arc_mm|mm|number|largest distance from the chord to the inner edge",
        "diameter_max_mm|mm|number|largest diameter",
        "diameter_mean_mm|mm|number|mean diameter along the axis",
        "volume_ml|ml|number|volume of the fitted tube",
        "method||text|method that the selector took",
        "reason||text|why that method, or why none",
        "fallback||text|methods tried before",
        "flags||text|what else to know of the measurement",
        "views||whole|how often it was seen",
        "score||number|detector's confidence, 0 to 1",
        "distance_cm|cm|number|median depth of the fruit",
        "tilt_deg|deg|number|angle of the chord out of the picture plane",
        "hidden_share||number|share of the tube that something nearer hides",
        "fill||number|share of the mask with a depth reading",
        "verdict||text|accepted or rejected, where somebody said so",
        "corrected||yes/no|whether somebody corrected its mask",
        "picked_utc||text|when it was picked",
        "capture||text|capture of the best view",
        "stop_key||text|its stop",
        "taken_utc||text|when it was seen",
        "simulated||yes/no|whether the capture was drawn, not taken",
        "picture||text|small picture of the capture, beside the tables",
    ),
    *_WITH,
)

_STOPS = (
    *_columns(
        "number||whole|number of the stop, by time",
        "key||text|its key in the store",
        "row||text|row of the house",
        "side||text|side of the row",
        "step||whole|number that the operator gave",
        "position_m|m|number|position along the row as given",
        "position_sd_m|m|number|standard deviation of that",
        "fitted_m|m|number|position after merging",
        "fitted_sd_m|m|number|standard deviation of that",
        "taken_utc||text|when",
        "captures||whole|captures",
        "detections||whole|fruit seen",
        "failures||whole|captures that could not be read or measured",
        "note||text|what the operator wrote",
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
    "expected||number|fruit in the class if nothing is picked meanwhile",
    "low||number|lower end of its 80 % interval",
    "high||number|upper end of its 80 % interval",
    "newly_ready||number|fruit that become ready that day, in that class",
    "newly_ready_low||number|lower end of its 80 % interval",
    "newly_ready_high||number|upper end of its 80 % interval",
    "complete||yes/no|whether fruit too small to be seen today add nothing",
)

_PICKS = _columns(
    "order||whole|order of the walk",
    "number||whole|number of the fruit in the list of fruit",
    "row||text|row of the house",
    "side||text|side of the row",
    "along_m|m|number|where along the row",
    "length_cm|cm|number|length believed",
    "class||text|likeliest class today",
    "ready||number|probability to be in a class that is picked",
    "key||text|key of the fruit",
)

_WORK = _columns(
    "day||whole|days from the round",
    "date_utc||text|the date",
    "fruit||number|fruit to pick",
    "fruit_low||number|lower end of its interval",
    "fruit_high||number|upper end of its interval",
    "hours|h|number|hours of work for one person",
    "hours_low|h|number|lower end of its interval",
    "hours_high|h|number|upper end of its interval",
    "crates||number|crates of all classes",
    "complete||yes/no|whether fruit too small to be seen today add nothing",
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

_BIN_CM = 2


@dataclass(frozen=True)
class Charts:
    """What is drawn.

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


def length_bins(lengths_cm: Sequence[float]) -> tuple[tuple[int, int, int], ...]:
    """Count lengths in bins of 2 cm, from inclusive to exclusive, without gaps.

    Examples
    --------
    >>> length_bins([21.0, 22.0, 27.9])
    ((20, 22, 1), (22, 24, 1), (24, 26, 0), (26, 28, 1))
    """
    counts = Counter(math.floor(length / _BIN_CM) for length in lengths_cm)
    if not counts:
        return ()
    ends = range(min(counts), max(counts) + 1)
    return tuple((_BIN_CM * k, _BIN_CM * (k + 1), counts[k]) for k in ends)


def class_days(forecast: Forecast) -> tuple[tuple[int, tuple[float, ...]], ...]:
    """Give the house's expected fruit by day and class."""
    return tuple(
        (day, tuple(round(float(number), 2) for number in counts))
        for day, counts in zip(forecast.days.tolist(), forecast.house.expected, strict=True)
    )
