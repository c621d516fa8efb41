"""Draw how each method measures one fruit of a bundled capture.

    python website/method_figures.py            # writes docs/images/m1.png … m6.png and lengths.png
    python website/method_figures.py --table    # prints the table of docs/methods.md

Every point, line and length is a result of the methods. The left picture is the camera's; the right
one shows the same fruit from the side, with the simulated body in grey.
"""

from __future__ import annotations

import io
import sys
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from demo_captures import CAMERA, SCENES, build_scene
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from PIL import Image

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.fruit.masks import box_of_mask
from cucumbervision.methods.m6 import TubeView
from cucumbervision.methods.paper_methods import (
    M1_WINDOW_PX,
    reference_depth,
    sample_grid,
    window_depths,
)
from cucumbervision.methods.paper_methods import M1_WINDOW_PX as M4_WINDOW_PX
from cucumbervision.methods.result import Measurement, MethodName, TubeTraits
from cucumbervision.methods.table import GATE_M, Region, run_methods
from cucumbervision.tube.shape import align_near
from cucumbervision_lab.scenes.bodies import Tube
from cucumbervision_lab.scenes.scene import FruitTruth, truth_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

IMAGES = Path(__file__).parents[1] / "docs" / "images"
SCENE, FRUIT, BENT = "simulated-row-b", 1, 0
MARGIN_PX = 30
# Okabe and Ito's colour-blind-safe palette.
COLOURS = {
    **{"M1": "#E69F00", "M2": "#56B4E9", "M3": "#009E73"},
    **{"M4": "#CC79A7", "M5": "#0072B2", "M6": "#D55E00"},
}
GREY, DARK, REFUSED = "#d4d4d4", "#222222", "#c0392b"
SMALL = 9.0  # larger dots are single samples, with an edge
SIDE_CM = 5.0  # room before and behind the fruit in the view from the side


@dataclass(frozen=True, eq=False)
class Example:
    """The fruit of the figures: capture, simulated truth and measurements."""

    color: NDArray[np.uint8]
    region: Region
    body: Tube
    truth: FruitTruth

    @cached_property
    def measured(self) -> dict[str, Measurement]:
        """Every method's measurement."""
        return run_methods(self.region)


def load_example() -> Example:
    """Read the capture, and build its scene again for the truth."""
    (ref,) = open_source(example_captures() / SCENE)
    capture = ref.load()
    scene = build_scene(next(demo for demo in SCENES if demo.name == SCENE))
    truth = truth_of(scene, CAMERA)[FRUIT]
    keypoints = np.column_stack([truth.keypoints_px, truth.keypoint_visibility / 2])
    mask = capture.masks[FRUIT]
    region = Region(capture.depth_m, capture.intrinsics, box_of_mask(mask), mask, keypoints)
    return Example(capture.color, region, scene.fruit[FRUIT], truth)


def reading_table(example: Example) -> str:
    """Return a Markdown table of each method's length."""
    readings: list[tuple[str, float | None, str | None]] = [
        (method, reading.length_m, reading.kind) for method, reading in example.measured.items()
    ]
    tube = example.measured[MethodName.M6].tube
    if tube is not None:
        readings += [
            (MethodName.M6, tube.thread_m, "thread"),
            (MethodName.M6, tube.chord_m, "chord"),
        ]
    rows = [f"| {method} | {_cm(length)} | `{kind}` |" for method, length, kind in readings]
    truth = example.truth
    for kind, length in (
        ("centreline", truth.centreline_m),
        ("thread", truth.thread_m),
        ("chord", truth.chord_m),
    ):
        rows.append(f"| *as drawn* | {_cm(length)} | `{kind}` |")
    return "\n".join(["| method | length | kind |", "|---|--:|---|", *rows])


def _cm(length_m: float | None) -> str:
    return "–" if length_m is None else f"{100 * length_m:.1f} cm"


@dataclass(frozen=True, eq=False)
class Used:
    """The input of a method: points in space, rejected points, and its depth gate."""

    points_m: NDArray[np.float64]
    refused_m: NDArray[np.float64]
    gate_m: float | None = None  # its middle


NOTHING = np.empty((0, 3))


