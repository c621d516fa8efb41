"""Detections of Supervision and Ultralytics as instances, and back.

Both measure from the picture's corner, `Instance` from the first pixel's centre.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cucumbervision.arrays import Array, Mask, Pixels
from cucumbervision.errors import InstancesError, MissingExtraError
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision.fruit.masks import as_mask

_KEYPOINTS = 5


def from_supervision(detections: Any) -> tuple[Instance, ...]:
    """Return a `supervision.Detections` as instances, in its order.

    Parameters
    ----------
    detections : supervision.Detections
        Boxes, with optional masks, confidences and class names. Masks are measured unchanged;
        instances without a mask are segmented.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> detections = SimpleNamespace(
    ...     xyxy=np.array([[10.0, 20.0, 30.0, 60.0]]), mask=None, confidence=None, data={}
    ... )
    >>> from_supervision(detections)[0].box.tolist()
    [9.5, 19.5, 29.5, 59.5]
    """
    return _instances(
        detections.xyxy, detections.mask, detections.confidence, detections.data.get("class_name")
    )


def to_supervision(instances: Sequence[Instance], **data: Sequence[Any]) -> Any:
    """Return instances as a `supervision.Detections`.

    Parameters
    ----------
    instances : sequence of Instance
        All with a mask, or their masks are left out.
    **data
        Further data of each instance, such as `length_cm`.

    Raises
    ------
    MissingExtraError
        If Supervision is not installed.
    """
    try:
        import supervision
    except ModuleNotFoundError:
        raise MissingExtraError("supervision", "supervision") from None
    masks = _masks_of(instances)
    names = sorted({instance.class_name for instance in instances})
    return supervision.Detections(
        xyxy=_boxes_of(instances),
        mask=masks,
        confidence=np.array([instance.confidence for instance in instances], np.float64),
        class_id=np.array([names.index(instance.class_name) for instance in instances], int),
        data={
            "class_name": np.array([instance.class_name for instance in instances]),
            **{name: np.array(values) for name, values in data.items()},
        },
    )


def from_ultralytics(result: Any) -> tuple[Instance, ...]:
    """Return an `ultralytics.engine.results.Results` as instances, in its order.

    Parameters
    ----------
    result : Results
        Result of one picture. Masks are measured unchanged; instances without a mask are segmented.
        Five keypoints are interpreted as those from blossom to stem end.

    Raises
    ------
    InstancesError
        If its masks are not of the picture's size.
    """
    boxes = result.boxes
    masks = None if result.masks is None else _array(result.masks.data)
    if masks is not None and masks.shape[1:] != tuple(result.orig_shape):
        raise InstancesError(
            f"its masks are {masks.shape[2]}x{masks.shape[1]} pixels, the picture "
            f"{result.orig_shape[1]}x{result.orig_shape[0]}",
            source=str(result.path or "Results"),
            remedy="predict with retina_masks=True",
        )
    points = None if result.keypoints is None else _array(result.keypoints.data)
    if points is not None and points.shape[1:] != (_KEYPOINTS, 3):
        points = None
    names = [result.names[int(kind)] for kind in _array(boxes.cls)]
    return _instances(_array(boxes.xyxy), masks, _array(boxes.conf), names, points)


def to_ultralytics(instances: Sequence[Instance], color_rgb: Pixels) -> Any:
    """Return instances as an `ultralytics.engine.results.Results`.

    Parameters
    ----------
    instances : sequence of Instance
        All with a mask, or their masks are left out.
    color_rgb : ndarray of uint8, shape (H, W, 3)
        The picture.

    Raises
    ------
    MissingExtraError
        If Ultralytics is not installed.
    """
    try:
        import torch
        from ultralytics.engine.results import Results
    except ModuleNotFoundError:
        raise MissingExtraError("ultralytics", "train") from None
    names = dict(enumerate(sorted({instance.class_name for instance in instances})))
    kinds = {name: k for k, name in names.items()}
    rows = [
        [*box, instance.confidence, kinds[instance.class_name]]
        for box, instance in zip(_boxes_of(instances), instances, strict=True)
    ]
    masks = _masks_of(instances)
    return Results(
        np.ascontiguousarray(color_rgb[..., ::-1]),
        path="",
        names=names,
        boxes=torch.tensor(rows, dtype=torch.float64).reshape(-1, 6),
        masks=None if masks is None else torch.from_numpy(masks),
    )


def _instances(
    boxes: Any, masks: Any, confidences: Any, names: Any, keypoints: Array | None = None
) -> tuple[Instance, ...]:
    return tuple(
        Instance(
            np.asarray(box, np.float64) - 0.5,
            1.0 if confidences is None else float(confidences[k]),
            "cucumber" if names is None else str(names[k]),
            mask=None if masks is None else as_mask(np.asarray(masks[k])),
            mask_source=None if masks is None else MaskSource.DETECTOR,
            keypoints=None if keypoints is None else keypoints[k] - [0.5, 0.5, 0.0],
        )
        for k, box in enumerate(boxes)
    )


def _boxes_of(instances: Sequence[Instance]) -> Array:
    return np.array([instance.box for instance in instances], np.float64).reshape(-1, 4) + 0.5


def _masks_of(instances: Sequence[Instance]) -> Mask | None:
    masks = [instance.mask for instance in instances if instance.mask is not None]
    return np.stack(masks) if masks and len(masks) == len(instances) else None


def _array(tensor: Any) -> Array:
    return np.asarray(tensor.cpu() if hasattr(tensor, "cpu") else tensor, np.float64)
