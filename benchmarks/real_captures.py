"""Measure the real RealSense frames that developers keep outside the repository.

    python benchmarks/real_captures.py DATA_FOLDER

Each method's mean and spread over ten frames of one rigid carrot, which has one length; M3 and the
others against the known lengths of the YCB objects; each once with the data set's masks and once
with MobileSAM's, prompted by the masks' boxes.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from cucumbervision.methods.table import AVAILABLE
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import measure_inputs

CARROT, YCB = "rgbd/carrot_realsense_1280", "rgbd/ycb_realsense_640"
MASKS = {"data set": None, "MobileSAM, box + point": "box+point", "MobileSAM, box": "box"}


def rows_of(folder: Path, prompt: str | None) -> list[dict[str, Any]]:
    """Measure a folder with the data set's masks, or with SAM's for a prompt."""
    options = MeasureOptions(instances="dataset", full_precision=True)
    if prompt is not None:
        options = MeasureOptions(
            instances="dataset", segmenter="mobile-sam", prompt=prompt, full_precision=True
        )
    with tempfile.TemporaryDirectory() as out:
        return measure_inputs([folder], Path(out), options).rows


def carrot_table(folder: Path) -> Table:
    """Return each method's mean and spread over the frames, and the intervals' mean width."""
    table = Table(title="Carrot, one rigid object in ten frames: mean cm (sd/mean %) [frames]")
    table.add_column("masks")
    for method in AVAILABLE:
        table.add_column(str(method), justify="right")
    table.add_column("interval", justify="right")
    for name, prompt in MASKS.items():
        rows = rows_of(folder, prompt)
        cells = []
        for method in AVAILABLE:
            read = [r[f"{method.lower()}_cm"] for r in rows]
            lengths = np.array([x for x in read if x is not None])
            if len(lengths) < 2:
                cells.append("–")
                continue
            spread = 100 * lengths.std(ddof=1) / lengths.mean()
            cells.append(f"{lengths.mean():.2f} ({spread:.2f}) [{len(lengths)}]")
        widths = [
            100 * (r["interval_high_cm"] - r["interval_low_cm"]) / r["length_cm"]
            for r in rows
            if r["interval_low_cm"] is not None
        ]
        cells.append(f"{np.mean(widths):.1f} % wide [{len(widths)}]" if widths else "–")
        table.add_row(name, *cells)
    return table


def ycb_table(folder: Path) -> Table:
    """Return the signed error of each method against the objects' known lengths."""
    truth = json.loads((folder / "lengths.json").read_text())
    table = Table(title="YCB objects: error against the mesh's length, % (– unknown)")
    for head in ("masks", "object", "length cm", *(str(m) for m in AVAILABLE)):
        table.add_column(head, justify="right")
    for name, prompt in MASKS.items():
        for row in rows_of(folder, prompt):
            true_length_m = truth[str(row["frame"])]["length_m"]
            cells = [
                name,
                truth[str(row["frame"])]["object"],
                f"{100 * true_length_m:.2f}" if true_length_m else "–",
            ]
            for method in AVAILABLE:
                read = row[f"{method.lower()}_cm"]
                if read is None:
                    cells.append("not measured")
                else:
                    cells.append(
                        f"{100 * (read / 100 / true_length_m - 1):+.1f}"
                        if true_length_m
                        else f"{read:.1f} cm"
                    )
            table.add_row(*cells)
    return table


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder that holds rgbd/")
    data = parser.parse_args().data
    console = Console(width=150, highlight=False)
    console.print(carrot_table(data / CARROT))
    console.print(ycb_table(data / YCB))


if __name__ == "__main__":
    main()
