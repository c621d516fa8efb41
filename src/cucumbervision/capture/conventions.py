"""Conventions of captures, without slow imports for the options of the command line."""

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
