"""Make the animation of the README: a bundled capture and its measurement.

    python website/capture_animation.py         # writes docs/images/capture.gif

The capture goes through the real reader and `Measurer`; the pictures are the colour, the depth, the
masks, the measured lines as they grow, and the overlay that every run writes.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from PIL import Image

from cucumbervision import MeasureOptions, Measurer, draw_overlay, open_source
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.source import example_captures
from cucumbervision.methods.result import Fruit
from cucumbervision.run.overlay import COLORS, draw_path, draw_region
from cucumbervision_greenhouse.fruit_pictures import depth_picture
from cucumbervision_greenhouse.settings import Units

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

OUT = Path(__file__).parents[1] / "docs" / "images" / "capture.gif"
SCENE = "simulated-row-a"
WIDTH_PX, COLOURS = 720, 256
GROWTH = np.linspace(0.1, 1.0, 8)


def partly_measured(capture: Capture, fruit: tuple[Fruit, ...], share: float) -> NDArray[np.uint8]:
    """Return the picture with masks, and a share of each measured line."""
    picture, size = capture.color.copy(), max(capture.height / 720, 0.5)
    for measured, colour in zip(fruit, COLORS, strict=False):
        draw_region(picture, measured, colour, size)
        if share > 0 and measured.selected is not None and measured.selected.path_m is not None:
            count = max(2, round(share * len(measured.selected.path_m)))
            part = replace(measured.selected, path_m=measured.selected.path_m[:count])
            draw_path(picture, part, capture.intrinsics, colour, size)
    return picture


def pictures(capture: Capture, fruit: tuple[Fruit, ...]) -> Iterator[tuple[NDArray[np.uint8], int]]:
    """Yield each picture, with its duration in ms."""
    yield capture.color, 1500
    yield depth_picture(capture.depth_m, Units("cm"))[0], 1500
    yield partly_measured(capture, fruit, 0.0), 1200
    for share in GROWTH:
        yield partly_measured(capture, fruit, float(share)), 90
    yield draw_overlay(capture, fruit), 4000


def main() -> None:
    """Measure the capture and write the animation."""
    (ref,) = open_source(example_captures() / SCENE)
    result = Measurer(MeasureOptions()).measure(ref.load())
    frames_shown = list(pictures(result.capture, result.fruit))
    height = round(WIDTH_PX * result.capture.height / result.capture.width)
    small = [
        Image.fromarray(cv2.resize(picture, (WIDTH_PX, height), interpolation=cv2.INTER_AREA))
        for picture, _ in frames_shown
    ]
    # One palette for all, so that unchanged parts are stored once.
    together = Image.new("RGB", (WIDTH_PX, 3 * height))
    for row, picture in enumerate((small[0], small[1], small[-1])):
        together.paste(picture, (0, row * height))
    palette = together.quantize(COLOURS, kmeans=3)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in small]
    frames[0].save(
        OUT,
        save_all=True,
        append_images=frames[1:],
        duration=[stands for _, stands in frames_shown],
        loop=0,
        optimize=True,
    )
    print(f"{OUT.name}: {OUT.stat().st_size / 1e6:.2f} MB, {len(frames)} pictures")


if __name__ == "__main__":
    main()
