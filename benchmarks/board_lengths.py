"""Real cucumbers on a board: lengths by M6's outline fit beside lengths by tape.

    python benchmarks/board_lengths.py DATA_FOLDER/photos2/board_cm

Plain photos, one to seven fruit on a black board beside two rulers of 50 cm. There is no depth: a
fruit is taken to lie on the board, round, its axis its own radius above it, and M6 fits a tube to
its outline so. The scale is that of the rulers, found as the two long bright bars where both show
whole; the camera stood still, and the median serves all pictures. Since a fruit's
axis is nearer than the board, the camera's height counts, which is taken from `--focal`, the focal
length as a share of the picture's longer side (0.72: a phone's main camera, 26 mm).

Only pictures are used in which every fruit has its polygon. The table's lengths run from left to
right, as the polygons do. Intervals: bootstrap over whole pictures.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.masks import distances_inside
from cucumbervision.methods.m6 import measure_m6

if TYPE_CHECKING:
    from numpy.typing import NDArray

RULER_M = 0.50
KINDS = ("chord", "centreline", "thread")
CURVED_MM_PER_10CM = 10.0  # UNECE FFV-15: more is no longer Class I
BOOTSTRAPS = 1000


def ruler_px_per_m(picture: NDArray[np.uint8]) -> float | None:
    """Return the board's scale: the mean of the upright and the lying ruler, or None."""
    colors = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2HSV))
    bright = ((colors[..., 2] > 140) & (colors[..., 1] < 90)).astype(np.uint8)
    closed = cv2.morphologyEx(bright, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    _, _, stats, _ = cv2.connectedComponentsWithStats(closed)
    height, width = picture.shape[:2]
    rulers_px = {}
    for _, _, w, h, area in np.asarray(stats)[1:].tolist():
        if area < 0.55 * w * h:
            continue
        if 0.35 * height < h < 0.75 * height and h > 7 * w:
            rulers_px["upright"] = h
        if 0.45 * width < w < 0.9 * width and w > 7 * h:
            rulers_px["lying"] = w
    return float(np.mean(list(rulers_px.values()))) / RULER_M if len(rulers_px) == 2 else None


def read_picture(folder: Path, name: str) -> NDArray[np.uint8]:
    """Read a picture of the folder, BGR."""
    picture = cv2.imread(str(folder / "images" / f"{name}.jpg"))
    if picture is None:
        raise SystemExit(f"{folder / 'images' / name}.jpg cannot be read")
    return np.asarray(picture, np.uint8)


def lying_body(mask: NDArray[np.bool_], height_m: float, px_per_m: float) -> NDArray[np.float32]:
    """Return the depth of a round body lying on the board, from its mask."""
    inside = distances_inside(mask)
    radius = float(np.quantile(inside[mask], 0.98))
    part = np.minimum(inside, radius)
    rise = np.sqrt(part * (2 * radius - part)) / px_per_m  # of the surface over the axis' plane
    depth = height_m - radius / px_per_m - rise
    return np.where(mask, depth, height_m).astype(np.float32)


def measured_fruit(
    folder: Path, name: str, scale: float, focal_share: float
) -> list[dict[str, float]]:
    """Return the lengths of a picture's fruit from left to right, cm."""
    height, width = read_picture(folder, name).shape[:2]
    focal = focal_share * max(height, width)
    camera = Intrinsics(width, height, focal, focal, width / 2, height / 2)
    lines = (folder / "labels_seg" / f"{name}.txt").read_text().splitlines()
    polygons = [np.array(line.split()[1:], float).reshape(-1, 2) for line in lines]
    rows = []
    for polygon in sorted(polygons, key=lambda p: float(p[:, 0].mean())):
        mask = np.zeros((height, width), np.uint8)
        corners = np.rint(polygon * (width, height)).astype(np.int32)
        cv2.fillPoly(mask, [corners], 1)
        depth = lying_body(mask > 0, focal / scale, scale)
        m6 = measure_m6(depth, mask > 0, camera)
        row = {"bend": np.nan, **dict.fromkeys(KINDS, np.nan)}
        if m6.fit is not None:
            traits = m6.fit.traits
            row = {kind: 100 * getattr(traits.lengths, f"{kind}_m") for kind in KINDS}
            row["bend"] = traits.inner_arc_mm_per_10cm
        rows.append(row)
    return rows


def all_fruit(folder: Path, focal_share: float) -> pd.DataFrame:
    """Return one row a fruit: picture, tape and measured lengths in cm."""
    truth = defaultdict(list)
    for row in pd.read_csv(folder / "lengths_cm.csv", dtype={"file_name": str}).itertuples():
        truth[row.file_name].append(float(row.length))
    names, rows = (folder / "complete.txt").read_text().split(), []
    pictures = (read_picture(folder, name) for name in names)
    scales = [scale for picture in pictures if (scale := ruler_px_per_m(picture)) is not None]
    spread = 100 * (max(scales) / min(scales) - 1)
    print(
        f"{len(scales)} pictures show both rulers whole: {np.median(scales):.0f} pixels a metre, "
        f"the largest {spread:.1f} % over the least"
    )
    for name in names:
        picture_rows = measured_fruit(folder, name, float(np.median(scales)), focal_share)
        for tape, row in zip(truth[name], picture_rows, strict=False):
            rows.append({"picture": name, "tape": tape, **row})
    return pd.DataFrame(rows).dropna()


def resampled(fruit: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Draw whole pictures again."""
    groups = [group for _, group in fruit.groupby("picture")]
    drawn = rng.integers(0, len(groups), len(groups))
    return pd.concat([groups[k].assign(picture=str(n)) for n, k in enumerate(drawn)])


def main() -> None:
    """Print the errors by kind of length."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--focal", type=float, default=0.72)
    args = parser.parse_args()
    fruit = all_fruit(args.folder, args.focal)
    curved = fruit["bend"] > CURVED_MM_PER_10CM
    title = f"{len(fruit)} fruit in {fruit['picture'].nunique()} pictures: M6's outline, tape"
    table = Table(title=title)
    heads = (
        "fruit",
        "count",
        "length",
        "off, median %",
        "error, median %",
        "mean %",
        "scale free %",
    )
    for head in heads:
        table.add_column(head, justify="right")
    for name, group in (("all", fruit), ("straight", fruit[~curved]), ("curved", fruit[curved])):
        for kind in KINDS:
            error_percent = 100 * np.log(group[kind] / group["tape"])
            # One scale a picture, fitted to its fruit: the rulers' own error is out of it.
            free = (
                error_percent
                - (100 * np.log(fruit[kind] / fruit["tape"]))
                .groupby(fruit["picture"])
                .transform("median")
                .loc[group.index]
            )
            size = error_percent.abs()
            figures = (error_percent.median(), size.median(), size.mean(), free.abs().mean())
            table.add_row(name, str(len(group)), kind, *(f"{x:.1f}" for x in figures))
    Console(width=100, highlight=False).print(table)
    rng = np.random.default_rng(0)
    samples = [resampled(fruit, rng) for _ in range(BOOTSTRAPS)]
    for kind in KINDS:
        medians = [100 * np.log(sample[kind] / sample["tape"]).median() for sample in samples]
        lower, upper = np.quantile(medians, [0.025, 0.975])
        print(f"{kind} against the tape by the rulers' scale: 95 % [{lower:+.1f}, {upper:+.1f}] %")


if __name__ == "__main__":
    main()