def used_by(method: MethodName, region: Region) -> Used:
    """Return the input of a method on the fruit."""
    if method is MethodName.M1:
        return _samples(region)
    if method is MethodName.M4:
        assert region.keypoints is not None
        u, v, _ = region.keypoints.T
        depths = window_depths(region.depth_m, u, v, M4_WINDOW_PX, region.mask)
        return Used(_lifted(region, u, v, depths), NOTHING)
    if method is MethodName.M6:
        return Used(_tube_view(region).evidence.points_m, NOTHING)
    points = region.box_points_m if method is MethodName.M2 else region.mask_points_m
    assert points is not None
    middle = float(np.median(points[:, 2]))
    off = np.abs(points[:, 2] - middle) > GATE_M
    return Used(align_near(points, GATE_M).points_m, points[off], middle)


def _samples(region: Region) -> Used:
    u, v = (grid.ravel() for grid in sample_grid(region.box))
    depths = window_depths(region.depth_m, u, v, M1_WINDOW_PX)
    middle = reference_depth(region.depth_m, region.box)
    assert middle is not None
    points = _lifted(region, u, v, depths)
    counts = np.abs(depths - middle) <= GATE_M
    return Used(points[counts], points[~counts & np.isfinite(depths)], middle)


def _lifted(region: Region, u: Any, v: Any, depths_m: Any) -> NDArray[np.float64]:
    x, y = region.intrinsics.rays(u, v)
    return np.stack([x * depths_m, y * depths_m, depths_m], axis=-1)


def draw_method(example: Example, method: MethodName) -> Figure:
    """Return the figure of one method: the picture, and the fruit from the side."""
    figure = Figure(figsize=(7.2, 5.6), dpi=110, layout="constrained")
    picture_axes, side_axes = figure.subplots(1, 2, width_ratios=(1, 1.5))
    used, reading = used_by(method, example.region), example.measured[method]
    _draw_picture(picture_axes, example, method, used)
    _draw_side(side_axes, example, method, used)
    truth = example.truth.centreline_m
    figure.suptitle(
        f"{method}: {_cm(reading.length_m)} ({reading.kind}); centreline as drawn: {_cm(truth)}"
    )
    return figure


def _draw_picture(axes: Axes, example: Example, method: MethodName, used: Used) -> None:
    region, colour = example.region, COLOURS[str(method)]
    axes.imshow(example.color)
    dot = 26.0 if method in (MethodName.M1, MethodName.M4) else 1.5
    for points, tint, mark in ((used.refused_m, REFUSED, "x"), (used.points_m, colour, "o")):
        u, v = _pixels(region, points)
        if dot > SMALL and mark == "o":
            axes.scatter(u, v, s=dot, c=tint, marker=mark, edgecolors="black", linewidths=0.6)
        else:
            axes.scatter(u, v, s=dot, c=tint, marker=mark)
    if method is MethodName.M6:
        u, v = _pixels(region, _tube_view(region).evidence.rays)
        axes.scatter(u, v, s=5, c="white", marker="s")
    path = example.measured[method].path_m
    if path is not None:
        for width, tint in ((3.6, "black"), (1.8, "white")):
            axes.plot(*region.intrinsics.project(path).T, color=tint, lw=width)
    x1, y1, x2, y2 = region.box
    if method in (MethodName.M1, MethodName.M2):
        axes.plot([x1, x2, x2, x1, x1], [y1, y1, y2, y2, y1], color="white", lw=1)
    axes.set(xlim=(x1 - MARGIN_PX, x2 + MARGIN_PX), ylim=(y2 + MARGIN_PX, y1 - MARGIN_PX))
    axes.set(xticks=[], yticks=[], title="picture")


