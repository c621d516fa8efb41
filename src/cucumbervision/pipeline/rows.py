"""One row a fruit: the columns of every table, and how a fruit fills them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.frames import valid_depth
from cucumbervision.measurement.cloud import box_pixels
from cucumbervision.measurement.result import Length, Measurement, Method

if TYPE_CHECKING:
    from cucumbervision.capture.frames import Capture
    from cucumbervision.measurement.result import Fruit

__all__ = ["COLUMNS", "Column", "defused", "fruit_row"]

Cell = str | int | float | bool | None
_FORMULA_STARTS = frozenset("=+-@\t\r\n＝＋－＠")
DENSITY_KG_M3 = 960.0  # an assumption for cucumbers, until a crop profile says better


@dataclass(frozen=True)
class Column:
    """One column: its name in CSV and JSON, its unit and what it says."""

    name: str
    unit: str
    says: str


COLUMNS = (
    Column("capture", "", "capture's name"),
    Column("frame", "", "source's own number of the frame"),
    Column("fruit", "", "number of the fruit in the capture, from 1"),
    Column("score", "", "detector's confidence, 0 to 1"),
    Column("method", "", "method that the selector took"),
    Column("reason", "", "why that method, or why none"),
    Column("fallback", "", "methods tried before, and why each gave nothing"),
    Column("length_cm", "cm", "length"),
    Column("length_kind", "", "what it is the length of"),
    Column("interval_low_cm", "cm", "lower end of the length's interval"),
    Column("interval_high_cm", "cm", "upper end of the length's interval"),
    Column("centreline_cm", "cm", "central axis, stem to blossom end"),
    Column("thread_cm", "cm", "thread over the outer side, end to end"),
    Column("chord_cm", "cm", "straight from end to end"),
    *(Column(f"{m.value.lower()}_cm", "cm", f"length by {m.value}") for m in Method),
    Column("flags", "", "what else to know of the measurement"),
    Column("interval_of", "", "which length the interval is about"),
    Column("interval_basis", "", "what the interval rests on"),
    Column("inner_arc_mm", "mm", "largest distance from the chord to the inner edge"),
    Column("inner_arc_mm_per_10cm", "mm", "the same for each 10 cm of chord (UNECE FFV-15)"),
    Column("diameter_max_mm", "mm", "largest diameter"),
    Column("diameter_mean_mm", "mm", "mean diameter along the axis"),
    Column("volume_ml", "ml", "volume of the fitted tube"),
    Column("mass_g", "g", f"volume at {DENSITY_KG_M3:.0f} kg per cubic metre"),
    Column("tilt_deg", "deg", "angle of the chord out of the picture plane"),
    Column("hidden_share", "", "share of the fitted tube that something nearer hides"),
    Column("label", "", "detector's class"),
    Column("mask_source", "", "who drew the mask that was measured"),
    Column("mask_px", "px", "pixels of that mask"),
    Column("fill", "", "share of them with a valid depth reading"),
    Column("distance_cm", "cm", "median depth of the fruit"),
    Column("box_x1_px", "px", "left edge of the box"),
    Column("box_y1_px", "px", "upper edge of the box"),
    Column("box_x2_px", "px", "right edge of the box"),
    Column("box_y2_px", "px", "lower edge of the box"),
    Column("burst_frame", "", "frame of the burst whose colour was kept"),
    Column("burst_size", "", "frames fused"),
    Column("row", "", "row in the house"),
    Column("side", "", "side of the row"),
    Column("position_m", "m", "position along the row"),
    Column("step", "", "number of the stop"),
    Column("timestamp_s", "s", "time of the capture, seconds since 1970"),
    Column("simulated", "", "whether the capture was drawn, not taken"),
    Column("source", "", "where the capture was read from"),
    Column("raw_length_cm", "cm", "length before the site's calibration, as it was read"),
    Column("raw_length_kind", "", "what that is the length of"),
    Column("calibration", "", "site's calibration that was applied: name and hash"),
)


def defused(text: str) -> str:
    """Make a text harmless that a spreadsheet would run as a formula.

    A leading =, +, -, @, tab or carriage return gets an apostrophe before it (OWASP, CSV
    injection), as do their full-width forms, which some spreadsheets read alike.

    Examples
    --------
    >>> defused("=1+1"), defused("row 3")
    ("'=1+1", 'row 3')
    """
    return f"'{text}" if text[:1] in _FORMULA_STARTS else text


def fruit_row(
    capture: Capture, number: int, fruit: Fruit, length: Length = Length.THREAD
) -> dict[str, Cell]:
    """Fill one row.

    Parameters
    ----------
    capture : Capture
        The frame.
    number : int
        The fruit's number in the frame, from 1.
    fruit : Fruit
        The fruit, measured.
    length : Length
        Which of the three lengths `length_cm` holds where a tube was fitted; otherwise it holds
        the method's raw length, and `length_kind` says which that is.

    Returns
    -------
    dict
        A value for every name in `COLUMNS`; None where not computed.
    """
    chosen, stop = fruit.selected, capture.stop
    cells: dict[str, Any] = {column.name: None for column in COLUMNS}
    cells.update(
        capture=capture.name,
        frame=capture.frame,
        fruit=number,
        score=round(fruit.instance.confidence, 4),
        reason=fruit.reason,
        fallback=" > ".join(fruit.fallback),
        flags=" ".join(fruit.flags),
        label=fruit.instance.class_name,
        burst_frame=capture.burst_frame,
        burst_size=capture.burst_size,
        row=stop.row,
        side=stop.side,
        position_m=stop.position_m,
        step=stop.step,
        timestamp_s=capture.timestamp_s,
        simulated=capture.simulated,
        source=capture.source,
    )
    for name, edge in zip(("x1", "y1", "x2", "y2"), fruit.instance.box, strict=True):
        cells[f"box_{name}_px"] = round(float(edge), 2)
    for method, result in fruit.measurements.items():
        cells[f"{method.value.lower()}_cm"] = _cm(result.length_m)
    if chosen is not None:
        cells.update(method=str(chosen.measured_by or chosen.method), **_lengths(chosen, length))
    cells.update(_region(capture, fruit))
    return cells


def _lengths(chosen: Measurement, length: Length) -> dict[str, Cell]:
    if chosen.tube is None:
        return {"length_cm": _cm(chosen.length_m), "length_kind": str(chosen.kind)}
    all_three = {
        "centreline_cm": _cm(chosen.tube.centreline_m),
        "thread_cm": _cm(chosen.tube.thread_m),
        "chord_cm": _cm(chosen.tube.chord_m),
    }
    chosen_one = {"length_cm": all_three[f"{length}_cm"], "length_kind": str(length)}
    return {**chosen_one, **all_three, **_traits(chosen)}


def _traits(chosen: Measurement) -> dict[str, Cell]:
    if chosen.fit is None:
        return {}
    traits = chosen.fit.traits
    return {
        "inner_arc_mm": round(1e3 * traits.inner_arc_m, 2),
        "inner_arc_mm_per_10cm": round(traits.inner_arc_mm_per_10cm, 2),
        "diameter_max_mm": round(1e3 * traits.diameter_max_m, 2),
        "diameter_mean_mm": round(1e3 * traits.diameter_mean_m, 2),
        "volume_ml": round(1e6 * traits.volume_m3, 1),
        "mass_g": round(1e3 * traits.mass_kg(DENSITY_KG_M3), 1),
        "tilt_deg": round(traits.tilt_deg, 2),
        "hidden_share": round(chosen.fit.hidden_share, 3),
    }


def _region(capture: Capture, fruit: Fruit) -> dict[str, Cell]:
    if fruit.mask is None:
        left, top, right, bottom = box_pixels(fruit.instance.box, capture.depth_m.shape)
        readings = capture.depth_m[top:bottom, left:right]
        cells: dict[str, Cell] = {}
    else:
        readings = capture.depth_m[fruit.mask]
        cells = {"mask_source": fruit.mask_source, "mask_px": readings.size}
    valid = readings[valid_depth(readings)]
    if valid.size:
        cells["distance_cm"] = _cm(float(np.median(valid)))
    if readings.size:
        cells["fill"] = round(valid.size / readings.size, 4)
    return cells


def _cm(length_m: float | None) -> float | None:
    return None if length_m is None else round(100 * length_m, 3)
