"""One tube in several real views: a rigid carrot, which has one length, from ten places.

    python benchmarks/real_views.py DATA_FOLDER

The frames of `rgbd/carrot_realsense_1280` say nothing of where the camera was. That is found here
from the pictures (ORB features, depth, and perspective-n-point with RANSAC), and given to
`measurement.views` as known to 1 cm and 1 degree. Each row: the length by one, two or three frames,
its mean, and its spread (standard deviation / mean) over all groups of frames that were taken from
places far enough apart to count as different ones (a tenth of the distance).
"""

from __future__ import annotations

import argparse
from itertools import combinations, pairwise
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.readers import open_source
from cucumbervision.measurement.result import LengthDefinition
from cucumbervision.measurement.views import FruitView, measure_views
from cucumbervision.perception.instances import Instance, MaskSource
from cucumbervision.perception.masks import box_of_mask

Points: TypeAlias = NDArray[np.float64]

CARROT = "rgbd/carrot_realsense_1280"
SHIFT_SD_M, TURN_SD_DEG = 0.01, 1.0
LEAST_MATCHES = 25


def features(
    capture: Capture,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.uint8]]:
    """Return pixels, points in space and descriptors of a frame's features that have a depth."""
    grey = cv2.cvtColor(capture.color, cv2.COLOR_RGB2GRAY)
    found, described = cv2.ORB_create(4000).detectAndCompute(grey, None)  # type: ignore[attr-defined]
    pixels = np.array([one.pt for one in found])
    u, v = pixels.round().astype(int).T
    z = capture.depth_m[v.clip(0, capture.height - 1), u.clip(0, capture.width - 1)]
    x, y = capture.intrinsics.rays(pixels[:, 0], pixels[:, 1])
    points = np.stack([x * z, y * z, z], axis=1).astype(np.float64)
    kept = z > 0.1
    return pixels[kept], points[kept], described[kept]


def step(before: Capture, after: Capture) -> tuple[Points, int]:
    """Return the pose from the later camera's coordinates to the earlier one's, and matches."""
    _, points, first = features(before)
    pixels, _, second = features(after)
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(first, second)
    here = points[[one.queryIdx for one in pairs]]
    there = pixels[[one.trainIdx for one in pairs]]
    lens = after.intrinsics.matrix
    _, turn, shift, kept = cv2.solvePnPRansac(
        here, there, lens, None, iterationsCount=2000, reprojectionError=2.0
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    return np.asarray(np.linalg.inv(pose), np.float64), len(kept)


def main() -> None:
    """Print the spread by number of views."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    folder = parser.parse_args().data / CARROT
    captures = [ref.load() for ref in open_source(folder)]
    poses = [np.eye(4)]
    for before, after in pairwise(captures):
        pose, matches = step(before, after)
        away = 100 * np.linalg.norm(pose[:3, 3])
        print(f"{after.name}: {matches} features, {away:.1f} cm from the last")
        if matches < LEAST_MATCHES:
            print("  too few: this step is not sure")
        poses.append(poses[-1] @ pose)
    views = []
    for capture, pose in zip(captures, poses, strict=True):
        mask = capture.masks[0]
        fruit = Instance(box_of_mask(mask), mask=mask, mask_source=MaskSource.DATASET)
        views.append(FruitView(capture, fruit, pose, SHIFT_SD_M, np.deg2rad(TURN_SD_DEG)))
    table = Table(title="Carrot, centreline by one tube in frames from different places")
    for head in ("frames", "groups", "mean, cm", "spread, %", "least, cm", "most, cm"):
        table.add_column(head, justify="right")
    for count in (1, 2, 3):
        joint = [
            measure_views(some, LengthDefinition.CENTRELINE) for some in combinations(views, count)
        ]
        # Of frames too near to each other only the best counts: that is no group of this size.
        lengths = [one.fruit.length for one in joint if one is not None and len(one.poses) == count]
        cm = np.array([100 * length.value_m for length in lengths if length is not None])
        spread = 100 * cm.std(ddof=1) / cm.mean()
        cells = (f"{cm.mean():.2f}", f"{spread:.2f}", f"{cm.min():.2f}", f"{cm.max():.2f}")
        table.add_row(str(count), str(len(cm)), *cells)
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