def _pixels(region: Region, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    return region.intrinsics.project(points_m).T if len(points_m) else np.empty((2, 0))


def _tube_view(region: Region) -> TubeView:
    view = None if region.mask is None else TubeView(region.depth_m, region.mask, region.intrinsics)
    assert view is not None
    return view


def _side(points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    # From the side: distance to the right, up upwards, in cm.
    return 100 * np.stack([points_m[:, 2], -points_m[:, 1]])


def _draw_side(axes: Axes, example: Example, method: MethodName, used: Used) -> None:
    colour, reading = COLOURS[str(method)], example.measured[method]
    centres, radii = _side(example.body.centres_m), 100 * example.body.radii_m
    for x, y, radius in zip(*centres, radii, strict=True):
        axes.add_patch(Circle((x, y), radius, color=GREY, lw=0))
    if used.gate_m is not None:
        gate_start, gate_end = (100 * (used.gate_m + side * GATE_M) for side in (-1, 1))
        axes.axvspan(
            gate_start, gate_end, color="#ffe9a8", alpha=0.5, zorder=0, label="gate, ± 3.5 cm"
        )
    dot = 22.0 if method in (MethodName.M1, MethodName.M4) else 3.0
    if len(used.refused_m):
        z, up = _side(used.refused_m)
        axes.scatter(z, up, s=dot, c=REFUSED, marker="x", label="refused")
    named = {MethodName.M1: "samples", MethodName.M4: "keypoints with depth"}.get(
        method, "depth readings"
    )
    z, up = _side(used.points_m)
    axes.scatter(z, up, s=dot, c=colour, label=named, zorder=5 if dot > SMALL else 3)
    if reading.fit is not None:
        for number, edge in enumerate(_edges(reading.fit.traits)):
            axes.plot(
                *edge, color=colour, lw=1.6, label=None if number else "fitted tube", zorder=4
            )
    if reading.path_m is not None:
        axes.plot(*_side(reading.path_m), color=DARK, lw=2, label="measured line", zorder=4)
    xlim, ylim = (
        ((x - radii).min() - margin, (x + radii).max() + margin)
        for x, margin in zip(centres, (SIDE_CM, SIDE_CM / 2), strict=True)
    )
    axes.set(xlim=xlim, ylim=ylim, aspect="equal")
    axes.set(xlabel="distance from the camera, cm", ylabel="up, cm", title="from the side")
    axes.legend(loc="lower right", fontsize=8, framealpha=0.9)


def _edges(tube: TubeTraits) -> NDArray[np.float64]:
    # The tube's two edges as seen from the side, shape (2, 2, 101), cm.
    walked = np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(tube.axis_m, axis=0), axis=1))]
    )
    axis = np.stack([np.interp(tube.along_m, walked, c) for c in _side(tube.axis_m)])
    ahead = np.gradient(axis, axis=1)
    across = np.stack([-ahead[1], ahead[0]]) / np.linalg.norm(ahead, axis=0)
    out = across * (50 * tube.diameter_m)
    return np.stack([axis + out, axis - out])


def _outer_side(body: Tube) -> NDArray[np.float64]:
    # The axis moved outward by the radius, straight on beyond the round ends as the axis is.
    ahead = np.gradient(body.axis_m, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    across = body.outward - (ahead @ body.outward)[:, None] * ahead
    across /= np.linalg.norm(across, axis=1)[:, None]
    radii = np.pad(body.radii_m, 1, mode="edge")
    return np.asarray(body.axis_m + radii[:, None] * across)


def draw_lengths() -> Figure:
    """Return the figure of the three lengths of a fruit, in the plane of its bend."""
    body = build_scene(next(demo for demo in SCENES if demo.name == SCENE)).fruit[BENT]
    start, end = body.poles_m
    along = (end - start) / np.linalg.norm(end - start)
    outward = body.outward - (body.outward @ along) * along
    plane = 100 * np.stack([along, outward / np.linalg.norm(outward)])
    figure = Figure(figsize=(7.2, 1.9), dpi=110, layout="constrained")
    axes = figure.subplots()
    for centre, radius in zip((body.centres_m - start) @ plane.T, body.radii_m, strict=True):
        axes.add_patch(Circle((centre[0], centre[1]), 100 * radius, color=GREY, lw=0))
    for (name, length, path), style in zip(
        (
            ("thread", body.thread_m, _outer_side(body)),
            ("centreline", body.centreline_m, body.axis_m),
            ("chord", body.chord_m, body.poles_m),
        ),
        (COLOURS["M6"], COLOURS["M5"], DARK),
        strict=True,
    ):
        axes.plot(*((path - start) @ plane.T).T, color=style, lw=2, label=f"{name}: {_cm(length)}")
    axes.set(aspect="equal", xlabel="cm", ylabel="cm")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure


def save(figure: Figure, name: str) -> None:
    """Write a figure with 256 colours, which is a third of its size."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png")
    picture = Image.open(drawn).convert("RGB")
    picture.quantize(256, dither=Image.Dither.NONE).save(IMAGES / f"{name}.png", optimize=True)


def main() -> None:
    """Write the figures, or print the table."""
    example = load_example()
    if "--table" in sys.argv[1:]:
        print(reading_table(example))
        return
    save(draw_lengths(), "lengths")
    for method in MethodName:
        save(draw_method(example, method), str(method).lower())


if __name__ == "__main__":
    main()
