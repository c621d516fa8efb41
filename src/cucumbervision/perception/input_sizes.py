"""Network input sizes, and the merging of detections from several of them."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from cucumbervision.errors import CucumberVisionError
from cucumbervision.instances.boxes import box_ious
from cucumbervision.instances.instance import TRUSTED_SHARE, Instance

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

DETECTOR_SIZES_PX = (640, 896)
"""Default input sizes of the detectors that are exported here.

At these two, on real photos, scenes on the plant and drawn scenes, more fruit are found and fewer
false positives than at 640 alone, for three times its computing time.
"""

LARGEST_INPUT_PX = 4096
"""Longest side of a network's input: a larger one would take gigabytes."""

_SIZE_STEP_PX = 32


def parse_input_sizes(text: str) -> tuple[int, ...]:
    """Parse the option `--input-size`: one size in pixels, or several to merge.

    Parameters
    ----------
    text : str
        Multiples of 32 up to 4096, joined by commas; empty for the network's own size.

    Returns
    -------
    tuple of int
        Each size once, the smallest first.

    Raises
    ------
    CucumberVisionError
        For anything else.

    Examples
    --------
    >>> parse_input_sizes("1280,640"), parse_input_sizes("")
    ((640, 1280), ())
    """
    parts = [part.strip() for part in text.split(",")] if text.strip() else []
    sizes = {int(part) if part.isdecimal() and len(part) < 6 else 0 for part in parts}
    if not all(0 < size <= LARGEST_INPUT_PX and size % _SIZE_STEP_PX == 0 for size in sizes):
        raise CucumberVisionError(
            f"{text!r} is not an input size",
            source="--input-size",
            remedy=f"give a multiple of {_SIZE_STEP_PX} up to {LARGEST_INPUT_PX}, such as 640, "
            "or several joined by commas",
        )
    return tuple(sorted(sizes))


SAME_IOU = 0.5
"""IoU above which two boxes are the same detection."""


def merge_sizes(by_size: Sequence[Sequence[Instance]]) -> tuple[Instance, ...]:
    """Merge a network's detections at several input sizes, best first.

    The confidence is the mean over the sizes, with 0 for sizes that miss it: a fruit seen at
    one of two sizes gets half its confidence (as in weighted boxes fusion, Solovyev et al., 2021).

    Parameters
    ----------
    by_size : sequence of sequence of Instance
        Detections by size; those of a single size stay as they are.

    Returns
    -------
    tuple of Instance
        Boxes of one class that overlap by an IoU of more than 0.5 are merged: the box is the mean
        weighted by confidence, everything else is from the first size that gives it at least half
        of the best confidence. Boxes that overlap less are merged by their masks, as at one size
        (`merge_instances`).

    Examples
    --------
    >>> small = Instance(np.array([0.0, 0, 100, 20]), 0.6, input_size_px=640)
    >>> large = Instance(np.array([0.0, 0, 96, 20]), 0.9, input_size_px=896)
    >>> (best,) = merge_sizes([[small], [large]])
    >>> best.confidence, best.box.round(1).tolist(), best.input_size_px
    (0.75, [0.0, 0.0, 97.6, 20.0], 640)
    >>> merge_sizes([[small], []])[0].confidence
    0.3
    """
    if len(by_size) < 2:
        return tuple(instance for instances in by_size for instance in instances)
    groups: list[dict[int, Instance]] = []
    finds = [(size, instance) for size, instances in enumerate(by_size) for instance in instances]
    for size, instance in sorted(finds, key=lambda pair: -pair[1].confidence):
        free = [group for group in groups if size not in group]
        firsts = [next(iter(group.values())) for group in free]
        ious = box_ious(
            instance.box[None], np.array([first.box for first in firsts]).reshape(-1, 4)
        )[0]
        ious *= [first.class_name == instance.class_name for first in firsts]
        if ious.size and ious.max() > SAME_IOU:
            free[int(ious.argmax())][size] = instance
        else:
            groups.append({size: instance})
    merged = [_mean_find(group, len(by_size)) for group in groups]
    return tuple(sorted(merged, key=lambda instance: -instance.confidence))


def _mean_find(finds: Mapping[int, Instance], sizes: int) -> Instance:
    confidences = [find.confidence for find in finds.values()]
    box = np.average([find.box for find in finds.values()], axis=0, weights=confidences)
    least_confidence = TRUSTED_SHARE * max(confidences)
    sure = [size for size, find in finds.items() if find.confidence >= least_confidence]
    return replace(finds[min(sure)], box=box, confidence=sum(confidences) / sizes)
