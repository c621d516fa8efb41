"""M6 against exact truth on random swept balls: mean, median and worst error of each set.

python benchmarks/m6_trials.py --fruit 60 --sets protocol,tilted,hidden,disturbed
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from time import perf_counter

import cv2
import numpy as np
from numpy.typing import NDArray

from cucumbervision.capture.burst import median_depth
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.measurement.methods import Region, run_methods
from cucumbervision.measurement.result import Measurement, Method
from cucumbervision.perception.masks import box_of_mask
from cucumbervision_lab.synthesis.bodies import Tube, arc_tube, rotation
from cucumbervision_lab.synthesis.render import render
from cucumbervision_lab.synthesis.sensor import noisy_depth

CAMERA = Intrinsics(1280, 720, 910.0, 910.0, 640.0, 360.0)
# The paper's seven protocol fruit (three sizes, 6.9 to 25 cm) and its validation table's five.
PROTOCOL_CM = (6.9, 9.8, 12.5, 15.0, 18.2, 21.5, 25.0, 14.72, 15.52, 23.92, 25.70, 38.00)
BENDS_M = (np.inf, 0.6, 0.4, 0.3, 0.2, 0.15)
OUTLINE_RMS_PX, OUTLINE_CORRELATION_PX = 1.5, 4.0
SETS = ("protocol", "disturbed", "tilted", "tilted-disturbed", "hidden", "stress")


@dataclass(frozen=True, eq=False)
class Trial:
    """One fruit as the camera sees it, and its truth."""

    tube: Tube
    depth_m: NDArray[np.float32]
    mask: NDArray[np.bool_]
    tilt_deg: float
    oracle_m: float


def draw_trial(kind: str, index: int) -> Trial:
    """Draw fruit number `index` of a set; the same number gives the same fruit in every set."""
    rng = np.random.default_rng([7, index])
    while True:
        tube, tilt = _random_tube(kind, index, rng)
        flat = np.full((CAMERA.height, CAMERA.width), 1.2)
        scene = render([tube], CAMERA, flat)
        mask = scene.mask(0)
        if mask.any() and not _touches_frame(mask):
            break
    if kind == "hidden":
        scene = render([tube], CAMERA, _leaf(flat, mask, tube, rng))
        mask = scene.mask(0)
    ends = tube.poles_m
    oracle = tube.centreline_m
    if "disturbed" in kind:
        mask, noise = _disturbed(mask, rng)
        u = np.clip(ends[:, 0] / ends[:, 2] * CAMERA.fx_px + CAMERA.cx_px, 0, CAMERA.width - 1)
        v = np.clip(ends[:, 1] / ends[:, 2] * CAMERA.fy_px + CAMERA.cy_px, 0, CAMERA.height - 1)
        by_px = noise[v.astype(int), u.astype(int)]
        oracle += float((by_px * ends[:, 2] / CAMERA.fx_px).sum() / np.cos(np.deg2rad(tilt)))
    depth = median_depth(noisy_depth(scene.depth_m, CAMERA.fx_px, 5, rng))
    return Trial(tube, depth, mask, tilt, oracle)


def measure(trial: Trial) -> tuple[Measurement, Measurement, float]:
    """Give M6's and M5's measurement and M6's time in milliseconds."""
    region = Region(trial.depth_m, CAMERA, box_of_mask(trial.mask), trial.mask)
    start = perf_counter()
    m6 = run_methods(region, [Method.M6])[Method.M6]
    elapsed = 1e3 * (perf_counter() - start)
    return m6, run_methods(region, [Method.M5])[Method.M5], elapsed


def _random_tube(kind: str, index: int, rng: np.random.Generator) -> tuple[Tube, float]:
    if kind == "stress":
        length = rng.uniform(0.069, 0.38)
    else:
        length = PROTOCOL_CM[index % len(PROTOCOL_CM)] / 100
    radius = rng.uniform(0.012, 0.018) if length < 0.11 else rng.uniform(0.015, 0.026)
    bend = BENDS_M[int(rng.integers(len(BENDS_M)))]
    neck = rng.uniform(0.0, 0.4)
    limits = {"tilted": (30, 60), "tilted-disturbed": (30, 60), "stress": (0, 60)}
    tilt = rng.uniform(*limits.get(kind, (0, 15))) * rng.choice([-1, 1])
    turn = rotation(rng.uniform(0, 360), tilt, rng.uniform(0, 360))
    far = rng.uniform(0.4, 0.9)
    at = (rng.uniform(-0.1, 0.1), rng.uniform(-0.05, 0.05), far)
    return arc_tube(length, radius, bend, neck=neck).moved(turn, at), float(tilt)


