from __future__ import annotations

import copy
import importlib.util

import pytest

if importlib.util.find_spec("ultralytics") is None:
    pytest.skip("needs the extra 'train'", allow_module_level=True)

from cucumbervision_lab.training.checkpoint import import_ultralytics
from cucumbervision_lab.training.losses import (
    channels_last,
    choose_precision,
    cpu_has_bfloat16,
    disable_bfloat16,
    enable_bfloat16,
)

pytestmark = pytest.mark.train


def test_the_processor_is_asked() -> None:
    assert cpu_has_bfloat16("flags\t: fpu amx_bf16 amx_tile\n")
    assert not cpu_has_bfloat16("flags\t: fpu avx512f avx512_bf16x\n")
    assert not cpu_has_bfloat16("")


def test_precision_is_chosen() -> None:
    assert choose_precision("bf16", "cpu") == "bf16"
    assert choose_precision("auto", "0") == "f32"
    assert choose_precision("auto", "cpu") == ("bf16" if cpu_has_bfloat16() else "f32")


def test_layers_are_narrow_and_all_else_is_wide() -> None:
    import_ultralytics()
    import torch
    from ultralytics.nn.tasks import SegmentationModel

    torch.manual_seed(1)
    plain = SegmentationModel("yolo26n-seg.yaml", nc=1, verbose=False).train()
    half = copy.deepcopy(plain)
    channels_last(half)
    enable_bfloat16(half)
    picture = torch.rand(4, 3, 96, 96)
    seen = []
    half.model[0].conv.register_forward_hook(lambda m, given, out: seen.append(out.dtype))
    wide, narrowed = plain(picture)["one2many"], half(picture)["one2many"]
    assert seen == [torch.bfloat16]
    for key in ("boxes", "scores", "mask_coefficient"):
        assert narrowed[key].dtype == torch.float32
        # bfloat16 keeps 8 bits, and an untrained network's batch norms enlarge the rounding; two
        # networks that have nothing in common are more than one standard deviation apart.
        error = (narrowed[key] - wide[key]).abs().mean() / wide[key].std()
        assert 0 < error.item() < 0.35
    narrowed["scores"].sum().backward()
    first = half.model[0].conv.weight
    assert first.dtype == first.grad.dtype == torch.float32
    disable_bfloat16(half)
    half(picture)
    assert seen[-1] == torch.float32
    assert "predict" not in vars(half)
