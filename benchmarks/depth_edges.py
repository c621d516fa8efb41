"""How depth behaves at outlines and across fruit: a real D435 beside the simulated one.

    python benchmarks/depth_edges.py DATA [--scenes 24]

DATA holds `rgbd/`. Real outlines are mask files (carrot, YCB) or drawn by the shipped networks
(cucumbers); those of the simulation are exact. Every third real capture was kept out of the
choice of the simulation's constants and has a column of its own. Disparity is that of a depth
stream at 1280 px, f = 640 px, baseline 50 mm, whatever the stream's size; distances are pixels of
the colour picture, positive outside.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from cucumbervision.capture.frames import Capture, fuse_burst, valid_depth
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import ReadOptions
from cucumbervision.fruit.masks import distances_inside
from cucumbervision.run.measurer import Measurer
from cucumbervision.run.options import MeasureOptions
from cucumbervision_lab.scenes.bodies import Variety, random_fruit, rotation
from cucumbervision_lab.scenes.compose import Setting, compose
from cucumbervision_lab.scenes.depth_camera import VGA, D4xx, sense
from cucumbervision_lab.scenes.scene import Scene, truth_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import NDArray


PLACES: dict[str, tuple[str, tuple[int, int], tuple[float, ...]]] = {
    "cucumbers on the plant": ("cucumber_d435/on_plant", VGA, ()),
    "cucumbers on a mat": ("cucumber_d435/on_grid", VGA, (0.2, 0.24)),
    "cucumbers beside a ruler": ("cucumber_d435/beside_ruler", VGA, (0.34, 0.36)),
    "carrot": ("carrot_realsense_1280", (1280, 720), (0.35, 0.52)),
}
"""Folder, size of the depth stream (its readings repeat), distances of lying fruit."""
STEPS_PX = ((1, 2), (2, 4), (4, 8), (8, 99))
CAMERA = Intrinsics(1280, 720, 912.0, 912.0, 640.0, 360.0)
OFFSETS_PX = np.arange(-15, 21)
RINGS_PX = ((0, 2), (2, 4), (4, 99), (-2, 0), (-4, -2), (-8, -4))
_BASELINE_FOCAL = 0.05 * 640 / 720  # m, of the picture's height
RADII_PX = ((0, 12), (12, 18), (18, 26), (26, 36), (36, 99))
_WINDOW_PX = 26
_BLENDED = (0.2, 0.8)  # share of the step


@dataclass(frozen=True, eq=False)
class Edges:
    """What one mask's outline shows.

    Parameters
    ----------
    step_px : ndarray of float64, shape (N,)
        Disparity step across each point of the outline, pixels.
    share : ndarray of float64, shape (N, 36)
        Disparity from 15 px inside to 20 px outside as a share of the step; NaN for no reading.
    normal : ndarray of float64, shape (N, 2)
        Outwards, (u, v).
    holes : ndarray of float64, shape (6, 2)
        Pixels without a reading, and pixels, in each of `RINGS_PX`; positive is inside here.
    roundness : ndarray of float64, shape (K, 2)
        Radius in pixels of depth and share of a cylinder's roundness, of each part of the fruit.
    residual_px : ndarray of float64, shape (W,)
        Disparity left of a plane through each window of 26 px without a hole, in the whole picture.
    """

    step_px: NDArray[np.float64]
    share: NDArray[np.float64]
    normal: NDArray[np.float64]
    holes: NDArray[np.float64]
    roundness: NDArray[np.float64]
    residual_px: NDArray[np.float64]


def edges_of(capture: Capture, mask: NDArray[np.bool_]) -> Edges:
    """Measure one mask."""
    depth, height = capture.depth_m, capture.height
    inside = np.where(mask, distances_inside(mask) - 0.5, 0.5 - distances_inside(~mask))
    slope_v, slope_u = np.gradient(cv2.GaussianBlur(-inside.astype(np.float32), (0, 0), 2.0))
    v, u = np.nonzero(mask & (inside < 1))
    v, u = v[::3], u[::3]
    normal = np.stack([slope_u[v, u], slope_v[v, u]], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-9
    places = np.stack([u, v], axis=1)[:, None] + normal[:, None] * OFFSETS_PX[None, :, None]
    column, row = np.rint(places).astype(int).transpose(2, 0, 1)
    inner = (column >= 0) & (column < capture.width) & (row >= 0) & (row < height)
    read = depth[row.clip(0, height - 1), column.clip(0, capture.width - 1)]
    ok = inner & valid_depth(read)
    disparity = np.where(ok, _BASELINE_FOCAL * height / np.where(ok, read, 1), np.nan)
    near_px, far_px = (_middle(disparity[:, part]) for part in (OFFSETS_PX < -5, OFFSETS_PX > 8))
    step = near_px - far_px
    share = (disparity - far_px[:, None]) / step[:, None]
    holes = []
    for start, stop in RINGS_PX:
        ring = (inside > start) & (inside <= stop)
        holes.append(((ring & ~valid_depth(depth)).sum(), ring.sum()))
    chosen = step > STEPS_PX[0][0]
    edge = step[chosen], share[chosen], normal[chosen], np.array(holes, float)
    return Edges(*edge, _roundness(capture, mask, inside), plane_residuals(depth) * height)


def plane_residuals(depth_m: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return what planes through windows leave of disparity, as a share of the picture's height."""
    height, width = (n // _WINDOW_PX * _WINDOW_PX for n in depth_m.shape)
    blocks = depth_m[:height, :width].reshape(-1, _WINDOW_PX, width // _WINDOW_PX, _WINDOW_PX)
    windows = blocks.transpose(0, 2, 1, 3).reshape(-1, _WINDOW_PX**2)
    disparity = _BASELINE_FOCAL / windows[valid_depth(windows).all(axis=1)].astype(np.float64)
    row, column = np.mgrid[0:_WINDOW_PX, 0:_WINDOW_PX].reshape(2, -1)
    base, _ = np.linalg.qr(np.stack([np.ones_like(row), row, column], axis=1).astype(float))
    return np.asarray((disparity - (disparity @ base) @ base.T).std(axis=1))


def _middle(readings: NDArray[np.float64]) -> NDArray[np.float64]:
    enough = np.isfinite(readings).sum(axis=1) >= 4
    middle = np.full(len(readings), np.nan)
    middle[enough] = np.nanmedian(readings[enough], axis=1)
    return middle


def _roundness(
    capture: Capture, mask: NDArray[np.bool_], inside: NDArray[np.float64]
) -> NDArray[np.float64]:
    # Slices of 8 px along the mask without its ends; depth behind the ridge against a cylinder's.
    v, u = np.nonzero(mask)
    places = np.stack([u, v], axis=1) - np.array([u.mean(), v.mean()])
    along = places @ np.linalg.svd(places, full_matrices=False)[2][0]
    start, stop = np.percentile(along, (15, 85))
    z, depth_px = capture.depth_m[v, u], capture.height / 720 * 640 / capture.intrinsics.fx_px
    slices = []
    for place in np.arange(start, stop, 8):
        part = (along >= place) & (along < place + 8)
        if not part.any():
            continue
        width_px = inside[v, u][part].max()
        aside = 1 - inside[v, u][part] / width_px
        reading = z[part]
        ridge = (aside < 0.3) & valid_depth(reading)
        if ridge.sum() < 10 or width_px < 8:
            continue
        radius_m = width_px * np.median(reading[ridge]) / capture.intrinsics.fx_px
        behind = (reading - np.median(reading[ridge])) / radius_m
        side = (aside > 0.3) & (aside < 0.8) & valid_depth(reading) & (np.abs(behind) < 1.0)
        if side.sum() >= 20:
            cylinder = 1 - np.sqrt(1 - aside[side] ** 2)
            slices.append((width_px * depth_px, behind[side] @ cylinder / (cylinder @ cylinder)))
    return np.array(slices).reshape(-1, 2)


def real_captures(rgbd: Path, folder: str) -> Iterator[Capture]:
    """Yield the real captures of a folder, in the order of their names."""
    camera = rgbd / folder.split("/")[0] / "intrinsics.json"
    reading = ReadOptions(intrinsics=camera if camera.is_file() else None)
    for reference in open_source(rgbd / folder, reading):
        yield reference.load()


def simulated_captures(
    depth_size: tuple[int, int], distance_m: tuple[float, ...], scenes: int
) -> Iterator[Capture]:
    """Yield simulated scenes of the same kind, with exact masks and without colours."""
    black = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    for index in range(scenes):
        rng = np.random.default_rng([640_001, index])
        scene = lying(rng, *distance_m) if distance_m else hanging(rng)
        burst = sense(scene, D4xx.like(CAMERA, depth_size), rng, 3)
        truth = truth_of(scene, CAMERA)
        clear = [f for f in truth if f.visible.sum() > 800 and f.hidden_share < 0.5]
        masks, depth_m = tuple(f.visible for f in clear), fuse_burst([black] * 3, burst).depth_m
        yield Capture(black, depth_m, CAMERA, name=str(index), masks=masks)


def hanging(rng: np.random.Generator) -> Scene:
    """Return a drawn scene of fruit on the plant."""
    return compose(rng, CAMERA, Setting.HANGING).scene


def lying(rng: np.random.Generator, nearest_m: float, farthest_m: float) -> Scene:
    """Return one fruit on a plane that faces the camera."""
    distance_m = float(rng.uniform(nearest_m, farthest_m))
    bend_m = float(rng.uniform(0.15, 0.6))
    fruit = random_fruit(rng, 0.4 * distance_m, Variety.MINI, bend_radius_m=bend_m)
    radius_m = float(fruit.radii_m.max())
    place = (0.0, 0.0, distance_m + radius_m)
    fruit = fruit.moved(rotation(float(rng.uniform(0, 360))), place)
    return Scene.of(fruit, backdrop_m=distance_m + 2 * radius_m)


def figures(edges: list[Edges]) -> dict[str, str]:
    """Return every figure of a group of outlines, by its name."""
    step, share = np.concatenate([e.step_px for e in edges]), np.vstack([e.share for e in edges])
    blended = np.where(np.isnan(share), np.nan, (share > _BLENDED[0]) & (share < _BLENDED[1]))
    cells = {"outlines; points": f"{len(edges)}; {len(step)}"}
    offsets = [int(k - OFFSETS_PX[0]) for k in range(-4, 5)]
    for start, stop in STEPS_PX:
        rows = blended[(step >= start) & (step < stop)][:, offsets]
        middle = 100 * np.nanmean(rows, axis=0) if len(rows) > 20 else ()
        cells[f"blended, %, at -4 … 4 px; step {start} to {stop} px"] = _joined(middle, ".0f")
    holes = np.sum([e.holes for e in edges], axis=0)
    gone = 100 * holes[:, 0] / np.maximum(holes[:, 1], 1)
    cells["holes inside, %: 0 to 2, 2 to 4, over 4 px"] = _joined(gone[:3], ".0f")
    cells["holes outside, %: 0 to 2, 2 to 4, 4 to 8 px"] = _joined(gone[3:], ".0f")
    rounds = np.vstack([e.roundness for e in edges])
    for start, stop in RADII_PX:
        part = rounds[(rounds[:, 0] >= start) & (rounds[:, 0] < stop), 1]
        name = f"roundness of a cylinder's; radius {start} to {stop} px of depth"
        cells[name] = f"{np.median(part):.2f} [{len(part)}]" if len(part) > 10 else "–"
    left_over = np.concatenate([e.residual_px for e in edges])
    cells["left of planes, px of disparity"] = f"{np.median(left_over):.2f} [{len(left_over)}]"
    shifts = np.array([s for e in edges if (s := shift_px(e)) is not None]).reshape(-1, 3)
    name = "depth's edge against colour's, px: right, down, outwards"
    cells[name] = _joined(np.median(shifts, axis=0), "+.1f") if len(shifts) else "–"
    cells["the same, median size"] = _joined(np.median(np.abs(shifts), axis=0), ".1f")
    return cells


def _joined(values: Iterable[float], form: str) -> str:
    return " ".join(f"{value:{form}}" for value in values) or "–"


def shift_px(edges: Edges) -> NDArray[np.float64] | None:
    """Return how far depth's edge lies right of, below and outside an outline, or None."""
    clear = edges.step_px > STEPS_PX[2][0]
    share, normal = edges.share[clear], edges.normal[clear]
    inner = np.where(share > 0.5, OFFSETS_PX, -99).max(axis=1)
    outer = np.where(share < 0.5, OFFSETS_PX, 99).min(axis=1)
    sure = (np.abs(inner) < 15) & (np.abs(outer) < 15) & (np.abs(inner - outer) < 6)
    if sure.sum() < 40:
        return None
    terms = np.column_stack([normal[sure], np.ones(sure.sum())])
    middle = (inner[sure] + outer[sure]) / 2
    return np.asarray(np.linalg.lstsq(terms, middle, rcond=None)[0])


def main() -> None:
    """Measure real and simulated captures and print both."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder that holds rgbd/")
    parser.add_argument("--scenes", type=int, default=24, help="simulated scenes of each kind")
    arguments = parser.parse_args()
    measurer = Measurer(MeasureOptions())
    for title, (folder, depth_size, distance_m) in PLACES.items():
        groups: dict[str, list[Edges]] = {"real, fitted": [], "real, kept out": [], "simulated": []}
        for index, capture in enumerate(real_captures(arguments.data / "rgbd", folder)):
            fruit_rows = () if capture.masks else measurer.measure(capture).fruit
            masks = capture.masks or [fruit.mask for fruit in fruit_rows if fruit.mask is not None]
            group = "real, kept out" if index % 3 == 2 else "real, fitted"
            groups[group] += [edges_of(capture, mask) for mask in masks]
        for capture in simulated_captures(depth_size, distance_m, arguments.scenes):
            groups["simulated"] += [edges_of(capture, mask) for mask in capture.masks or ()]
        columns = {name: figures(edges) for name, edges in groups.items()}
        table = Table("", *columns, title=title)
        for name in columns["simulated"]:
            table.add_row(name, *(cells[name] for cells in columns.values()))
        Console(width=150, highlight=False).print(table)


if __name__ == "__main__":
    main()
