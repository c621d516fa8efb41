"""The paper's published figures, as data: measured on its own captures, not on ours.

Kaur, Singh, Mozaffari, Alirezaee: "Curvature-aware 3D length estimation of greenhouse cucumbers
using RGB-D imaging and cubic spline arc-length integration". Its captures are not published, so
that these figures can be put beside one's own but not checked.

Two things are left out on purpose. Its confidence intervals of M1 and M5: the first does not
contain the mean it belongs to (9.68 beside [9.72, 13.88]), the second is printed in two ways
(to 3.89 and to 6.00). And M5's column of its validation table, which prints an error of exactly
0.00 for all five fruit.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["PAPER_BENCHMARK", "PAPER_VALIDATION", "PaperFigures", "PaperSpecimen"]


@dataclass(frozen=True)
class PaperFigures:
    """One row of the paper's table of accuracy (48 captures of 7 cucumbers, against a thread).

    Parameters
    ----------
    mae_cm, rmse_cm, mape_percent, r2 : float
        As printed.
    median_cm : float
        Median absolute error, from the caption of its plot of errors.
    interval_percent : (float, float) or None
        Bootstrap 95 % interval of the MAPE by capture; None where what is printed contradicts
        itself.
    """

    mae_cm: float
    rmse_cm: float
    mape_percent: float
    r2: float
    median_cm: float
    interval_percent: tuple[float, float] | None


@dataclass(frozen=True)
class PaperSpecimen:
    """One fruit of the paper's validation table.

    Parameters
    ----------
    name : str
        As printed.
    thread_cm : float
        Its length by thread.
    lengths_cm : dict of str to float
        What M1 to M4 read.
    """

    name: str
    thread_cm: float
    lengths_cm: dict[str, float]


PAPER_BENCHMARK: dict[str, PaperFigures] = {
    "M1": PaperFigures(1.63, 2.26, 9.68, 0.89, 1.31, None),
    "M2": PaperFigures(0.83, 1.12, 5.31, 0.95, 0.59, (3.97, 6.60)),
    "M3": PaperFigures(0.96, 1.02, 5.82, 0.97, 0.72, (4.87, 7.49)),
    "M4": PaperFigures(0.85, 1.01, 5.51, 0.97, 0.55, (4.12, 7.01)),
    "M5": PaperFigures(0.58, 0.61, 4.13, 0.98, 0.40, None),
}

PAPER_VALIDATION: tuple[PaperSpecimen, ...] = (
    PaperSpecimen("Cu-1 large", 25.70, {"M1": 23.59, "M2": 25.91, "M3": 24.20, "M4": 24.34}),
    PaperSpecimen("Cu-2 medium", 14.72, {"M1": 13.86, "M2": 13.70, "M3": 13.59, "M4": 12.59}),
    PaperSpecimen("Cu-3 medium", 15.52, {"M1": 14.39, "M2": 14.52, "M3": 13.34, "M4": 13.53}),
    PaperSpecimen("Cu-4 large", 23.92, {"M1": 21.71, "M2": 25.27, "M3": 23.24, "M4": 23.51}),
    PaperSpecimen("Cu-5 extra-large", 38.00, {"M1": 31.73, "M2": 39.17, "M3": 37.30, "M4": 37.33}),
)
