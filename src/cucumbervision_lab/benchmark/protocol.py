"""What the benchmark measures: the paper's captures in simulation, and a stress set beyond them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.accuracy.records import Suite
from cucumbervision.capture.intrinsics import Intrinsics

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["CAMERA", "Case", "paper_cases", "stress_cases", "validation_cases"]

CAMERA = Intrinsics(1280, 720, 910.22, 910.39, 642.8, 358.5)  # the paper's, table 2

# Seven cucumbers in three sizes over the paper's range, by thread (cm), and its five validation
# specimens.
PAPER_THREADS_CM = (6.9, 8.2, 9.1, 12.6, 13.8, 23.6, 25.0)
PAPER_CAPTURES = 48
VALIDATION_THREADS_CM = (25.70, 14.72, 15.52, 23.92, 38.00)

FRAME_SHARE = 0.86  # of the picture's height and width that a fruit may take
PROTOCOL_DISTANCE_M = (0.40, 0.90)
STRESS_DISTANCE_M = (0.30, 1.20)
STRESS_LENGTH_M = (0.069, 0.38)
STRESS_TILT_DEG = (0.0, 60.0)
STRESS_HIDDEN = (0.0, 0.60)
SHARE_HIDDEN, SHARE_END_HIDDEN = 0.6, 0.2
SHARE_STRAIGHT = 0.2
TIGHTEST_BEND_M = 0.15


@dataclass(frozen=True)
class Case:
    """One capture to simulate; everything in it follows from these numbers.

    Parameters
    ----------
    name : str
        Unique within the suite.
    suite : Suite
        The part of the benchmark.
    fruit : str
        The fruit; captures of one fruit share `fruit_seed` and so its shape.
    fruit_seed : int
        Seed of the fruit's shape.
    capture_seed : int
        Seed of pose, surroundings and noise.
    length_m : float
        Thread length for the paper's suites, centreline for the stress set, metres.
    by_thread : bool
        Whether `length_m` is the thread.
    bend_radius_m : float or None
        Radius of the bend, metres; None for straight fruit.
    distance_m : float
        Distance of the fruit's middle, metres.
    tilt_deg, roll_deg, spin_deg : float
        As `synthesis.tube.rotation` takes them.
    hidden_share : float
        Share of the fruit's outline that leaves are to hide, 0 to 1.
    hidden_end : bool
        Whether an end is hidden; otherwise both ends are seen.
    condition : str
        'plain', 'sun' or 'wet'.
    """

    name: str
    suite: Suite
    fruit: str
    fruit_seed: int
    capture_seed: int
    length_m: float
    by_thread: bool
    bend_radius_m: float | None
    distance_m: float
    tilt_deg: float
    roll_deg: float
    spin_deg: float
    hidden_share: float = 0.0
    hidden_end: bool = False
    condition: str = "plain"


def paper_cases(count: int = PAPER_CAPTURES) -> list[Case]:
    """Give the paper's benchmark: 48 captures of seven cucumbers, in turn.

    Examples
    --------
    >>> cases = paper_cases()
    >>> len(cases), len({case.fruit for case in cases})
    (48, 7)
    """
    return [
        _plain_case(Suite.PAPER, k, k % len(PAPER_THREADS_CM), PAPER_THREADS_CM)
        for k in range(count)
    ]


def validation_cases() -> list[Case]:
    """Give the paper's five validation specimens, one capture each, as the paper has it."""
    return [
        _plain_case(Suite.VALIDATION, k, k, VALIDATION_THREADS_CM)
        for k in range(len(VALIDATION_THREADS_CM))
    ]


