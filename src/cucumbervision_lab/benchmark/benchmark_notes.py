"""What the benchmark's numbers mean, in plain words; the numbers themselves stand in its tables."""

from __future__ import annotations

__all__ = ["NOTES"]

NOTES = {
    "summary": (
        "Every capture is simulated: bodies whose lengths are known exactly, seen by a model of a "
        "D435 whose noise, holes and edges were matched to real frames. Real fruit have ridges, "
        "stalks and withered blossoms that these lack. A fruit that a method does not measure "
        "counts as 100 % error, so refusing is no way out.\n\n"
        "'Exact' masks are the fruit's own pixels; 'disturbed' ones have their outline moved by a "
        "smooth field of 1.5 px RMS; 'perceived' ones are drawn by MobileSAM from the exact box. "
        "The pose network takes no part here (`evaluate models` judges it), so M4 has nothing to "
        "measure with perceived masks. The depth scale is exact in all tables, as after `calibrate "
        "--reference-length`; a camera that nobody calibrated adds its own.\n\n"
        "The oracle knows the tube and errs only by where the mask ends it: no method can be "
        "expected to do better."
    ),
    "paper": (
        "The paper's figures were read on its own captures of seven real cucumbers against thread "
        "lengths; ours on simulated captures of seven fruit with the same thread lengths. They "
        "stand side by side, they do not measure the same thing.\n\n"
        "Why M5 differs here from the paper's 4.13 %: its spline runs along the visible surface "
        "and not over the outer side, so against the thread it reads short, the more so the "
        "thicker and shorter the fruit; its tips are the means of the five extreme points, which "
        "on noisy edges stand beside the axis, so the curve gains a zigzag at each end, most on "
        "small and distant fruit; and its gate of 3.5 cm about the median depth cuts fruit tilted "
        "to the camera. The paper's validation table gives M5 an error of exactly zero on five "
        "fruit, and its interval for M1 does not hold its own mean; neither is reproduced."
    ),
}
