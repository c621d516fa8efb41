"""Measures greenhouse cucumbers without touching them, from RGB-D images.

The public names, which `__init__.pyi` lists; each is loaded when it is first used.

Examples
--------
>>> import cucumbervision
>>> from cucumbervision.capture.source import example_captures
>>> capture = next(iter(cucumbervision.open_source(example_captures()))).load()
>>> measurer = cucumbervision.Measurer(cucumbervision.MeasureOptions(instances="dataset"))
>>> length = measurer.measure(capture).fruit[0].length
>>> f"{capture.name}: {length.value_m:.2f} m ({length.low_m:.2f} to {length.high_m:.2f})"
'simulated-bench: 0.16 m (0.16 to 0.17)'
"""

import os

import lazy_loader

# OpenCV makes room for as much as an image's head promises, up to this; it is read as OpenCV is
# loaded, and `capture.pictures.MOST_PIXELS` is the same.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", "64000000")

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