def _plain_case(suite: Suite, k: int, which: int, threads_cm: Sequence[float]) -> Case:
    seed = {Suite.PAPER: 1_000, Suite.VALIDATION: 2_000}[suite]
    shape = np.random.default_rng(seed + 100 + which)
    pose = np.random.default_rng(seed + 500 + k)
    length_m = threads_cm[which] / 100
    # The paper's median radius is 42 cm; a fruit is no rounder than its length allows.
    bend_m = float(np.exp(shape.normal(np.log(0.42), 0.35)))
    roll = float(pose.normal(-90, 15))
    near = max(PROTOCOL_DISTANCE_M[0], nearest_m(length_m, roll))
    return Case(
        name=f"{suite}-{k + 1:03d}",
        suite=suite,
        fruit=f"{suite}-fruit-{which + 1}",
        fruit_seed=seed + which,
        capture_seed=seed + 700 + k,
        length_m=length_m,
        by_thread=True,
        bend_radius_m=max(bend_m, length_m),
        distance_m=float(pose.uniform(near, PROTOCOL_DISTANCE_M[1])),
        tilt_deg=float(np.clip(pose.normal(0, 8), -20, 20)),
        roll_deg=roll,
        spin_deg=float(pose.uniform(0, 360)),
    )


def stress_cases(count: int, first: int = 0) -> list[Case]:
    """Give independent fruit beyond the protocol, one capture each.

    Tilt 0 to 60 degrees, 0.3 to 1.2 m, straight to bent with a radius of 15 cm, hidden 0 to 60 %
    in the middle or at an end, sun and wet leaves.

    Parameters
    ----------
    count : int
        How many.
    first : int
        Number of the first; the same number is always the same case.

    Examples
    --------
    >>> stress_cases(3)[2] == stress_cases(1, first=2)[0]
    True
    """
    return [_stress_case(k) for k in range(first, first + count)]


def _stress_case(k: int) -> Case:
    rng = np.random.default_rng(10_000_000 + k)
    length_m = float(rng.uniform(*STRESS_LENGTH_M))
    straight = rng.random() < SHARE_STRAIGHT
    tightest = max(TIGHTEST_BEND_M, 0.5 * length_m)
    bend_m = float(1 / rng.uniform(1 / 1.0, 1 / tightest))
    tilt, roll = float(rng.uniform(*STRESS_TILT_DEG)), float(rng.uniform(-180, 180))
    near = max(STRESS_DISTANCE_M[0], nearest_m(length_m, roll, tilt))
    hidden = rng.random() < SHARE_HIDDEN
    share = float(rng.uniform(*STRESS_HIDDEN))
    at_end = rng.random() < SHARE_END_HIDDEN
    return Case(
        name=f"stress-{k:05d}",
        suite=Suite.STRESS,
        fruit=f"stress-fruit-{k:05d}",
        fruit_seed=20_000_000 + k,
        capture_seed=30_000_000 + k,
        length_m=length_m,
        by_thread=False,
        bend_radius_m=None if straight else bend_m,
        distance_m=float(rng.uniform(near, max(near, STRESS_DISTANCE_M[1]))),
        tilt_deg=tilt * float(rng.choice([-1, 1])),
        roll_deg=roll,
        spin_deg=float(rng.uniform(0, 360)),
        hidden_share=share if hidden else 0.0,
        hidden_end=bool(hidden and at_end),
        condition=str(rng.choice(["plain", "sun", "wet"], p=[0.6, 0.2, 0.2])),
    )


def nearest_m(length_m: float, roll_deg: float, tilt_deg: float = 0.0) -> float:
    """Give the distance from which a whole fruit fits into the picture.

    A fruit tilted to the camera has one end nearer by half its depth, which is added.

    Examples
    --------
    >>> round(nearest_m(0.38, -90), 2)
    0.56
    """
    roll, tilt = np.deg2rad(roll_deg), np.deg2rad(tilt_deg)
    across = length_m * np.cos(tilt)
    high = across * abs(np.sin(roll)) * CAMERA.fy_px / (FRAME_SHARE * CAMERA.height)
    wide = across * abs(np.cos(roll)) * CAMERA.fx_px / (FRAME_SHARE * CAMERA.width)
    return float(max(high, wide) + 0.5 * length_m * abs(np.sin(tilt)))
