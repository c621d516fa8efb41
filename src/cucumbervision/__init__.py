"""Measures greenhouse cucumbers without touching them, from RGB-D pictures.

The public names; each is loaded when it is first used.

Examples
--------
>>> import cucumbervision
>>> from cucumbervision.capture.bundled import bundled_captures
>>> ref = next(iter(cucumbervision.open_source(bundled_captures())))
>>> capture = ref.load()
>>> instances = cucumbervision.dataset_instances(capture)
>>> fruit = cucumbervision.measure_fruit(capture, instances[0])
>>> f"{capture.name}: {fruit.selected.length_m:.2f} m by {fruit.selected.method}"
'simulated-bench: 0.16 m by M6'
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from cucumbervision._version import __version__

if TYPE_CHECKING:
    from cucumbervision.capture.burst import fuse_burst
    from cucumbervision.capture.cameras.realsense import CameraConfig, RealSenseCamera
    from cucumbervision.capture.frames import Capture, Stop
    from cucumbervision.capture.intrinsics import Distortion, Intrinsics, Stream, check_intrinsics
    from cucumbervision.capture.readers import open_source
    from cucumbervision.capture.source import CaptureRef, CaptureSource, ReadOptions
    from cucumbervision.capture.writer import write_native
    from cucumbervision.errors import CucumberVisionError
    from cucumbervision.measurement.methods import Region, run_methods
    from cucumbervision.measurement.result import (
        Fruit,
        Length,
        LengthKind,
        Measurement,
        Method,
        Reason,
    )
    from cucumbervision.measurement.selector import Selector, measure_fruit
    from cucumbervision.perception.instances import Instance, MaskSource
    from cucumbervision.perception.sam import Segmenter
    from cucumbervision.perception.yolo import YoloDetector
    from cucumbervision.pipeline.finders import dataset_instances
    from cucumbervision.pipeline.options import MeasureOptions
    from cucumbervision.pipeline.overlay import draw_overlay
    from cucumbervision.pipeline.run import measure_inputs

_HOME = {
    "CameraConfig": "capture.cameras.realsense",
    "Capture": "capture.frames",
    "CaptureRef": "capture.source",
    "CaptureSource": "capture.source",
    "CucumberVisionError": "errors",
    "Distortion": "capture.intrinsics",
    "Fruit": "measurement.result",
    "Instance": "perception.instances",
    "Intrinsics": "capture.intrinsics",
    "Length": "measurement.result",
    "LengthKind": "measurement.result",
    "MaskSource": "perception.instances",
    "MeasureOptions": "pipeline.options",
    "Measurement": "measurement.result",
    "Method": "measurement.result",
    "ReadOptions": "capture.source",
    "RealSenseCamera": "capture.cameras.realsense",
    "Reason": "measurement.result",
    "Region": "measurement.methods",
    "Segmenter": "perception.sam",
    "Selector": "measurement.selector",
    "Stop": "capture.frames",
    "Stream": "capture.intrinsics",
    "YoloDetector": "perception.yolo",
    "check_intrinsics": "capture.intrinsics",
    "dataset_instances": "pipeline.finders",
    "draw_overlay": "pipeline.overlay",
    "fuse_burst": "capture.burst",
    "measure_fruit": "measurement.selector",
    "measure_inputs": "pipeline.run",
    "open_source": "capture.readers",
    "run_methods": "measurement.methods",
    "write_native": "capture.writer",
}

__all__ = [
    "CameraConfig",
    "Capture",
    "CaptureRef",
    "CaptureSource",
    "CucumberVisionError",
    "Distortion",
    "Fruit",
    "Instance",
    "Intrinsics",
    "Length",
    "LengthKind",
    "MaskSource",
    "MeasureOptions",
    "Measurement",
    "Method",
    "ReadOptions",
    "RealSenseCamera",
    "Reason",
    "Region",
    "Segmenter",
    "Selector",
    "Stop",
    "Stream",
    "YoloDetector",
    "__version__",
    "check_intrinsics",
    "dataset_instances",
    "draw_overlay",
    "fuse_burst",
    "measure_fruit",
    "measure_inputs",
    "open_source",
    "run_methods",
    "write_native",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'cucumbervision' has no attribute {name!r}")
    return getattr(import_module(f"cucumbervision.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
