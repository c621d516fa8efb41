"""Processor time of the package by stage."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from pkgutil import resolve_name
from statistics import median
from typing import Any

from figures import Figure

READING, WRITING = "reading", "rows and record"


STAGES = {
    "networks": ("perception.runtime:Network.run",),
    READING: ("pipeline.run:FolderWorker.read",),
    "pictures decoded": ("capture.readers.native:_read_frame", "capture.readers.native:read_masks"),
    "a burst's motion": ("capture.frames:moved_px",),
    "a burst's median and sharpness": ("capture.frames:fuse_burst",),
    "network inputs": ("perception.resize:Letterbox.as_input", "perception.resize:input_planes"),
    "detector's masks": ("perception.resize:Letterbox.mask_back",),
    "looks at fruit": (
        "perception.looks:PictureLooks.rescore",
        "perception.looks:PictureLooks.refine",
    ),
    "each fruit once": ("perception.detectors:each_fruit_once",),
    "SAM's prompts and masks": ("perception.sam:Sam.segment",),
    "flower": ("instances.masks:without_flower",),
    "keypoints placed": ("perception.keypoint_axis:place_keypoints",),
    "M6": ("measurement.m6:measure_m6",),
    "M1 to M5": ("measurement.methods:run_methods",),
    "doubts of depth": ("measurement.depth_doubts:depth_doubts",),
    "pose": ("measurement.pose:fruit_pose",),
    "intervals": ("measurement.selector:with_length",),
    "look at ends": ("measurement.end_looks:with_end_looks",),
    "traits": ("measurement.traits:with_traits",),
    "overlay": ("pipeline.run:FolderWorker.draw",),
    WRITING: ("pipeline.run:FolderWorker.make",),
}
"""Functions of the package by stage; a stage's time is without the stages that it calls."""


OUTSIDE = (
    *(READING, "pictures decoded", "a burst's motion", "a burst's median and sharpness"),
    *("overlay", WRITING),
)
"""Stages that read or write files, and fuse what was read."""


class StageClock:
    """Adds up the processor time of `STAGES`, by wrapping their functions; one to a process."""

    def __init__(self, now_s: Callable[[], float] = time.process_time) -> None:
        self._now_s = now_s
        self._inside_s = [0.0]  # in the stages called by each that runs
        self.start()
        for stage, paths in STAGES.items():
            for path in paths:
                self._wrap(stage, path)

    def start(self) -> None:
        """Set all sums to zero."""
        self.taken_s = dict.fromkeys(STAGES, 0.0)

    def _wrap(self, stage: str, path: str) -> None:
        module, _, place = path.partition(":")
        owner_name, _, name = place.rpartition(".")
        owner = resolve_name(f"cucumbervision.{module}" + (f":{owner_name}" if owner_name else ""))
        function = getattr(owner, name)

        def timed(*given: Any, **options: Any) -> Any:
            begun = self._now_s()
            self._inside_s.append(0.0)
            try:
                return function(*given, **options)
            finally:
                taken_s = self._now_s() - begun
                self.taken_s[stage] += taken_s - self._inside_s.pop()
                self._inside_s[-1] += taken_s

        setattr(owner, name, timed)
        for user in [m for key, m in sys.modules.items() if key.startswith("cucumbervision")]:
            for known in [key for key, value in vars(user).items() if value is function]:
                setattr(user, known, timed)


def stage_ms(
    clock: StageClock, tasks: Sequence[Callable[[], object]], rounds: int
) -> dict[str, float]:
    """Return the median processor time of a task by stage, and of the rest; tasks take turns.

    Each step waits for the one before, so that nobody else's work falls into a stage's time;
    what else runs on the machine matters little.
    """
    turns = []
    for _ in range(rounds + 1):
        clock.start()
        begun = time.process_time()
        for task in tasks:
            task()
        taken_s = {**clock.taken_s, "rest": time.process_time() - begun}
        taken_s["rest"] -= sum(clock.taken_s.values())
        turns.append({stage: 1e3 * seconds / len(tasks) for stage, seconds in taken_s.items()})
    return {stage: median(turn[stage] for turn in turns[1:]) for stage in turns[0]}


def by_stage(label: str, stages: dict[str, float]) -> list[Figure]:
    """Return the lines of `stage_ms`, and the share beyond the networks without files."""
    inside_ms = stages["networks"]
    beyond_ms = sum(stages.values()) - inside_ms
    lean_ms = beyond_ms - sum(stages[stage] for stage in OUTSIDE)
    return [
        Figure(f"{label}: processor time in the networks", inside_ms, "ms"),
        Figure(f"{label}: processor time beyond them", beyond_ms, "ms"),
        Figure(
            f"{label}: the same but for files, of the networks'",
            100 * lean_ms / inside_ms,
            "%",
            "<= 15",
        ),
        *(
            Figure(f"{label}: {stage}", value, "ms")
            for stage, value in sorted(stages.items(), key=lambda pair: -pair[1])
            if stage != "networks" and value >= 0.05
        ),
    ]
