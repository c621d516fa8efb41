"""Measures greenhouse cucumbers without touching them, from RGB-D pictures.

The public names; each is loaded when it is first used.

Examples
--------
>>> import cucumbervision
>>> from cucumbervision.capture.source import bundled_captures
>>> capture = next(iter(cucumbervision.open_source(bundled_captures()))).load()
>>> measurer = cucumbervision.Measurer(cucumbervision.MeasureOptions(instances="dataset"))
>>> length = measurer.measure(capture).fruit[0].length
>>> f"{capture.name}: {length.value_m:.2f} m ({length.low_m:.2f} to {length.high_m:.2f})"
'simulated-bench: 0.18 m (0.18 to 0.19)'
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from cucumbervision._version import __version__

if TYPE_CHECKING:
    from cucumbervision.capture.frames import Capture, Stop, fuse_burst
    from cucumbervision.capture.intrinsics import Distortion, Intrinsics, Stream, check_intrinsics
    from cucumbervision.capture.readers import open_source
    from cucumbervision.capture.readers.native import write_native
    from cucumbervision.capture.realsense import CameraConfig, RealSenseCamera
    from cucumbervision.capture.source import CaptureRef, CaptureSource, ReadOptions
    from cucumbervision.errors import CucumberVisionError
    from cucumbervision.measurement.methods import Region, run_methods
    from cucumbervision.measurement.result import (
        Choice,
        Flag,
        FruitMeasurement,
        Length,
        LengthDefinition,
        LengthKind,
        Measurement,
        Method,
        Reason,
        Selector,
    )
    from cucumbervision.measurement.selector import measure_fruit
    from cucumbervision.measurement.traits import TubeTraits
    from cucumbervision.perception.instances import Instance, MaskSource
    from cucumbervision.perception.sam import Segmenter
    from cucumbervision.perception.yolo import YoloDetector
    from cucumbervision.pipeline.detect import DetectOptions, detect_inputs
    from cucumbervision.pipeline.finders import dataset_instances
    from cucumbervision.pipeline.measurer import CaptureResult, Failure, Measurer
    from cucumbervision.pipeline.options import MeasureOptions
    from cucumbervision.pipeline.overlay import draw_overlay
    from cucumbervision.pipeline.run import RunResult, measure_inputs

_NAMES = {
    "capture.realsense": "CameraConfig RealSenseCamera",
    "capture.frames": "Capture Stop fuse_burst",
    "capture.intrinsics": "Distortion Intrinsics Stream check_intrinsics",
    "capture.readers": "open_source",
    "capture.source": "CaptureRef CaptureSource ReadOptions",
    "capture.readers.native": "write_native",
    "errors": "CucumberVisionError",
    "measurement.methods": "Region run_methods",
    "measurement.result": (
        "Choice Flag FruitMeasurement Length LengthDefinition LengthKind Measurement Method Reason "
        "Selector"
    ),
    "measurement.selector": "measure_fruit",
    "measurement.traits": "TubeTraits",
    "perception.instances": "Instance MaskSource",
    "perception.sam": "Segmenter",
    "perception.yolo": "YoloDetector",
    "pipeline.detect": "DetectOptions detect_inputs",
    "pipeline.finders": "dataset_instances",
    "pipeline.measurer": "CaptureResult Failure Measurer",
    "pipeline.options": "MeasureOptions",
    "pipeline.overlay": "draw_overlay",
    "pipeline.run": "RunResult measure_inputs",
}
_HOME = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = [
    "CameraConfig",
    "Capture",
    "CaptureRef",
    "CaptureResult",
    "CaptureSource",
    "Choice",
    "CucumberVisionError",
    "DetectOptions",
    "Distortion",
    "Failure",
    "Flag",
    "FruitMeasurement",
    "Instance",
    "Intrinsics",
    "Length",
    "LengthDefinition",
    "LengthKind",
    "MaskSource",
    "MeasureOptions",
    "Measurement",
    "Measurer",
    "Method",
    "ReadOptions",
    "RealSenseCamera",
    "Reason",
    "Region",
    "RunResult",
    "Segmenter",
    "Selector",
    "Stop",
    "Stream",
    "TubeTraits",
    "YoloDetector",
    "__version__",
    "check_intrinsics",
    "dataset_instances",
    "detect_inputs",
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
