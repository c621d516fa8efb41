"""From a camera, a recording or a folder to one clean RGB-D frame."""

from enum import StrEnum

# Here, since options of the command line name them and load no NumPy.


class Stream(StrEnum):
    """The stream that a set of intrinsics was calibrated for."""

    COLOR = "color"
    DEPTH = "depth"


class DepthAlong(StrEnum):
    """Direction in which the values of a depth image are measured."""

    AXIS = "axis"
    RAY = "ray"
