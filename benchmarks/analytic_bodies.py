"""What each method reads on bodies whose lengths are known exactly.

    python benchmarks/analytic_bodies.py

Exact depth and exact masks, no noise: what is left is the method's own geometry. The first table
lays a straight fruit at several angles in the picture before several backdrops, which is where M1
differs; the second tilts it to the camera and bends it.
"""

from __future__ import annotations

import numpy as np
from rich.console import Console
from rich.table import Table

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.measurement.methods import AVAILABLE, Region, run_methods
from cucumbervision.perception.masks import box_of_mask
from cucumbervision_lab.synthesis.bodies import Tube, arc_tube, rotation
from cucumbervision_lab.synthesis.scene import Scene, render

CAMERA = Intrinsics(1280, 720, 910.0, 910.0, 640.0, 360.0)
LENGTH_M, RADIUS_M, DEPTH_M = 0.20, 0.018, 0.5
BACKDROPS = {"at its own depth": DEPTH_M, "empty": 0.0, "far, 1.2 m": 1.2}


def read(tube: Tube, backdrop_m: float = 0.0) -> list[str]:
    """Return every method's length in cm, as text."""
    scene = render(Scene.of(tube, backdrop_m=backdrop_m), CAMERA)
    mask = scene.mask(0)
    region = Region(scene.depth_m.astype(np.float32), CAMERA, box_of_mask(mask), mask)
    results = run_methods(region)
    return ["–" if r.length_m is None else f"{100 * r.length_m:.1f}" for r in results.values()]


def angle_table() -> Table:
    """Lay a straight fruit at angles in the picture."""
    table = Table(title="Straight fruit 20.0 x 3.6 cm at 50 cm, at an angle in the picture: cm")
    for head in ("angle", "L cos t", "backdrop", *(str(m) for m in AVAILABLE)):
        table.add_column(head, justify="right")
    for angle_deg in (0, 15, 30, 45):
        tube = arc_tube(LENGTH_M, RADIUS_M).moved(rotation(angle_deg), (0, 0, DEPTH_M))
        limit = 100 * LENGTH_M * np.cos(np.deg2rad(angle_deg))
        for name, backdrop in BACKDROPS.items():
            table.add_row(f"{angle_deg}°", f"{limit:.1f}", name, *read(tube, backdrop))
    return table


def shape_table() -> Table:
    """Tilt a fruit to the camera, and bend it."""
    table = Table(title="Fruit before empty space, hanging, 25.0 x 4.0 cm at 60 cm: cm")
    for head in ("tilt", "bend", "centreline", "thread", "chord", *(str(m) for m in AVAILABLE)):
        table.add_column(head, justify="right")
    for tilt_deg in (0, 15, 30, 45, 60):
        for bend_m in (np.inf, 0.3, 0.15):
            tube = arc_tube(0.25, 0.02, bend_m).moved(rotation(90, tilt_deg), (0, 0, 0.6))
            lengths = [f"{100 * x:.1f}" for x in (tube.centreline_m, tube.thread_m, tube.chord_m)]
            bend = "straight" if np.isinf(bend_m) else f"R {100 * bend_m:.0f} cm"
            table.add_row(f"{tilt_deg}°", bend, *lengths, *read(tube))
    return table


if __name__ == "__main__":
    console = Console(width=120, highlight=False)
    console.print(angle_table())
    console.print(shape_table())
