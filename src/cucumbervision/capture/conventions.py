"""Conventions of captures, without slow imports for the options of the command line."""

from __future__ import annotations

from enum import StrEnum

MASKS = "mask_visib"
"""Folder of a data set's masks, beside the pictures of a capture or of a BOP scene."""


class Stream(StrEnum):
    """The stream that a set of intrinsics was calibrated for."""

    COLOR = "color"
    DEPTH = "depth"


class DepthAlong(StrEnum):
    """Direction in which the values of a depth picture are measured."""

    AXIS = "axis"
    RAY = "ray"
