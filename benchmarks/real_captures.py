"""Real RealSense frames of one rigid carrot: each method's mean and spread.

    python benchmarks/real_captures.py DATA_FOLDER

Each method's mean and spread over ten frames, with the data set's masks and with MobileSAM's,
prompted by the masks' boxes.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from cucumbervision.methods.table import AVAILABLE
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import measure_inputs

MASKS = {
    "data set": MeasureOptions(instances="dataset", full_precision=True),
    "MobileSAM": MeasureOptions(
        instances="dataset", segmenter="mobile-sam", prompt="box+point", full_precision=True
    ),
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder that holds rgbd/")
    folder = parser.parse_args().data / "rgbd" / "carrot_realsense_1280"
    table = Table("masks", *map(str, AVAILABLE), title="mean, cm (sd/mean, %) [frames]")
    for name, options in MASKS.items():
        with tempfile.TemporaryDirectory() as out:
            rows = measure_inputs([folder], Path(out), options).rows
        cells = []
        for method in AVAILABLE:
            read = [row[f"{method.lower()}_cm"] for row in rows]
            lengths = np.array([length for length in read if length is not None])
            if len(lengths) < 2:
                cells.append("–")
                continue
            spread = 100 * lengths.std(ddof=1) / lengths.mean()
            cells.append(f"{lengths.mean():.2f} ({spread:.2f}) [{len(lengths)}]")
        table.add_row(name, *cells)
    Console(width=150, highlight=False).print(table)


if __name__ == "__main__":
    main()
