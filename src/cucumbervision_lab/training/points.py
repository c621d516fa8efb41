"""How a network learns the five points: the tolerance narrows, and visibility is learnt too.

Ultralytics' YOLO26 chooses the anchors that learn a fruit by the similarity of its points (OKS)
alone. With the tolerance that a length needs, 0.05, a network that does not know the points yet
scores nothing anywhere, and learns neither points nor boxes.
"""

from __future__ import annotations

from typing import Any

from cucumbervision.perception.instances import KEYPOINT_NAMES
from cucumbervision_lab.training.checkpoint import require_layers
from cucumbervision_lab.training.cpu import losses_of
from cucumbervision_lab.training.data import KEYPOINT_SIGMA

_HIDDEN = 1.5  # COCO: 1 is hidden, 2 seen
_KINDEST = 4.0
_STRICT_FROM = 0.7


def tolerance_at(progress: float) -> float:
    """Return the keypoints' tolerance (OKS sigma) while learning.

    It falls evenly in its logarithm from 0.2, Ultralytics' own for five points, to the 0.05 that
    is asked for, which holds for the last three tenths. A network that knows the points already
    begins there.

    Parameters
    ----------
    progress : float
        Share of the plan that is through, 0 to 1.

    Examples
    --------
    >>> [round(tolerance_at(t), 3) for t in (0.0, 0.35, 0.7, 1.0)]
    [0.2, 0.1, 0.05, 0.05]
    """
    return float(KEYPOINT_SIGMA * _KINDEST ** max(0.0, 1.0 - progress / _STRICT_FROM))


def order_by_place(keypoints: Any, width: float, height: float) -> Any:
    """Order every fruit's points by where they lie in the picture.

    Which of a cucumber's ends is the stem's takes a network hours to see; meanwhile it learns the
    mean of both answers, and the points nowhere. Ordered by place there is one answer. The order
    changes where a fruit lies along the falling diagonal, which few do: most hang or lie level.

    Parameters
    ----------
    keypoints : torch.Tensor, shape (N, 5, 3)
        x, y as shares of the picture, and visibility; 0 is not labelled.
    width, height : float
        Of the picture, pixels.

    Returns
    -------
    torch.Tensor, shape (N, 5, 3)
        The last point further right and up than the first. A fruit with only one labelled point
        has none any more: nothing says which it is.

    Examples
    --------
    >>> import torch
    >>> hanging = torch.tensor([[[0.5, 0.1 * k, 2.0] for k in range(1, 6)]])
    >>> order_by_place(hanging, 640, 640)[0, :, 1].tolist()[0], hanging[0, 0, 1].item()
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


def knows_points(weights: str) -> bool:
    """Return whether a checkpoint's network was trained for the five points already.

    Parameters
    ----------
    weights : str
        A .pt file that Ultralytics can load; a .yaml knows nothing.
    """
    if not weights.endswith(".pt"):
        return False
    from ultralytics.nn.tasks import load_checkpoint

    require_layers(weights)
    network, _ = load_checkpoint(weights)
    shape = getattr(network.model[-1], "kpt_shape", (0,))
    return int(shape[0]) == len(KEYPOINT_NAMES)


def set_tolerance(model: Any, sigma: float) -> None:
    """Set the tolerance with which loss and assignment judge all points.

    Parameters
    ----------
    model : ultralytics.nn.tasks.PoseModel
        After `learn_to_assign` and `learn_to_see`.
    sigma : float
        Of the object keypoint similarity.
    """
    for loss in losses_of(model):
        located = getattr(loss.keypoint_loss, "located", loss.keypoint_loss)
        located.sigmas.fill_(sigma)
        loss.assigner.sigmas.fill_(sigma)


def learn_to_assign(model: Any) -> None:
    """Choose anchors by the mean of the box's overlap and the points' similarity.

    It is what Ultralytics does with boxes and masks; the points alone say nothing until they are
    nearly right.

    Parameters
    ----------
    model : ultralytics.nn.tasks.PoseModel
        With or without a criterion; it gets one.
    """
    from ultralytics.utils.tal import PoseTaskAlignedAssigner, TaskAlignedAssigner

    class MeanOverlapAssigner(PoseTaskAlignedAssigner):  # type: ignore[misc]
        """Its overlap is the mean of two."""

        # Ultralytics lets a fruit's area choose the level: the points have no scale of their own.
        # Boxes have one, and a long thin fruit is larger than its area says.
        select_candidates_in_gts = TaskAlignedAssigner.select_candidates_in_gts

        def pair_overlaps(
            self, indices: Any, gt_bboxes: Any, pd_bboxes: Any, pd_kpts: Any, gt_kpts: Any
        ) -> Any:
            """Return the overlap of each candidate."""
            points = super().pair_overlaps(indices, gt_bboxes, pd_bboxes, pd_kpts, gt_kpts)
            boxes = TaskAlignedAssigner.pair_overlaps(self, indices, gt_bboxes, pd_bboxes)
            return (points + boxes) / 2

    names = ("topk", "topk2", "num_classes", "alpha", "beta", "stride")
    for loss in losses_of(model):
        own = {name: getattr(loss.assigner, name) for name in names}
        # A tensor of its own: the loss may change its tolerance apart.
        loss.assigner = MeanOverlapAssigner(loss.keypoint_loss.sigmas.clone(), **own)


def learn_to_see(model: Any) -> None:
    """Train a keypoint's confidence to tell points that are seen from points that are hidden.

    Ultralytics' tells labelled points from others: a hidden end whose place is labelled would look
    like a seen one. A fruit none of whose points is labelled teaches nothing of them.
    """
    for loss in losses_of(model):
        _judge_seen(loss)


def _judge_seen(loss: Any) -> None:
    located, judged = loss.keypoint_loss, loss.bce_pose
    # The loss asks for the place first, with all that is labelled, then for the confidence.
    truth: list[Any] = []

    def locate(found: Any, true: Any, labelled: Any, area: Any) -> Any:
        truth[:] = [true[..., 2]]
        return located(found, true, labelled, area)

    def judge(confidence: Any, _: Any) -> Any:
        (visibility,) = truth
        known = (visibility > 0).any(dim=1)
        if not known.any():
            return confidence.sum() * 0
        return judged(confidence[known], (visibility[known] > _HIDDEN).float())

    # Others ask the one for its tolerances, and set them.
    locate.sigmas = located.sigmas  # type: ignore[attr-defined]
    locate.located = located  # type: ignore[attr-defined]
    loss.keypoint_loss, loss.bce_pose = locate, judge
