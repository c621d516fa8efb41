"""Which anchors learn which fruit, judged by masks at half the resolution.

Ultralytics scores every candidate by the overlap of its whole mask. On a processor that is a large
part of a step; at half the resolution in each direction it is a small one, and a fruit's mask is
still tens of cells long.
"""

from __future__ import annotations

from typing import Any


def losses_of(model: Any) -> list[Any]:
    """Return the losses of the one-to-many and the one-to-one head, or the only one.

    Parameters
    ----------
    model : ultralytics.nn.tasks.BaseModel
        With or without a criterion; it gets one.
    """
    if getattr(model, "criterion", None) is None:
        model.criterion = model.init_criterion()
    heads = (getattr(model.criterion, name, None) for name in ("one2many", "one2one"))
    return [head for head in heads if head is not None] or [model.criterion]


_FACTOR = 2


def assign_coarsely(model: Any) -> None:
    """Make a segmenting network's loss assign by masks of half the size in both directions.

    The masks that the network learns stay whole: only the choice of the anchors is coarser.

    Parameters
    ----------
    model : ultralytics.nn.tasks.SegmentationModel
        With or without a criterion; it gets one.
    """
    for loss in losses_of(model):
        loss.assigner = _coarse(loss.assigner)


def _coarse(assigner: Any) -> Any:
    from torch.nn.functional import avg_pool2d
    from ultralytics.utils.tal import SegTaskAlignedAssigner

    class Coarse(SegTaskAlignedAssigner):  # type: ignore[misc]
        """Sees masks and prototypes at half the size."""

        def forward(self, *seen: Any, **of_masks: Any) -> Any:
            """Assign; `of_masks` are the prototypes, the true masks and their scale."""
            if "proto" not in of_masks:
                return super().forward(*seen, **of_masks)
            rows = cells = slice(_FACTOR // 2, None, _FACTOR)
            coarse = of_masks | {
                "mask_scale": of_masks["mask_scale"] / _FACTOR,
                "proto": avg_pool2d(of_masks["proto"], _FACTOR),
                "gt_masks": of_masks["gt_masks"][..., rows, cells],
            }
            return super().forward(*seen, **coarse)

    names = ("topk", "topk2", "num_classes", "alpha", "beta", "stride")
    return Coarse(**{name: getattr(assigner, name) for name in names})
