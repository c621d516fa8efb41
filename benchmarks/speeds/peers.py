"""Other programs on the same mask."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from statistics import median

from figures import Figure

from cucumbervision.methods.result import MethodName
from cucumbervision.methods.table import run_methods
from cucumbervision_lab.evaluate.baselines import BASELINES, available_baselines
from speeds.kernels import CAMERA, PAPER_METHODS, draw_region, floor, fresh, milliseconds


def in_turns(tasks: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Return the median milliseconds of each task; they take turns, after two for warming up."""
    turns = [{name: milliseconds(task) for name, task in tasks.items()} for _ in range(rounds + 2)]
    return {name: median(turn[name] for turn in turns[2:]) for name in tasks}


def peers(quick: bool) -> list[Figure]:
    """Compare processor times with other programs: lengths on one mask."""
    drawn, rounds = draw_region(), 5 if quick else 30
    mask = drawn.mask
    assert mask is not None
    tasks: dict[str, Callable[[], object]] = {
        "M1 to M5": lambda: run_methods(fresh(drawn), PAPER_METHODS),
        "M6": lambda: run_methods(fresh(drawn), [MethodName.M6]),
    }
    installed_baselines = available_baselines()
    for name in BASELINES:
        if name not in installed_baselines:
            print(f"{name} is not installed")
            continue
        named = f"{name} {version(name)}"
        tasks[named] = partial(installed_baselines[name], drawn.depth_m, mask, CAMERA)
    taken_ms = in_turns(tasks, rounds)
    floor_ms = in_turns({"": lambda: floor(drawn.depth_m, mask, drawn.box)}, rounds)[""]
    return [
        Figure(f"a length by {name}, times the plain NumPy floor", value / floor_ms, "x")
        for name, value in taken_ms.items()
    ]
