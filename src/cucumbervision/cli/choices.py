"""What options may hold, and exit codes. Apart from where they are defined: imports are slow."""

from __future__ import annotations

from enum import StrEnum

__all__ = [
    "EXIT_CODES",
    "INPUT_SIZE",
    "PromptChoice",
    "RuntimeChoice",
    "SegmenterChoice",
]

EXIT_CODES = (
    "Exit codes: 0 everything was read and written, even if a fruit could not be measured; 1 "
    "something failed (see failures.csv), the rest was done; 2 nothing could be done; 70 a defect "
    "of the software was met, the rest was done; 130 interrupted."
)
"""What commands that work through many captures exit with; shown by their --help."""


INPUT_SIZE = (
    "Long side of what the networks see, pixels: a multiple of 32, or several joined by commas, "
    "whose finds are merged. Without it each network's own."
)
"""Help of `--input-size`."""


class SegmenterChoice(StrEnum):
    """Values of `--segmenter`."""

    mobile_sam = "mobile-sam"
    sam_vit_b = "sam-vit-b"
    none = "none"


class PromptChoice(StrEnum):
    """Values of `--prompt`."""

    both = "box+point"
    box = "box"
    point = "point"


class RuntimeChoice(StrEnum):
    """Values of `--runtime`."""

    auto = "auto"
    onnxruntime = "onnxruntime"
    openvino = "openvino"
    cuda = "cuda"
    tensorrt = "tensorrt"
