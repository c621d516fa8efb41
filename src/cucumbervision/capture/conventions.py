"""What the numbers of a capture mean; light enough for the command line's options."""

from __future__ import annotations

from enum import StrEnum


class Stream(StrEnum):
    """The stream that a set of intrinsics was calibrated for."""

    COLOR = "color"
    DEPTH = "depth"


class DepthAlong(StrEnum):
    """Direction in which the values of a depth picture are measured."""

    AXIS = "axis"
    RAY = "ray"
