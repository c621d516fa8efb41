"""Change the losses of Ultralytics: ignored regions, faster assignment, and the five points.

Ultralytics supports only foreground and background. Ignore regions, such as a heap of fruit that
is not labelled one by one, are stored as outlines in a folder `ignored` next to `labels`. They are
augmented as a second class and removed from the batch before the loss. A prediction inside an
ignore region contributes nothing to the loss unless a fruit is assigned to it.

Ultralytics' YOLO26 assigns anchors by object keypoint similarity (OKS) alone. With the sigma that
length measurement needs, 0.05, an untrained network has an OKS near zero everywhere, so it learns
neither keypoints nor boxes.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cucumbervision.instances.instance import KEYPOINT_NAMES
from cucumbervision_lab.training.checkpoint import require_layers
from cucumbervision_lab.training.data import KEYPOINT_SIGMA

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
        lower = np.array([outline.min(axis=0) for outline in outlines], np.float32)
        upper = np.array([outline.max(axis=0) for outline in outlines], np.float32)
        boxes = np.hstack([(lower + upper) / 2, upper - lower])
        label["bboxes"] = np.concatenate([label["bboxes"].reshape(-1, 4), boxes])
        new = np.full((len(outlines), 1), _IGNORED, np.float32)
        label["cls"] = np.concatenate([label["cls"].reshape(-1, 1), new])
        if task == "segment":
            label["segments"] = [*label["segments"], *outlines]
        if task == "pose":
            shape = dataset.data["kpt_shape"]
            labelled = label["keypoints"].reshape(-1, *shape)
            unknown = np.zeros((len(outlines), *shape), np.float32)
            label["keypoints"] = np.concatenate([labelled, unknown])


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
    separated = dict(batch)
    if masks is not None:
        separated["masks"], separated["sem_masks"] = (
            masks.clone(),
            torch.zeros_like(batch["sem_masks"]),
        )
    for picture in batch["batch_idx"][ignored].unique().long().tolist():
        in_picture = batch["batch_idx"] == picture
        out = ignored[in_picture]
        if masks is None:
            region[picture] = _draw_boxes(batch["bboxes"][in_picture], out, region[picture])
            continue
        # Mask value k + 1 refers to row k: renumber the remaining rows.
        new = torch.where(out, 0, torch.cumsum(~out, 0))
        number = masks[picture].long()
        separated["masks"][picture] = torch.cat([new.new_zeros(1), new]).to(masks.dtype)[number]
        region[picture] = torch.cat([out.new_zeros(1), out])[number]
    for key in ("cls", "bboxes", "batch_idx", "keypoints"):
        if key in separated:
            separated[key] = separated[key][~ignored]
    return separated | {"ignored": region}


def _draw_boxes(boxes: Any, out: Any, region: Any) -> Any:
    """Draw the ignored boxes (`out`) into a region map, then clear the boxes of fruit."""
    height, width = region.shape
    for ignored in (True, False):
        for cx, cy, w, h in boxes[out == ignored].tolist():
            rows = slice(round(max(cy - h / 2, 0) * height), round((cy + h / 2) * height))
            columns = slice(round(max(cx - w / 2, 0) * width), round((cx + w / 2) * width))
            region[rows, columns] = ignored
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

    def masked_bce(predicted: Any, target: Any) -> Any:
        cost, region = original_bce(predicted, target), current["region"]
        if region is None or not region.any():
            return cost
        cells = [_sample_at_stride(region, int(stride)) for stride in loss.stride]
        skipped = torch.cat(cells, 1).unsqueeze(2) & (target.sum(2, keepdim=True) == 0)
        return cost.masked_fill(skipped, 0.0)

    loss.loss, loss.bce = with_regions, masked_bce
    if not hasattr(loss, "bcedice_loss"):
        return
    original_bcedice = loss.bcedice_loss

    def masked_bcedice(predicted: Any, target: Any) -> Any:
        region = current["region"]
        if region is None or not region.any():
            return original_bcedice(predicted, target)
        size = predicted.shape[-2:]
        hidden = torch.nn.functional.interpolate(region[:, None].float(), size) > 0
        return original_bcedice(predicted.masked_fill(hidden, _NO_FRUIT), target)

    loss.bcedice_loss = masked_bcedice


def _sample_at_stride(region: Any, stride: int) -> Any:
    """Return the region map at the anchor centres of a stride, shape (N, anchors)."""
    step = stride // _CELL_PX
    return region[:, step // 2 :: step, step // 2 :: step].flatten(1)


def head_losses(model: Any) -> list[Any]:
    """Return the losses of the one-to-many and one-to-one heads, or the single loss.

    Parameters
    ----------
    model : ultralytics.nn.tasks.BaseModel
        Its criterion is created if missing.
    """
    if getattr(model, "criterion", None) is None:
        model.criterion = model.init_criterion()
    heads = (getattr(model.criterion, name, None) for name in ("one2many", "one2one"))
    return [head for head in heads if head is not None] or [model.criterion]


_FACTOR = 2


def assign_at_half_resolution(model: Any) -> None:
    """Assign anchors with masks of half the height and width.

    The mask loss keeps the full resolution; only the choice of anchors is coarser.

    Parameters
    ----------
    model : ultralytics.nn.tasks.SegmentationModel
        Its criterion is created if missing.
    """
    for loss in head_losses(model):
        loss.assigner = _half_resolution(loss.assigner)


def _half_resolution(assigner: Any) -> Any:
    from torch.nn.functional import avg_pool2d
    from ultralytics.utils.tal import SegTaskAlignedAssigner

    class HalfResolutionAssigner(SegTaskAlignedAssigner):  # type: ignore[misc]
        """Assigner that receives masks and prototypes at half the size."""

        def forward(self, *args: Any, **masks: Any) -> Any:
            """Assign anchors; `masks` has the prototypes, the true masks and their scale."""
            if "proto" not in masks:
                return super().forward(*args, **masks)
            rows = columns = slice(_FACTOR // 2, None, _FACTOR)
            coarse = masks | {
                "mask_scale": masks["mask_scale"] / _FACTOR,
                "proto": avg_pool2d(masks["proto"], _FACTOR),
                "gt_masks": masks["gt_masks"][..., rows, columns],
            }
            return super().forward(*args, **coarse)

    names = ("topk", "topk2", "num_classes", "alpha", "beta", "stride")
    return HalfResolutionAssigner(**{name: getattr(assigner, name) for name in names})


_FLAGS = ("avx512_bf16", "amx_bf16")


def cpu_has_bfloat16(cpuinfo: str | None = None) -> bool:
    """Return whether the CPU supports bfloat16 arithmetic (AVX-512 BF16 or AMX).

    Parameters
    ----------
    cpuinfo : str, optional
        Contents of /proc/cpuinfo; by default, the file is read.

    Returns
    -------
    bool
        False on systems without /proc/cpuinfo.

    Examples
    --------
    >>> cpu_has_bfloat16("flags : sse avx512_bf16")
    True
    """
    if cpuinfo is None:
        path = Path("/proc/cpuinfo")
        cpuinfo = path.read_text(encoding="utf-8") if path.is_file() else ""
    return not set(_FLAGS).isdisjoint(cpuinfo.split())


def choose_precision(requested: str, device: str) -> str:
    """Return the floating-point precision of a training.

    Parameters
    ----------
    requested : str
        'auto', 'f32' or 'bf16'.
    device : str
        'cpu' or a GPU number. On a GPU 'auto' is 'f32': Ultralytics handles mixed precision itself.

    Returns
    -------
    str
        'f32' or 'bf16'.

    Examples
    --------
    >>> choose_precision("f32", "cpu")
    'f32'
    """
    if requested != "auto":
        return requested
    return "bf16" if device == "cpu" and cpu_has_bfloat16() else "f32"


def channels_last(model: Any) -> None:
    """Convert a network's weights to the channels-last memory format, which is faster on CPUs.

    Parameters
    ----------
    model : torch.nn.Module
        Changed in place; its values stay the same. Checkpoints are saved in the default format.
    """
    import torch

    model.to(memory_format=torch.channels_last)


def enable_bfloat16(model: Any) -> None:
    """Run a network's layers in bfloat16 until `disable_bfloat16`.

    Parameters
    ----------
    model : ultralytics.nn.tasks.BaseModel
        A network on the CPU. Weights and the output of `predict` stay float32.
    """
    model.predict = partial(_predict, model)


def disable_bfloat16(model: Any) -> None:
    """Undo `enable_bfloat16`; required before a network is copied or saved."""
    model.__dict__.pop("predict", None)


def _predict(model: Any, *args: Any, **kwargs: Any) -> Any:
    import torch

    with torch.autocast("cpu", torch.bfloat16):
        output = type(model).predict(model, *args, **kwargs)
    return _float32(output)


def _float32(value: Any) -> Any:
    """Convert every bfloat16 tensor in nested lists, tuples and dictionaries to float32."""
    import torch

    if isinstance(value, torch.Tensor):
        return value.float() if value.dtype == torch.bfloat16 else value
    if isinstance(value, dict):
        return {key: _float32(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_float32(item) for item in value)
    return value


_VISIBLE_ABOVE = 1.5  # COCO visibility: 1 is hidden, 2 is visible
_FIRST_FACTOR = 4.0
_CONSTANT_FROM = 0.7


def keypoint_sigma_at(progress: float) -> float:
    """Return the OKS sigma of the keypoints during training.

    Sigma decreases exponentially from 0.2, Ultralytics' default for five points, to 0.05, and
    stays constant over the last 30 % of the plan.

    Parameters
    ----------
    progress : float
        Completed share of the plan, 0 to 1.

    Examples
    --------
    >>> [round(keypoint_sigma_at(t), 3) for t in (0.0, 0.35, 0.7, 1.0)]
    [0.2, 0.1, 0.05, 0.05]
    """
    return float(KEYPOINT_SIGMA * _FIRST_FACTOR ** max(0.0, 1.0 - progress / _CONSTANT_FROM))


def order_by_position(keypoints: Any, width: float, height: float) -> Any:
    """Order the keypoints of every fruit by their position in the picture.

    Telling the stem end from the blossom end takes hours of training. Until then, a network
    regresses the mean of both orders, which is the centre of the fruit. Ordering by position
    removes the ambiguity. The order flips for fruit along the falling diagonal, which are rare:
    most fruit hang or lie level.

    Parameters
    ----------
    keypoints : torch.Tensor, shape (N, 5, 3)
        x and y relative to the picture size, and visibility (0 is not labelled).
    width, height : float
        Size of the picture, pixels.

    Returns
    -------
    torch.Tensor, shape (N, 5, 3)
        The last keypoint is further right and up than the first. A fruit with a single labelled
        keypoint loses it, because its index is ambiguous.

    Examples
    --------
    >>> import torch
    >>> hanging = torch.tensor([[[0.5, 0.1 * k, 2.0] for k in range(1, 6)]])
    >>> order_by_position(hanging, 640, 640)[0, :, 1].tolist()[0], hanging[0, 0, 1].item()
    (0.5, 0.10000000149011612)
    """
    import torch

    labelled = keypoints[..., 2] > 0
    count = labelled.shape[1]
    numbers = torch.arange(count, device=keypoints.device)
    first = torch.where(labelled, numbers, count).amin(dim=1).clamp(max=count - 1)
    last = torch.where(labelled, numbers, -1).amax(dim=1).clamp(min=0)
    rows = torch.arange(len(keypoints), device=keypoints.device)
    along = keypoints[rows, last] - keypoints[rows, first]
    falls = along[:, 0] * width - along[:, 1] * height < 0
    ordered = torch.where(falls[:, None, None], keypoints.flip(1), keypoints)
    alone = labelled.sum(dim=1) < 2
    return torch.where(alone[:, None, None], torch.zeros_like(ordered), ordered)


def has_keypoint_head(weights: str) -> bool:
    """Return whether a checkpoint's network has a head for five keypoints.

    Parameters
    ----------
    weights : str
        Path of a .pt file that Ultralytics can load; False for a .yaml.
    """
    if not weights.endswith(".pt"):
        return False
    from ultralytics.nn.tasks import load_checkpoint

    require_layers(weights)
    network, _ = load_checkpoint(weights)
    shape = getattr(network.model[-1], "kpt_shape", (0,))
    return int(shape[0]) == len(KEYPOINT_NAMES)


def set_keypoint_sigma(model: Any, sigma: float) -> None:
    """Set the OKS sigma of all keypoints in the loss and in anchor assignment.

    Parameters
    ----------
    model : ultralytics.nn.tasks.PoseModel
        A network after `assign_by_boxes_and_keypoints` and `learn_visibility`.
    sigma : float
        Standard deviation in object keypoint similarity.
    """
    for loss in head_losses(model):
        keypoint_loss = getattr(loss.keypoint_loss, "original", loss.keypoint_loss)
        keypoint_loss.sigmas.fill_(sigma)
        loss.assigner.sigmas.fill_(sigma)


def assign_by_boxes_and_keypoints(model: Any) -> None:
    """Assign anchors by the mean of box overlap and object keypoint similarity.

    Ultralytics does the same with boxes and masks. Keypoints alone are uninformative until they
    are nearly correct.

    Parameters
    ----------
    model : ultralytics.nn.tasks.PoseModel
        Its criterion is created if missing.
    """
    from ultralytics.utils.tal import PoseTaskAlignedAssigner, TaskAlignedAssigner

    class MeanOverlapAssigner(PoseTaskAlignedAssigner):  # type: ignore[misc]
        """Assigner whose overlap is the mean of box and keypoint overlap."""

        # Ultralytics selects the pyramid level by area, because keypoints have no extent. Boxes
        # have one, and a long thin fruit is larger than its area suggests.
        select_candidates_in_gts = TaskAlignedAssigner.select_candidates_in_gts

        def pair_overlaps(
            self, indices: Any, gt_bboxes: Any, pd_bboxes: Any, pd_kpts: Any, gt_kpts: Any
        ) -> Any:
            """Return the overlap of each candidate anchor."""
            points = super().pair_overlaps(indices, gt_bboxes, pd_bboxes, pd_kpts, gt_kpts)
            boxes = TaskAlignedAssigner.pair_overlaps(self, indices, gt_bboxes, pd_bboxes)
            return (points + boxes) / 2

    names = ("topk", "topk2", "num_classes", "alpha", "beta", "stride")
    for loss in head_losses(model):
        settings = {name: getattr(loss.assigner, name) for name in names}
        # Cloned, so that changing the sigmas of the loss does not change the assigner's.
        loss.assigner = MeanOverlapAssigner(loss.keypoint_loss.sigmas.clone(), **settings)


def learn_visibility(model: Any) -> None:
    """Train keypoint confidence to separate visible from hidden keypoints.

    Ultralytics separates labelled from unlabelled keypoints, so a hidden end with a labelled
    position would count as visible. Fruit without labelled keypoints do not contribute.
    """
    for loss in head_losses(model):
        _patch_visibility_loss(loss)


def _patch_visibility_loss(loss: Any) -> None:
    keypoint_loss, bce = loss.keypoint_loss, loss.bce_pose
    # The position loss is always called before the confidence loss and receives visibility.
    visibilities: list[Any] = []

    def position_loss(predicted: Any, target: Any, labelled: Any, area: Any) -> Any:
        visibilities[:] = [target[..., 2]]
        return keypoint_loss(predicted, target, labelled, area)

    def visibility_loss(confidence: Any, _: Any) -> Any:
        (visibility,) = visibilities
        visible = (visibility > 0).any(dim=1)
        if not visible.any():
            return confidence.sum() * 0
        return bce(confidence[visible], (visibility[visible] > _VISIBLE_ABOVE).float())

    # Ultralytics and `set_keypoint_sigma` read and write the sigmas of the keypoint loss.
    position_loss.sigmas = keypoint_loss.sigmas  # type: ignore[attr-defined]
    position_loss.original = keypoint_loss  # type: ignore[attr-defined]
    loss.keypoint_loss, loss.bce_pose = position_loss, visibility_loss
