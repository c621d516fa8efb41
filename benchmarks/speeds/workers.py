"""Two workers beside one."""

from __future__ import annotations

import os

from figures import Figure

from cucumbervision.run.batch import Processes
from speeds.frames import GIVEN, MODELS, pace


def workers(quick: bool) -> list[Figure]:
    """Compare two workers with one on one core, with all networks and with given masks."""
    figures = []
    for label, options, count in (("networks", MODELS, 24), ("given masks", GIVEN, 60)):
        count = max(9, count // 5) if quick else count
        two_s = pace(options, Processes(2), count, 5)
        cores = os.sched_getaffinity(0)
        os.sched_setaffinity(0, {min(cores)})
        try:
            one_s = pace(options, Processes(1), count, 5)
        finally:
            os.sched_setaffinity(0, cores)
        name = f"{label}: two workers, times one on one core"
        figures.append(Figure(name, one_s / two_s, "x", ">= 1.7"))
    return figures
