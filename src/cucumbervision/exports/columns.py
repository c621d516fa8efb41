"""Every column of a round's tables: `docs/exports.md` lists the same."""

from __future__ import annotations

from cucumbervision.exports.tables import ExportColumn
from cucumbervision.measurement.result import Method

__all__ = ["COLUMNS"]


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
