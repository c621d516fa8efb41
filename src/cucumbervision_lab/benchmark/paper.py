"""The paper's published figures, beside the same protocol here.

They were measured on its own captures, not on ours:

Kaur, Singh, Mozaffari, Alirezaee: "Curvature-aware 3D length estimation of greenhouse cucumbers
using RGB-D imaging and cubic spline arc-length integration". Its captures are not published, so
that these figures can be put beside one's own but not checked.

Two things are left out on purpose. Its confidence intervals of M1 and M5: the first does not
contain the mean it belongs to (9.68 beside [9.72, 13.88]), the second is printed in two ways
(to 3.89 and to 6.00). And M5's column of its validation table, which prints an error of exactly
0.00 for all five fruit.
"""

from __future__ import annotations

import pandas as pd

from cucumbervision.accuracy.statistics import estimate, score
from cucumbervision.accuracy.table import Cell, Table
from cucumbervision.measurement.result import LengthDefinition
from cucumbervision_lab.benchmark.cases import Suite
from cucumbervision_lab.benchmark.length_tables import (
    PAPER_METHODS,
    against,
    span_text,
)
from cucumbervision_lab.benchmark.records import Masks

_PUBLISHED: dict[str, tuple[Cell, ...]] = {
    "M1": (1.63, 2.26, 9.68, None, 1.31, 0.89),
    "M2": (0.83, 1.12, 5.31, "3.97 to 6.60", 0.59, 0.95),
    "M3": (0.96, 1.02, 5.82, "4.87 to 7.49", 0.72, 0.97),
    "M4": (0.85, 1.01, 5.51, "4.12 to 7.01", 0.55, 0.97),
    "M5": (0.58, 0.61, 4.13, None, 0.40, 0.98),
}
"""The paper's table of accuracy (48 captures of 7 cucumbers, against the outer side): MAE and RMSE
in cm, MAPE and its bootstrap 95 % interval by capture, median absolute error in cm (from the
caption of its plot of errors), R². No interval where what is printed contradicts itself."""


NOTES = {
    "summary": (
        "Every capture is simulated: bodies whose lengths are known exactly, seen by a model of a "
        "D435 whose noise, holes and edges were matched to real frames. Real fruit have ridges, "
        "stalks and withered blossoms that these lack. A fruit that a method does not measure "
        "counts as 100 % error, so a method gains nothing by refusing.\n\n"
        "'Exact' masks are the fruit's own pixels; 'disturbed' ones have their outline moved by a "
        "smooth field of 1.5 px RMS. For 'perceived' ones nothing is given: the detector finds the "
        "fruit, the pose network places its keypoints and MobileSAM draws it; a fruit that is not "
        "found counts as not measured. The depth scale is exact in all tables, as after `calibrate "
        "--grid`; a camera that nobody calibrated adds its own."
    ),
    "paper": (
        "The paper's figures were read on its own captures of seven real cucumbers against the "
        "outer side of the bend; ours on simulated captures of seven fruit whose outer sides are "
        "as long. They stand side by side; they do not measure the same captures.\n\n"
        "Reproduced: M2, M3 and the medians of M4 and M5. M5's mean is not: it contains outliers "
        "on short fruit beyond 0.7 m. There the outermost two or three of its 25 bins hold mostly "
        "mixed readings of fruit and background, up to 3 cm behind the fruit and still within the "
        "gate of 3.5 cm, so the spline bends away from the camera at both ends. M4 fails there "
        "for the same reason: the 5x5 window at an endpoint holds mixed readings. M1 is not "
        "reproduced: its outer lines leave a fruit that does not fill its box. The paper's "
        "validation table gives M5 an error of exactly zero on five fruit, and its interval for "
        "M1 does not contain its own mean; neither is reproduced."
    ),
}
"""Notes on what the benchmark's numbers mean; the numbers themselves stand in its tables."""


def paper_table(readings: pd.DataFrame) -> Table | None:
    """Return the paper's figures beside those of the same protocol here, against the thread.

    Returns
    -------
    Table or None
        None without readings of the paper's protocol.
    """
    protocol = readings[readings["suite"] == Suite.PAPER]
    if protocol.empty:
        return None
    scored = against(protocol, LengthDefinition.THREAD)
    heads = ["method", "whose", "MAE (cm)", "RMSE (cm)", "MAPE (%)", "95 % by capture (%)"]
    heads += ["median error (cm)", "R²", "measured (%)", "median error (%)"]
    rows: list[tuple[Cell, ...]] = []
    for method in (*PAPER_METHODS, "M6 thread"):
        if method in _PUBLISHED:
            rows.append((method, "the paper", *_PUBLISHED[method], None, None))
        for masks in Masks:
            rows += _here(scored[(scored["masks"] == masks) & (scored["method"] == method)], masks)
    comment = (
        "'The paper': what it prints for 48 captures of seven cucumbers of its own. 'Here': the "
        "same protocol, simulated, against the thread as in the paper. The paper's captures are "
        "not published, so that the two stand side by side and cannot be compared fruit by "
        "fruit. Its intervals for M1 and M5 are left out: one does not contain its own mean, the "
        "other is printed in two ways."
    )
    title = "The paper's figures, on its own captures, beside ours"
    return Table.of(title, heads, rows, comment)


def _here(read: pd.DataFrame, masks: Masks) -> list[tuple[Cell, ...]]:
    if read.empty:
        return []
    found = score(read["length_m"], read["true_m"])
    errors = (
        found.mae_cm,
        found.rmse_cm,
        found.mape_percent,
        span_text(estimate(read["error_percent"], resamples=10_000)),
        float(read["error_cm"].median()),
        found.r2,
        100 * found.measured,
        found.median_percent,
    )
    return [(str(read["method"].iloc[0]), f"here, {masks} outlines", *errors)]
