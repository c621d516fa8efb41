"""Leave regions to ignore out of the loss.

Ultralytics knows fruit and background only. A heap behind a fruit is neither: its outlines lie in a
folder `ignored` beside `labels`, travel through the augmentation as a second class, and are taken
out of the batch again before the loss. Where no fruit was assigned to a cell of such a region,
whatever is predicted there costs nothing.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_IGNORED = 1  # the class that regions have while they are augmented; fruit are 0
_CELL_PX = 4  # of the map of regions: Ultralytics' masks have this resolution, too
_NO_FRUIT = -20.0  # a logit that costs nothing where no fruit is


def add_ignored(dataset: Any, task: str) -> None:
    """Add the regions to ignore to a data set's labels.

    Parameters
    ----------
    dataset : ultralytics.data.dataset.YOLODataset
        As it was read; `write_yolo` wrote the regions beside its labels.
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
    """Read the outlines of a picture's regions to ignore, none where there is no file.

    Returns
    -------
    list of ndarray of float32, shape (K, 2)
        u and v as shares of the picture's width and height.
    """
    if not file.is_file():
        return []
    lines = file.read_text(encoding="utf-8").splitlines()
    return [np.array(line.split(), np.float32).reshape(-1, 2) for line in lines if line.strip()]


def take_out_ignored(batch: dict[str, Any]) -> dict[str, Any]:
    """Take the regions to ignore out of a batch's labels, and give them as a map.

    Parameters
    ----------
    batch : dict
        Ultralytics', with `img`, `cls`, `bboxes`, `batch_idx` and perhaps `keypoints`, or `masks`
        (numbers of fruit, from 1) and `sem_masks`.

    Returns
    -------
    dict
        With fruit only, and `ignored`: bool, shape (pictures, height / 4, width / 4), without the
        places of fruit, which are their masks or, without masks, their boxes.
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
            region[picture] = _between(batch["bboxes"][here], out, region[picture])
            continue
        # Number k + 1 of the map is row k; the rows that stay are counted anew.
        new = torch.where(out, 0, torch.cumsum(~out, 0))
        number = masks[picture].long()
        own["masks"][picture] = torch.cat([new.new_zeros(1), new]).to(masks.dtype)[number]
        region[picture] = torch.cat([out.new_zeros(1), out])[number]
    for key in ("cls", "bboxes", "batch_idx", "keypoints"):
        if key in own:
            own[key] = own[key][~ignored]
    return own | {"ignored": region}


def _between(boxes: Any, out: Any, region: Any) -> Any:
    """Return the boxes that are `out`, less the others, drawn into a map of the region's shape."""
    height, width = region.shape
    for wanted in (True, False):
        for cx, cy, w, h in boxes[out == wanted].tolist():
            rows = slice(round(max(cy - h / 2, 0) * height), round((cy + h / 2) * height))
            columns = slice(round(max(cx - w / 2, 0) * width), round((cx + w / 2) * width))
            region[rows, columns] = wanted
    return region


def ignore_regions(loss: Any) -> None:
    """Leave out of a head's loss what a batch's map `ignored` marks; without one nothing changes.

    Parameters
    ----------
    loss : ultralytics.utils.loss.v8DetectionLoss
        Of one head, of segmentation or of poses.
    """
    import torch

    current: dict[str, Any] = {}
    whole, score = loss.loss, loss.bce

    def with_regions(preds: Any, batch: dict[str, Any]) -> Any:
        current["region"] = batch.get("ignored")
        return whole(preds, batch)

    def scored(found: Any, true: Any) -> Any:
        cost, region = score(found, true), current["region"]
        if region is None or not region.any():
            return cost
        cells = [_of_stride(region, int(stride)) for stride in loss.stride]
        left_out = torch.cat(cells, 1).unsqueeze(2) & (true.sum(2, keepdim=True) == 0)
        return cost.masked_fill(left_out, 0.0)

    loss.loss, loss.bce = with_regions, scored
    if not hasattr(loss, "bcedice_loss"):
        return
    shaded = loss.bcedice_loss

    def shaded_outside(found: Any, true: Any) -> Any:
        region = current["region"]
        if region is None or not region.any():
            return shaded(found, true)
        size = found.shape[-2:]
        hidden = torch.nn.functional.interpolate(region[:, None].float(), size) > 0
        return shaded(found.masked_fill(hidden, _NO_FRUIT), true)

    loss.bcedice_loss = shaded_outside


def _of_stride(region: Any, stride: int) -> Any:
    """Return what lies at the centres of a stride's cells, shape (pictures, cells)."""
    step = stride // _CELL_PX
    return region[:, step // 2 :: step, step // 2 :: step].flatten(1)
