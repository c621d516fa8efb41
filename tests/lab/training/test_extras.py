from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

torch = pytest.importorskip("torch")

from cucumbervision_lab.training.extras import ensure_torchvision, nms  # noqa: E402

pytestmark = pytest.mark.train


def test_nms_drops_the_worse_of_two_and_orders_by_score() -> None:
    boxes = torch.tensor([[0.0, 0, 10, 1], [20, 0, 30, 1], [0, 0, 7.5, 1]])
    kept = nms(boxes, torch.tensor([0.5, 0.9, 0.6]), 0.7)
    assert kept.tolist() == [1, 2]
    assert kept.dtype == torch.int64


def test_nms_threshold_is_exclusive_and_empty_input_is_fine() -> None:
    # 5 within 10 overlaps by exactly a half.
    boxes = torch.tensor([[0.0, 0, 10, 1], [0, 0, 5, 1]])
    assert nms(boxes, torch.tensor([0.9, 0.8]), 0.5).tolist() == [0, 1]
    assert nms(boxes, torch.tensor([0.9, 0.8]), 0.49).tolist() == [0]
    assert nms(boxes[:0], torch.tensor([]), 0.5).tolist() == []


def test_torchvision_is_whole_afterwards() -> None:
    pytest.importorskip("cucumbervision_lab.training.extras")
    kind = ensure_torchvision()
    assert ensure_torchvision() == kind
    import torchvision

    boxes = torch.tensor([[0.0, 0, 10, 1], [0, 0, 9, 1]])
    assert torchvision.ops.nms(boxes, torch.tensor([0.5, 0.9]), 0.7).tolist() == [1]
    assert torchvision.transforms.functional.hflip(torch.tensor([[[1, 2]]])).tolist() == [[[2, 1]]]


def test_native_operators_are_left_alone() -> None:
    """In a fresh process: where torchvision imports by itself, nothing of ours is registered."""
    code = (
        "import sys\n"
        "try:\n"
        "    import torchvision\n"
        "    whole = True\n"
        "except RuntimeError:\n"
        "    whole = False\n"
        "from cucumbervision_lab.training.extras import ensure_torchvision\n"
        "print(whole, ensure_torchvision())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={"PYTHONPATH": str(Path(__file__).parents[3] / "src")},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() in (["True", "native"], ["False", "own"])
