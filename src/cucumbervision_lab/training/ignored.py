"""Exclude ignore regions from the training loss.

Ultralytics supports only foreground and background. Ignore regions, such as a heap of fruit that
is not labelled one by one, are stored as outlines in a folder `ignored` next to `labels`. They are
augmented as a second class and removed from the batch before the loss. A prediction inside an
ignore region contributes nothing to the loss unless a fruit is assigned to it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_IGNORED = 1  # class of ignore regions during augmentation; fruit are class 0
_CELL_PX = 4  # cell size of the region map, equal to that of Ultralytics' masks
_NO_FRUIT = -20.0  # a logit with zero loss on background


def add_ignored(dataset: Any, task: str) -> None:
    """Add ignore regions to the labels of a data set, in place.

    Parameters
    ----------
    dataset : ultralytics.data.dataset.YOLODataset
        A data set written by `write_yolo`, which stores the regions next to the labels.
    task : str
        'segment' or 'pose'.
    """
    from cucumbervision_lab.datasets.yolo import label_file

    for label in dataset.labels:
        outlines = read_ignored(label_file(Path(label["im_file"]), "ignored"))
        if not outlines:
            continue
        low = np.array([outline.min(axis=0) for outline in outlines], np.float32)
        high = np.array([outline.max(axis=0) for outline in outlines], np.float32)
        boxes = np.hstack([(low + high) / 2, high - low])
        label["bboxes"] = np.concatenate([label["bboxes"].reshape(-1, 4), boxes])
        new = np.full((len(outlines), 1), _IGNORED, np.float32)
        label["cls"] = np.concatenate([label["cls"].reshape(-1, 1), new])
        if task == "segment":
            label["segments"] = [*label["segments"], *outlines]
        if task == "pose":
            shape = dataset.data["kpt_shape"]
            known = label["keypoints"].reshape(-1, *shape)
            unknown = np.zeros((len(outlines), *shape), np.float32)
            label["keypoints"] = np.concatenate([known, unknown])


def read_ignored(file: Path) -> list[NDArray[np.float32]]:
    """Read the ignore regions of a picture; an empty list if the file does not exist.

    Returns
    -------
    list of ndarray of float32, shape (K, 2)
        Outlines, u and v relative to the picture's width and height.
    """
    if not file.is_file():
        return []
    lines = file.read_text(encoding="utf-8").splitlines()
    return [np.array(line.split(), np.float32).reshape(-1, 2) for line in lines if line.strip()]


def separate_ignored(batch: dict[str, Any]) -> dict[str, Any]:
    """Move ignore regions from a batch's labels to a map.

    Parameters
    ----------
    batch : dict
        A batch of Ultralytics with `img`, `cls`, `bboxes` and `batch_idx`; for poses `keypoints`,
        for segmentation `masks` (instance numbers from 1) and `sem_masks`.

    Returns
    -------
    dict
        The batch with fruit only, and `ignored`: bool, shape (N, height / 4, width / 4). Pixels of
        fruit are False; fruit are given by their masks or, for poses, by their boxes.
    """
    import torch

    height, width = (side // _CELL_PX for side in batch["img"].shape[2:])
    ignored = batch["cls"].view(-1) == _IGNORED
    masks = batch.get("masks")
    region = ignored.new_zeros(len(batch["img"]), height, width)
    if not ignored.any():
        return batch | {"ignored": region}
    own = dict(batch)
    if masks is not None:
        own["masks"], own["sem_masks"] = masks.clone(), torch.zeros_like(batch["sem_masks"])
    for picture in batch["batch_idx"][ignored].unique().long().tolist():
        here = batch["batch_idx"] == picture
        out = ignored[here]
        if masks is None:
            region[picture] = _draw_boxes(batch["bboxes"][here], out, region[picture])
            continue
        # Mask value k + 1 refers to row k: renumber the remaining rows.
        new = torch.where(out, 0, torch.cumsum(~out, 0))
        number = masks[picture].long()
        own["masks"][picture] = torch.cat([new.new_zeros(1), new]).to(masks.dtype)[number]
        region[picture] = torch.cat([out.new_zeros(1), out])[number]
    for key in ("cls", "bboxes", "batch_idx", "keypoints"):
        if key in own:
            own[key] = own[key][~ignored]
    return own | {"ignored": region}


def _draw_boxes(boxes: Any, out: Any, region: Any) -> Any:
    """Draw the ignored boxes (`out`) into a region map, then clear the boxes of fruit."""
    height, width = region.shape
    for wanted in (True, False):
        for cx, cy, w, h in boxes[out == wanted].tolist():
            rows = slice(round(max(cy - h / 2, 0) * height), round((cy + h / 2) * height))
            columns = slice(round(max(cx - w / 2, 0) * width), round((cx + w / 2) * width))
            region[rows, columns] = wanted
    return region


def ignore_regions(loss: Any) -> None:
    """Patch the loss of a head to skip the cells marked in the batch's `ignored` map.

    Parameters
    ----------
    loss : ultralytics.utils.loss.v8DetectionLoss
        Segmentation or pose loss of one head, changed in place. A batch without the map gives the
        original loss.
    """
    import torch

    current: dict[str, Any] = {}
    original_loss, original_bce = loss.loss, loss.bce

    def with_regions(preds: Any, batch: dict[str, Any]) -> Any:
        current["region"] = batch.get("ignored")
        return original_loss(preds, batch)

    def masked_bce(predicted: Any, true: Any) -> Any:
        cost, region = original_bce(predicted, true), current["region"]
        if region is None or not region.any():
            return cost
        cells = [_sample_at_stride(region, int(stride)) for stride in loss.stride]
        skipped = torch.cat(cells, 1).unsqueeze(2) & (true.sum(2, keepdim=True) == 0)
        return cost.masked_fill(skipped, 0.0)

    loss.loss, loss.bce = with_regions, masked_bce
    if not hasattr(loss, "bcedice_loss"):
        return
    original_bcedice = loss.bcedice_loss

    def masked_bcedice(predicted: Any, true: Any) -> Any:
        region = current["region"]
        if region is None or not region.any():
            return original_bcedice(predicted, true)
        size = predicted.shape[-2:]
        hidden = torch.nn.functional.interpolate(region[:, None].float(), size) > 0
        return original_bcedice(predicted.masked_fill(hidden, _NO_FRUIT), true)

    loss.bcedice_loss = masked_bcedice


def _sample_at_stride(region: Any, stride: int) -> Any:
    """Return the region map at the anchor centres of a stride, shape (N, anchors)."""
    step = stride // _CELL_PX
    return region[:, step // 2 :: step, step // 2 :: step].flatten(1)
