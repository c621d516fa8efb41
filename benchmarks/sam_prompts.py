"""Box, centre point, or both: which prompt draws the better mask.

    python benchmarks/sam_prompts.py DATA_FOLDER... [--model mobile-sam]

Each folder holds captures with masks (BOP's `mask_visib`, for example). A mask's box is the
prompt; SAM's mask is compared with the mask it came from. The networks run in full precision.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from cucumbervision.capture.readers import open_source
from cucumbervision.perception.sam import PROMPTS, Segmenter
from cucumbervision.pipeline.finders import dataset_instances


def overlaps(folder: Path, segmenter: Segmenter) -> tuple[list[float], int]:
    """Return the IoU of every mask of a folder, and how many masks were refused (IoU 0)."""
    found, refused = [], 0
    for reference in open_source(folder):
        capture = reference.load()
        truths = dataset_instances(capture)
        prompts = [replace(one, mask=None, mask_source=None) for one in truths]
        for one, truth in zip(segmenter.segment(capture.color, prompts), truths, strict=True):
            if one.mask is None or truth.mask is None:
                refused += 1
                found.append(0.0)
            else:
                both, either = one.mask & truth.mask, one.mask | truth.mask
                found.append(np.count_nonzero(both) / np.count_nonzero(either))
    return found, refused


def main() -> None:
    """Print a line for each folder and prompt."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--model", default="mobile-sam")
    arguments = parser.parse_args()
    print(f"{'folder':28} {'prompt':10} masks   mean IoU    min IoU  refused")
    for folder in arguments.folders:
        for prompt in PROMPTS:
            segmenter = Segmenter(arguments.model, prompt=prompt, full_precision=True)
            found, refused = overlaps(folder, segmenter)
            numbers = f"{np.mean(found):10.4f} {np.min(found):10.4f} {refused:8}"
            print(f"{folder.name:28} {prompt:10} {len(found):5} {numbers}")


if __name__ == "__main__":
    main()
