"""Coverage and width of the shipped intervals on fruit that they were not learnt from.

    python benchmarks/interval_coverage.py SET [--split test] [--fruit 200]

SET is a folder by `cucumbervision synth` with depth, of another seed than the set of learning:
its fruit are measured on their true masks ('given') and as the shipped networks find and draw
them ('perceived'). Fruit of the stress set, numbers below those of learning, have exact and
disturbed outlines. Level 90 %, depth scale known; an interval wider than a factor of four is not
given.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd
from rich.console import Console
from rich.table import Table

from cucumbervision.methods.intervals import WIDEST, shipped_interval_models
from cucumbervision_lab.cli import part_bars
from cucumbervision_lab.evaluate.benchmark import TRUTH_OF, run_cases, with_intervals
from cucumbervision_lab.evaluate.cases import stress_cases
from cucumbervision_lab.evaluate.measure_case import CaseOptions, Masks, readings_frame
from cucumbervision_lab.evaluate.scenes import set_records

if TYPE_CHECKING:
    from collections.abc import Iterator

IN_SIGHT = 0.10  # of the outline's pixels: fruit hidden by more count as hidden
WAYS = {
    Masks.EXACT: "given mask",
    Masks.PERCEIVED: "networks' mask",
    Masks.DISTURBED: "disturbed by 1.5 px",
}


def read(folder: Path, split: str, fruit: int, keep: Path) -> pd.DataFrame:
    """Measure the fruit, or take those that were."""
    with part_bars() as report:
        records = set_records(folder, split, keep / "pictures.jsonl", 1, report)
        options = CaseOptions((Masks.EXACT, Masks.DISTURBED))
        if fruit:
            records += run_cases(stress_cases(fruit), options, keep / "stress.jsonl", 1)
    readings = with_intervals(readings_frame(records), shipped_interval_models())
    truth_kind = readings["method"].map(TRUTH_OF)
    readings = readings[truth_kind.notna() & readings["length_m"].notna()].copy()
    readings["true_m"] = [row[TRUTH_OF[row["method"]]] for _, row in readings.iterrows()]
    readings["cut"] = readings["cut_off"].astype("boolean").fillna(value=False).astype(bool)
    return readings


def parts(readings: pd.DataFrame) -> Iterator[tuple[str, str, pd.DataFrame]]:
    """Yield the readings by where they are from, whose masks they have, and what hides them."""
    drawn = readings["suite"] == "detection"
    for name, suite_readings in (("pictures", readings[drawn]), ("stress set", readings[~drawn])):
        for masks, mask_readings in suite_readings.groupby("masks", sort=False):
            hidden = mask_readings["hidden_share"] > IN_SIGHT
            kinds = {
                "all": mask_readings,
                "in sight": mask_readings[~hidden & ~mask_readings["cut"]],
                "partly hidden": mask_readings[hidden & ~mask_readings["cut"]],
                "cut by the edge": mask_readings[mask_readings["cut"]],
            }
            for kind, chosen in kinds.items():
                if len(chosen):
                    yield f"{name}, {WAYS[Masks(masks)]}", kind, chosen


def cells(readings: pd.DataFrame) -> list[str]:
    """Return count, how many have no interval, and of the others coverage and median width."""
    stated = readings[readings["high_m"] <= WIDEST * readings["low_m"]]
    covered = 100 * stated["true_m"].between(stated["low_m"], stated["high_m"]).mean()
    width = 100 * ((stated["high_m"] - stated["low_m"]) / stated["length_m"]).median()
    return [str(len(readings)), str(len(readings) - len(stated)), f"{covered:.1f}", f"{width:.1f}"]


def main() -> None:
    """Print coverage and width by kind."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--split", default="test")
    parser.add_argument("--fruit", type=int, default=200, help="of the stress set")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        readings = read(options.folder, options.split, options.fruit, Path(folder))
    heads = ("readings", "not given", "covered %", "median width %")
    console = Console(width=120, highlight=False)
    m6_lengths, paper_methods = ("M6", "M6 thread", "M6 chord"), ("M1", "M2", "M3", "M4", "M5")
    for keys, title in (
        (m6_lengths, "M6: centreline, thread, chord"),
        (paper_methods, "The other methods"),
    ):
        table = Table(title=f"{title}: 90 % intervals, depth scale known")
        for head in ("fruit", "", "length", *heads):
            table.add_column(head, justify="left" if head in ("fruit", "") else "right")
        for name, kind, part_readings in parts(readings):
            if keys is paper_methods and kind != "all":
                continue
            for key in keys:
                if len(method_readings := part_readings[part_readings["method"] == key]):
                    table.add_row(name, kind, key, *cells(method_readings))
        console.print(table)


if __name__ == "__main__":
    main()
