"""Put the simulated interval into a row, where nothing better is known."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cucumbervision.measurement.intervals import (
    BASIS,
    IntervalBook,
    raw_features,
    shipped_book,
    tube_features,
)
from cucumbervision.measurement.result import Length, Method

if TYPE_CHECKING:
    from cucumbervision.measurement.result import Fruit
    from cucumbervision.pipeline.rows import Cell

__all__ = ["with_simulated_interval"]

WIDEST = 4.0  # an interval from half to twice a length tells nobody anything
TOO_WIDE = "interval-too-wide"

_TUBE_KEYS = {Length.CENTRELINE: "M6", Length.THREAD: "M6 thread", Length.CHORD: "M6 chord"}


def with_simulated_interval(
    row: dict[str, Cell],
    fruit: Fruit,
    length: Length,
    *,
    scale_known: bool,
    book: IntervalBook | None = None,
) -> dict[str, Cell]:
    """Give a row its interval.

    Parameters
    ----------
    row : dict
        As `session.rows.fruit_row` fills it.
    fruit : Fruit
        The fruit of the row.
    length : Length
        The length that the run was asked for.
    scale_known : bool
        Whether the camera's depth scale was measured with a bar of known length.
    book : IntervalBook, optional
        The models; the package's own by default.

    Returns
    -------
    dict
        The row with `interval_low_cm`, `interval_high_cm`, `interval_of` and `interval_basis`;
        unchanged where nothing was measured, flagged 'interval-too-wide' where the interval would
        span more than a factor of four: the length is then a guess. A raw length's interval is
        about the centreline, which is what the fruit's length means where a method's own chord
        or arc does not.
    """
    chosen = fruit.selected
    if chosen is None or chosen.length_m is None:
        return row
    method = chosen.measured_by or chosen.method
    if method is Method.M6 and chosen.tube is not None and chosen.fit is not None:
        key, about = _TUBE_KEYS[length], length
        measured = getattr(chosen.tube, f"{length}_m")
        features = tube_features(chosen)
    else:
        distance, fill = row["distance_cm"], row["fill"]
        if not isinstance(distance, float | int) or not isinstance(fill, float | int):
            return row
        key, about, measured = str(method), Length.CENTRELINE, chosen.length_m
        features = raw_features(measured, distance / 100, float(fill))
    found = (book or shipped_book()).interval(key, measured, features, scale_known=scale_known)
    if found is None:
        return row
    low, high = found
    if high > WIDEST * low:
        return {**row, "flags": " ".join(f for f in (str(row["flags"] or ""), TOO_WIDE) if f)}
    return {
        **row,
        "interval_low_cm": round(100 * low, 3),
        "interval_high_cm": round(100 * high, 3),
        "interval_of": str(about),
        "interval_basis": BASIS,
    }
