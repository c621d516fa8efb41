"""What options may hold. Kept apart from the rooms that define them, whose imports are slow."""

from __future__ import annotations

from enum import StrEnum

__all__ = ["LengthChoice", "PromptChoice", "RuntimeChoice", "SegmenterChoice", "SelectorChoice"]


class SelectorChoice(StrEnum):
    """Values of `--selector`."""

    best = "best"
    paper = "paper"


class LengthChoice(StrEnum):
    """Values of `--length`."""

    thread = "thread"
    centreline = "centreline"
    chord = "chord"


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
