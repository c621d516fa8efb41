"""Keypoint training: decreasing OKS sigma, box-aware anchor assignment and visibility.

Ultralytics' YOLO26 assigns anchors by object keypoint similarity (OKS) alone. With the sigma that
length measurement needs, 0.05, an untrained network has an OKS near zero everywhere, so it learns
neither keypoints nor boxes.
"""

from __future__ import annotations

from typing import Any

from cucumbervision.perception.instances import KEYPOINT_NAMES
from cucumbervision_lab.training.checkpoint import require_layers
from cucumbervision_lab.training.cpu import head_losses
from cucumbervision_lab.training.data import KEYPOINT_SIGMA

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
        own = {name: getattr(loss.assigner, name) for name in names}
        # Cloned, so that changing the sigmas of the loss does not change the assigner's.
        loss.assigner = MeanOverlapAssigner(loss.keypoint_loss.sigmas.clone(), **own)


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

    def position_loss(predicted: Any, true: Any, labelled: Any, area: Any) -> Any:
        visibilities[:] = [true[..., 2]]
        return keypoint_loss(predicted, true, labelled, area)

    def visibility_loss(confidence: Any, _: Any) -> Any:
        (visibility,) = visibilities
        known = (visibility > 0).any(dim=1)
        if not known.any():
            return confidence.sum() * 0
        return bce(confidence[known], (visibility[known] > _VISIBLE_ABOVE).float())

    # Ultralytics and `set_keypoint_sigma` read and write the sigmas of the keypoint loss.
    position_loss.sigmas = keypoint_loss.sigmas  # type: ignore[attr-defined]
    position_loss.original = keypoint_loss  # type: ignore[attr-defined]
    loss.keypoint_loss, loss.bce_pose = position_loss, visibility_loss
