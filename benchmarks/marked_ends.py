"""How well covered ends of cucumbers on the plant are told from true ones, in photos.

    python benchmarks/marked_ends.py FOLDER [--look cucumber-look.onnx ...]

FOLDER holds the photos that `marked_ends.json` names. It holds where the masks that the networks
drew end, and what the eye says of each end. The photos have no depth: the look has the colours and
the mask alone. An end is judged where today's mask still ends there. Photos of a folder called
`on_plant_web` were trained on, and are counted apart.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.table import Table

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.pictures import read_color
from cucumbervision.fruit.crops import EndCrop, end_crop
from cucumbervision.fruit.masks import distances_inside
from cucumbervision.methods.selector import DOUBTFUL
from cucumbervision.networks.find import EndLooker
from cucumbervision.networks.keypoint_axis import axis_line
from cucumbervision.networks.registry import load_registry
from cucumbervision.run.measurer import Measurer
from cucumbervision.run.options import MeasureOptions
from cucumbervision.tube.shape import arc_positions, points_along
from cucumbervision_lab.train.end_look import area_under_curve

if TYPE_CHECKING:
    from numpy.typing import NDArray

MARKED = Path(__file__).with_name("marked_ends.json")
TRAINED_ON = "on_plant_web"

_CONFIDENCE = 0.08  # fruit half hidden are found less surely than a report asks for
_DISTANCE_M = 0.5  # any: nothing of a photo is measured in metres
_AXIS_POINTS = 33
_MOVED_RADII = 1.0  # an end of today's mask that lies farther off is another end


@dataclass(frozen=True, eq=False)
class MarkedEnd:
    """An end that was marked, and its crop by today's mask."""

    mark: str
    trained: bool
    crop: EndCrop


def photo_capture(file: Path) -> Capture:
    """Return a photo as a capture without depth, by a camera as long as the photo is wide."""
    color = read_color(file)
    height, width = color.shape[:2]
    focal = float(max(height, width))
    camera = Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    return Capture(color, np.zeros((height, width), np.float32), camera, file.name)


def marked_ends(photo: dict[str, Any], capture: Capture, measurer: Measurer) -> Iterator[MarkedEnd]:
    """Yield the marked ends of a photo at which a mask of today ends."""
    masks = [
        instance.mask
        for instance in measurer.detect(capture)[1].instances
        if instance.mask is not None
    ]
    drawn = [(mask, line) for mask in masks if (line := axis_line(mask)) is not None]
    tips = [(fruit["ends"][k], fruit["marks"][k]) for fruit in photo["fruit"] for k in (0, 1)]
    camera = capture.intrinsics
    for mask, line in drawn:
        radius_px = float(distances_inside(mask).max())
        x, y = camera.rays(line[:, 0], line[:, 1])
        shares = np.linspace(0, 1, _AXIS_POINTS)
        axis_m = points_along(_DISTANCE_M * np.stack([x, y, np.ones(len(x))], axis=1), shares)
        for end_px, axis in ((line[0], axis_m), (line[-1], axis_m[::-1])):
            mark = _mark_at(end_px, tips, _MOVED_RADII * radius_px)
            if mark is None or float(arc_positions(line)[-1]) < 2 * radius_px:
                continue
            diameter_m = 2 * radius_px * _DISTANCE_M / camera.fx_px
            crop = end_crop(capture.color, capture.depth_m, mask, camera, axis, diameter_m)
            yield MarkedEnd(mark, TRAINED_ON in photo["file"], crop)


def _mark_at(
    end_px: NDArray[np.float64], tips: list[tuple[list[int], str]], within_px: float
) -> str | None:
    off = [float(np.hypot(*(end_px - place))) for place, _ in tips]
    nearest = int(np.argmin(off))
    return tips[nearest][1] if off[nearest] < within_px and tips[nearest][1] != "?" else None


def main() -> None:
    """Look at every marked end and print how well covered ones are told from true ones."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    shipped = load_registry().resolve("cucumber-look")["network"]
    parser.add_argument("--look", type=Path, nargs="+", default=[shipped], help="the networks")
    arguments = parser.parse_args()
    measurer = Measurer(MeasureOptions(instances="models", confidence=_CONFIDENCE))
    ends = [
        end
        for photo in json.loads(MARKED.read_text(encoding="utf-8"))["photos"]
        for end in marked_ends(photo, photo_capture(arguments.folder / photo["file"]), measurer)
    ]
    marks = np.array([end.mark for end in ends])
    trained = np.array([end.trained for end in ends])
    console = Console(width=120, highlight=False)
    for file in arguments.look:
        looks = EndLooker(file).look([end.crop for end in ends])
        covered = np.array([look.covered for look in looks])
        console.print(f"\n{file.name}")
        console.print(summary_table(covered, marks, trained))


def summary_table(
    covered: NDArray[np.float64], marks: NDArray[np.str_], trained: NDArray[np.bool_]
) -> Table:
    """Return counts, area under the curve and shares flagged, for photos new and trained on."""
    table = Table(
        "photos", "true", "covered", "cut", "AUC", "AUC with cut", "covered flagged", "true flagged"
    )
    for name, rows in (("not trained on", ~trained), ("trained on", trained)):
        counts = [int((rows & (marks == mark)).sum()) for mark in "tcx"]
        told = rows & (marks != "x")
        flagged = [
            f"{100 * (covered[rows & (marks == mark)] >= DOUBTFUL).mean():.0f} %" for mark in "ct"
        ]
        areas = [area_under_curve(covered[chosen], marks[chosen] != "t") for chosen in (told, rows)]
        table.add_row(name, *map(str, counts), *(f"{area:.3f}" for area in areas), *flagged)
    return table


if __name__ == "__main__":
    main()
