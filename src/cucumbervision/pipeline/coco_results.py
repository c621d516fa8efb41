"""Detections as COCO writes them: results, and the pictures and classes that they speak of.

COCO measures from the picture's corner (the first pixel covers 0 to 1), `Instance` from the first
pixel's centre: half a pixel is added. Source: the results format of cocodataset.org, and
`COCO.loadRes` of pycocotools.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.perception.instances import KEYPOINT_NAMES, SKELETON
from cucumbervision.perception.masks import encode_rle

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from cucumbervision.perception.instances import Instance

__all__ = ["coco_categories", "coco_results", "results_text"]


def coco_results(
    instances: Sequence[Instance],
    image_id: int,
    file_name: str,
    categories: Mapping[str, int],
    *,
    keypoints: bool,
) -> list[dict[str, Any]]:
    """Return one picture's detections as entries of `results.json`.

    Parameters
    ----------
    instances : sequence of Instance
        In the original's pixels.
    image_id : int
        The picture's number in `images.json`.
    file_name : str
        Its name there.
    categories : mapping of str to int
        Numbers of the classes.
    keypoints : bool
        Whether a pose network took part: COCO's tools then expect keypoints of every entry, and
        a fruit without has zeros.

    Returns
    -------
    list of dict
        `bbox` as x, y, width, height; `segmentation` as compressed run lengths, where there is a
        mask; `keypoints` as x, y and visibility 0 to 1 of the five.

    Examples
    --------
    >>> from cucumbervision.perception.instances import Instance
    >>> mask = np.array([[0, 1, 0], [1, 0, 0]], bool)
    >>> fruit = Instance(np.array([-0.5, -0.5, 1.5, 1.5]), 0.9, mask=mask)
    >>> entry, = coco_results([fruit], 7, "a.jpg", {"cucumber": 1}, keypoints=False)
    >>> entry["bbox"], entry["segmentation"]
    ([0.0, 0.0, 2.0, 2.0], {'size': [2, 3], 'counts': '123'})
    """
    return [
        _entry(one, image_id, file_name, categories[one.class_name], keypoints=keypoints)
        for one in instances
    ]


def coco_categories(labels: Sequence[str]) -> list[dict[str, Any]]:
    """Return the classes, numbered from 1, with the five keypoints' names.

    Examples
    --------
    >>> [(c["id"], c["name"]) for c in coco_categories(["cucumber"])]
    [(1, 'cucumber')]
    """
    skeleton = [[a + 1, b + 1] for a, b in SKELETON]
    return [
        {"id": k, "name": label, "keypoints": list(KEYPOINT_NAMES), "skeleton": skeleton}
        for k, label in enumerate(labels, start=1)
    ]


def results_text(entries: Sequence[Mapping[str, Any]]) -> str:
    """Write entries as JSON, one a line.

    Examples
    --------
    >>> results_text([{"image_id": 1}, {"image_id": 2}]).splitlines()
    ['[', '{"image_id": 1},', '{"image_id": 2}', ']']
    """
    lines = ",\n".join(json.dumps(entry, ensure_ascii=False) for entry in entries)
    return f"[\n{lines}\n]\n" if entries else "[]\n"


def _entry(
    one: Instance, image_id: int, file_name: str, category_id: int, *, keypoints: bool
) -> dict[str, Any]:
    x1, y1, x2, y2 = (float(edge) for edge in one.box)
    box = [x1 + 0.5, y1 + 0.5, x2 - x1, y2 - y1]
    entry: dict[str, Any] = {
        "image_id": image_id,
        "file_name": file_name,
        "category_id": category_id,
        "bbox": [round(value, 3) for value in box],
        "score": round(one.confidence, 5),
    }
    mask = one.detector_mask if one.mask is None else one.mask
    if mask is not None:
        entry["segmentation"] = {"size": list(mask.shape), "counts": encode_rle(mask)}
        entry["mask_source"] = str(one.mask_source or "detector")
    if keypoints:
        points = np.zeros((len(KEYPOINT_NAMES), 3))
        if one.keypoints is not None:
            points = one.keypoints + np.array([0.5, 0.5, 0.0])
        entry["keypoints"] = [round(value, 3) for value in points.ravel().tolist()]
        entry["num_keypoints"] = int(np.count_nonzero(points[:, 2]))
    return entry
