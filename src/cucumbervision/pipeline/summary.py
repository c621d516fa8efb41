"""The numbers of a whole run: how many, how long, by which method."""

from __future__ import annotations

from collections import Counter
from statistics import fmean, median, stdev
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

    from cucumbervision.pipeline.results import RunResult

__all__ = ["summary_lines"]


def summary_lines(result: RunResult, provenance: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Give the summary as lines of what and value, for the workbook's first sheet.

    Parameters
    ----------
    result : RunResult
        The run.
    provenance : mapping
        Software, licence, source, configuration and models, as in `measurements.json`.
    """
    lengths = [row["length_cm"] for row in result.rows]
    known = [float(x) for x in lengths if isinstance(x, int | float)]
    lines: list[tuple[str, Any]] = [
        ("Captures", result.captures),
        ("Fruit", len(result.rows)),
        ("Fruit measured", len(known)),
        ("Inputs that could not be read", len(result.failures)),
    ]
    if any(row["simulated"] for row in result.rows):
        lines.append(("Note", "simulated captures are among them: drawn, not taken"))
    if known:
        lines += [
            ("Mean length [cm]", round(fmean(known), 2)),
            ("Median length [cm]", round(median(known), 2)),
            ("Shortest [cm]", round(min(known), 2)),
            ("Longest [cm]", round(max(known), 2)),
        ]
    if len(known) > 1:
        lines.append(("Standard deviation [cm]", round(stdev(known), 2)))
    for method, count in sorted(Counter(str(r["method"] or "none") for r in result.rows).items()):
        lines.append((f"Fruit by method {method}", count))
    lines += [
        ("Software", provenance["software"]),
        ("Licence", provenance["licence"]),
        ("Source", provenance["source"]),
        ("Started (UTC)", provenance["started"]),
        ("Configuration SHA-256", provenance["config_sha256"]),
    ]
    if provenance.get("calibration"):
        lines.append(("Calibration", provenance["calibration"]["tag"]))
    lines += [(f"Model {m['name']}", f"{m['runtime']} {m['sha256']}") for m in provenance["models"]]
    return lines
