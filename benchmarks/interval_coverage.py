"""Coverage and width of M6's intervals by group, on drawn fruit that they were not learnt from.

    python benchmarks/interval_coverage.py SET [--models FILE] [--measured FILE]

SET is a folder by `cucumbervision synth` with depth, of another seed than the set of learning. Its
fruit are measured on their true masks ('given') and as the shipped networks find, draw and look at
them. `--models` compares other interval models with the shipped ones, on the same measurements;
`--measured` keeps these, and resumes an interrupted run. Level 90 %, depth scale known; fruit cut
by the picture's edge are left out, and an interval wider than a factor of four is not given.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
from pydantic import TypeAdapter
from rich.console import Console
from rich.table import Table

from cucumbervision.methods.intervals import (
    WIDEST,
    has_no_interval,
    read_interval_models,
    shipped_interval_models,
)
from cucumbervision_lab.cli import part_bars
from cucumbervision_lab.data.checks import open_dataset
from cucumbervision_lab.processes import kept_rows
from cucumbervision_lab.train.end_crops import MeasuredFruit, measure_drawn

if TYPE_CHECKING:
    from collections.abc import Iterable

    from cucumbervision.methods.intervals import IntervalModels
    from cucumbervision_lab.data.labels import DataSet, LabelledPicture

GROUPS = {
    "hidden share": (0.0, 0.1, 0.3, 1.0),
    "length, m": (0.0, 0.16, 0.26, 1.0),
    "distance, m": (0.0, 0.5, 0.7, 5.0),
    "tilt, degrees": (0.0, 15.0, 30.0, 45.0, 90.0),
}


def measure(folder: Path, keep: Path) -> list[MeasuredFruit]:
    """Measure the pictures that the file does not hold yet, and return the fruit of all."""
    data = open_dataset(folder)
    jobs = {picture.file: picture for picture in data.pictures}
    with part_bars() as report:
        rows = kept_rows(
            keep,
            jobs,
            partial(_rows, data),
            progress=lambda count: report("pictures", count, len(jobs)),
        )
    return TypeAdapter(list[MeasuredFruit]).validate_python(rows)


def _rows(data: DataSet, picture: LabelledPicture) -> list[dict[str, Any]]:
    return [asdict(measured) for measured in measure_drawn(picture, data)]


def with_intervals(fruit: Iterable[MeasuredFruit], book: IntervalModels) -> pd.DataFrame:
    """Return the fruit's groups, whether an interval is given, whether it holds, and its width."""
    rows = []
    for measured in fruit:
        length_m, true_m, features = measured.lengths_m[0], measured.true_m[0], measured.features
        low_m, high_m = book.interval("M6", length_m, features) or (0.0, 0.0)
        low_m, high_m = min(low_m, length_m), max(high_m, length_m)
        values = measured.hidden_share, true_m, features["distance_m"], 60 * features["tilt"]
        is_given = high_m <= WIDEST * low_m and not has_no_interval(features)
        holds = low_m <= true_m <= high_m
        masks = "given" if measured.given else "networks'"
        if not measured.cut:
            rows.append((masks, *values, is_given, holds, (high_m - low_m) / length_m))
    return pd.DataFrame(rows, columns=["masks", *GROUPS, "given", "holds", "width"])


def cells(fruit: pd.DataFrame) -> list[str]:
    """Return how many have an interval, its coverage, and its median width."""
    given = fruit[fruit["given"]]
    percent = 100 * given["holds"].mean(), 100 * given["width"].median()
    return [str(len(given)), *(f"{value:.0f}" for value in percent)]


def coverage_table(books: dict[str, pd.DataFrame], masks: str) -> Table:
    """Return the table of one kind of masks."""
    table = Table("group", "fruit", title=f"{masks} masks: intervals given, hold %, median width %")
    for title in books:
        for head in (title, "hold", "width"):
            table.add_column(head, justify="right")
    chosen = [book[book["masks"] == masks].reset_index(drop=True) for book in books.values()]
    parts = {"all": chosen[0].index}
    for name, edges in GROUPS.items():
        bins = pd.cut(chosen[0][name], list(edges), include_lowest=True, right=False)
        for edge, part in chosen[0].groupby(bins, observed=True):
            parts[f"{name} {edge}"] = part.index
    for name, index in parts.items():
        of_books = [cell for book in chosen for cell in cells(book.loc[index])]
        table.add_row(name, str(len(index)), *of_books)
    return table


def main() -> None:
    """Print coverage and width by group."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--models", type=Path, help="other interval models, compared")
    parser.add_argument("--measured", type=Path, help="file of the measurements")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        fruit = measure(options.folder, options.measured or Path(folder) / "measured.jsonl")
    books = {"shipped": shipped_interval_models()}
    if options.models:
        books[options.models.name] = read_interval_models(options.models)
    frames = {title: with_intervals(fruit, book) for title, book in books.items()}
    for masks in ("networks'", "given"):
        Console(width=120, highlight=False).print(coverage_table(frames, masks))


if __name__ == "__main__":
    main()
