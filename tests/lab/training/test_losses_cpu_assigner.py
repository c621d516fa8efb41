from typing import Any

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("ultralytics")

from cucumbervision_lab.training.checkpoint import import_ultralytics  # noqa: E402
from cucumbervision_lab.training.losses import assign_at_half_resolution  # noqa: E402

pytestmark = pytest.mark.train


@pytest.fixture(scope="module")
def heads() -> tuple[list[Any], list[Any]]:
    """Give Ultralytics' own assigners, and the coarse ones in their place."""
    ultralytics = import_ultralytics()
    model = ultralytics.YOLO("yolo26n-seg.yaml").model
    model.args = ultralytics.utils.DEFAULT_CFG
    model.criterion = model.init_criterion()
    losses = [model.criterion.one2many, model.criterion.one2one]
    whole = [loss.assigner for loss in losses]
    assign_at_half_resolution(model)
    return whole, [loss.assigner for loss in losses]


def overlaps_of(assigner: Any, masks: Any, coefficients: Any) -> Any:
    """Ask which of twelve anchors, all right in their boxes, gets the one fruit."""
    box = torch.tensor([[[16.0, 16.0, 48.0, 48.0]]])
    found = box.repeat(1, 12, 1)
    anchors = torch.stack([torch.arange(20.0, 44.0, 2.0), torch.full((12,), 32.0)], dim=1)
    proto = torch.cat([masks.float() * 2 - 1, 1 - masks.float() * 2], dim=1)
    return assigner(
        torch.full((1, 12, 80), 0.5),
        found,
        anchors,
        torch.zeros(1, 1, 1),
        box,
        torch.ones(1, 1, 1),
        pd_coef=coefficients,
        mask_scale=torch.tensor([[0.25]]),
        proto=proto,
        gt_masks=masks,
    )


def test_the_anchor_with_the_better_mask_gets_the_fruit_as_with_whole_masks(
    heads: tuple[list[Any], list[Any]],
) -> None:
    masks = torch.zeros(1, 1, 16, 16, dtype=torch.bool)
    masks[..., 4:12, 4:12] = True
    # The first prototype is the fruit, the second what is not: only the fourth anchor is right.
    coefficients = torch.tensor([[[0.0, 1.0]]]).repeat(1, 12, 1)
    coefficients[0, 3] = torch.tensor([1.0, 0.0])
    for whole, coarse in zip(*heads, strict=True):
        scores = [overlaps_of(a, masks, coefficients)[2][0, :, 0] for a in (whole, coarse)]
        assert scores[0].tolist() == pytest.approx(scores[1].tolist(), abs=1e-4)
        assert int(scores[1].argmax()) == 3
        assert float(scores[1][3]) == pytest.approx(1.0, abs=1e-4)


def test_it_keeps_what_ultralytics_set(heads: tuple[list[Any], list[Any]]) -> None:
    for whole, coarse in zip(*heads, strict=True):
        for name in ("topk", "topk2", "num_classes", "alpha", "beta", "stride"):
            assert getattr(coarse, name) == getattr(whole, name), name