def _touches_frame(mask: NDArray[np.bool_]) -> bool:
    return bool(mask[[0, -1]].any() or mask[:, [0, -1]].any())


def _leaf(
    flat: NDArray[np.float64], mask: NDArray[np.bool_], tube: Tube, rng: np.random.Generator
) -> NDArray[np.float64]:
    # A nearer strip across the middle that hides 20 to 40 % of the fruit's pixels.
    centres = tube.centres_m
    image = centres[:, :2] / centres[:, 2:] * CAMERA.fx_px + (CAMERA.cx_px, CAMERA.cy_px)
    middle = image[int(len(image) * rng.uniform(0.42, 0.58))]
    across = image[-1] - image[0]
    turn = rng.uniform(-0.5, 0.5)
    along = across / np.linalg.norm(across)
    along = np.array(
        [
            along[0] * np.cos(turn) - along[1] * np.sin(turn),
            along[0] * np.sin(turn) + along[1] * np.cos(turn),
        ]
    )
    v, u = np.nonzero(mask)
    far = np.abs((np.stack([u, v], axis=1) - middle) @ along)
    half_px = np.quantile(far, rng.uniform(0.2, 0.4))
    rows, columns = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    strip = np.abs((columns - middle[0]) * along[0] + (rows - middle[1]) * along[1]) <= half_px
    near = centres[:, 2].min() - tube.radii_m.max() - rng.uniform(0.01, 0.06)
    return np.where(strip, near, flat)


def _disturbed(
    mask: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    noise = cv2.GaussianBlur(rng.standard_normal(mask.shape), (0, 0), OUTLINE_CORRELATION_PX)
    noise *= OUTLINE_RMS_PX / noise.std()
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    signed = np.where(mask, inside - 0.5, 0.5 - outside)
    return np.asarray(signed + noise > 0), np.asarray(noise)


def _line(name: str, errors: NDArray[np.float64]) -> str:
    size = 100 * np.abs(errors)
    figures = (size.mean(), np.median(size), size.max(), 100 * errors.mean())
    return f"{name:28s}" + "".join(f"{x:9.2f}" for x in figures)


def report(kind: str, fruit: int) -> None:
    """Print one set's table; an unmeasured fruit counts as 100 % error."""
    kept: dict[str, list[float]] = {
        k: [] for k in ("centreline", "thread", "chord", "M5", "oracle")
    }
    times, normalised = [], []
    for index in range(fruit):
        trial = draw_trial(kind, index)
        m6, m5, elapsed = measure(trial)
        true = trial.tube
        tube = m6.tube
        kept["centreline"].append(tube.centreline_m / true.centreline_m - 1 if tube else -1.0)
        kept["thread"].append(tube.thread_m / true.thread_m - 1 if tube else -1.0)
        kept["chord"].append(tube.chord_m / true.chord_m - 1 if tube else -1.0)
        kept["M5"].append((m5.length_m or 0.0) / true.centreline_m - 1)
        kept["oracle"].append(trial.oracle_m / true.centreline_m - 1)
        times.append(elapsed)
        if m6.fit is not None and tube is not None:
            normalised.append((tube.centreline_m - true.centreline_m) / m6.fit.centreline_sd_m)
    print(f"{kind}, {fruit} fruit, % error:      mean   median    worst     bias")
    for name, errors in kept.items():
        print(_line(f"  {name}", np.array(errors)))
    spread = 1.4826 * np.median(np.abs(normalised))
    print(f"  error / sd: robust spread {spread:.2f}; {np.median(times):.1f} ms a fruit")


def main() -> None:
    """Run the sets that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fruit", type=int, default=60)
    parser.add_argument("--sets", default=",".join(SETS))
    options = parser.parse_args()
    for kind in options.sets.split(","):
        report(kind, options.fruit)


if __name__ == "__main__":
    main()
