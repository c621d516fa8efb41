"""Other programs on the same mask and pictures."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from statistics import median

from figures import Figure

from cucumbervision.errors import MissingExtraError
from cucumbervision.measurement.methods import run_methods
from cucumbervision.measurement.result import MethodName
from cucumbervision.perception.registry import load_registry
from cucumbervision.perception.yolo import YoloDetector
from cucumbervision_lab.benchmark.baselines import BASELINES, available_baselines
from cucumbervision_lab.training.networks import import_ultralytics
from speeds.frames import bundled
from speeds.kernels import CAMERA, PAPER_METHODS, draw_region, floor, fresh, milliseconds


def in_turns(tasks: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Return the median milliseconds of each task; they take turns, after two for warming up."""
    turns = [{name: milliseconds(task) for name, task in tasks.items()} for _ in range(rounds + 2)]
    return {name: median(turn[name] for turn in turns[2:]) for name in tasks}


def peers(quick: bool) -> list[Figure]:
    """Compare processor times with other programs: lengths on one mask, detection in pictures."""
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
    figures = [
        Figure(f"a length by {name}, times the plain NumPy floor", value / floor_ms, "x")
        for name, value in taken_ms.items()
    ]
    return figures + detection_by_peers(rounds)


def detection_by_peers(rounds: int) -> list[Figure]:
    """Compare our detector with Ultralytics' prediction by the same network and runtime."""
    try:
        ultralytics = import_ultralytics()
    except MissingExtraError:
        print("Ultralytics is not installed")
        return []
    import torchvision
    from ultralytics.utils.nms import TorchNMS

    if not torchvision.extension._has_ops():  # a build for another torch
        torchvision.ops.nms = TorchNMS.nms
    registry = load_registry()
    model = registry.default("segment")
    assert model is not None
    path = registry.resolve(model.name)["network"]
    colors = [capture.color for capture in bundled()]
    ours = YoloDetector(path, "onnxruntime", input_sizes=(640,), full_precision=True)
    theirs = ultralytics.YOLO(path, task="segment")
    told = {"imgsz": 640, "conf": 0.25, "retina_masks": True, "verbose": False, "device": "cpu"}
    taken_ms = in_turns(
        {
            "ours": lambda: [ours.detect(color) for color in colors],
            "theirs": lambda: [theirs.predict(color[..., ::-1], **told) for color in colors],
        },
        rounds,
    )
    ratio = taken_ms["ours"] / taken_ms["theirs"]
    name = f"Ultralytics {ultralytics.__version__}, with the same network and ONNX Runtime"
    return [Figure(f"detection at 640, times the prediction of {name}", ratio, "x")]
