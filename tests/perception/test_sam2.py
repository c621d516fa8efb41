"""SAM 2 as a segmenter: with a predictor that draws what it is shown, and with random weights."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cucumbervision.errors import MissingExtraError, ModelError
from cucumbervision.instances.instance import Instance, MaskSource
from cucumbervision.perception.networks import open_segmenter

pytest.importorskip("torch")

PICTURE = np.zeros((60, 100, 3), np.uint8)
FRUIT = Instance(np.array([9.5, 19.5, 69.5, 39.5]))


class Drawing:
    """Stands in for SAM2ImagePredictor: a mask that fills the box, and one beside it."""

    shown: list[dict[str, Any]]
    pictures: int

    def __init__(self, _: object) -> None:
        self.shown, self.pictures = [], 0
        Drawing.last = self

    last: Drawing

    def set_image(self, _: NDArray[np.uint8]) -> None:
        self.pictures += 1

    def predict(self, **prompt: Any) -> tuple[Any, Any, None]:
        self.shown.append(prompt)
        masks = np.zeros((2, 60, 100), np.float32)
        masks[0, 20:40, 10:70] = masks[1, 42:58, 10:70] = 1.0
        return masks, np.array([0.8, 0.9], np.float32), None


@pytest.fixture
def checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    build, predictor = ModuleType("sam2.build_sam"), ModuleType("sam2.sam2_image_predictor")
    build.build_sam2 = lambda config, path, device: (config, path)  # type: ignore[attr-defined]
    predictor.SAM2ImagePredictor = Drawing  # type: ignore[attr-defined]
    for one in (ModuleType("sam2"), build, predictor):
        monkeypatch.setitem(sys.modules, one.__name__, one)
    path = tmp_path / "sam2.1_hiera_tiny.pt"
    path.write_bytes(b"weights")
    return path


def test_the_mask_that_agrees_with_the_detectors_is_taken(checkpoint: Path) -> None:
    own = np.zeros((60, 100), bool)
    own[20:40, 10:70] = True
    segmenter = open_segmenter(str(checkpoint))
    fruit = Instance(FRUIT.box, detector_mask=own)
    (found,) = segmenter.segment(PICTURE, [fruit])
    assert found.mask_source is MaskSource.SAM
    assert found.mask is not None
    assert (found.mask == own).all()
    # Without one, SAM's own favourite, which lies off the box here.
    (other,) = segmenter.segment(PICTURE, [FRUIT])
    assert (other.mask, other.mask_failure) == (None, "mask-off-box")
    assert Drawing.last.pictures == 1
    shown = Drawing.last.shown[0]
    # Its first pixel's corner is (0, 0), and ours its centre.
    assert shown["box"].tolist() == [10.0, 20.0, 70.0, 40.0]
    assert shown["point_coords"].tolist() == [[40.0, 30.0]]


def test_a_pixel_alone_is_shown_as_a_point(checkpoint: Path) -> None:
    segmenter = open_segmenter(str(checkpoint), prompt="box")
    assert segmenter.mask_at(PICTURE, 30, 50)[42:58, 10:70].all()
    assert Drawing.last.shown[0]["point_coords"].tolist() == [[30.5, 50.5]]
    assert Drawing.last.shown[0]["box"] is None
    segmenter.segment(PICTURE, [FRUIT])
    assert Drawing.last.shown[1]["point_coords"] is None


def test_what_is_no_checkpoint_is_named(checkpoint: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ModelError, match="no such file"):
        open_segmenter(str(checkpoint.with_name("sam2_hiera_small.pt")))
    other = checkpoint.rename(checkpoint.with_name("mine.pt"))
    with pytest.raises(ModelError, match="its name says no size"):
        open_segmenter(str(other))
    monkeypatch.setitem(sys.modules, "sam2", None)
    monkeypatch.setitem(sys.modules, "sam2.build_sam", None)
    with pytest.raises(MissingExtraError, match=r"cucumbervision\[sam2\]"):
        open_segmenter(str(other))


def test_random_weights_draw_what_the_predictor_draws(tmp_path: Path) -> None:
    pytest.importorskip("sam2")
    import torch
    from sam2.build_sam import build_sam2
    from sam2.sam2_image_predictor import SAM2ImagePredictor

    torch.manual_seed(1)
    model = build_sam2("configs/sam2.1/sam2.1_hiera_t.yaml", None, device="cpu")
    path = tmp_path / "sam2.1_hiera_tiny.pt"
    torch.save({"model": model.state_dict()}, path)
    rng = np.random.default_rng(1)
    picture = rng.integers(0, 255, (60, 100, 3)).astype(np.uint8)
    segmenter = open_segmenter(str(path))
    drawn = segmenter.mask_at(picture, 30, 30)
    predictor = SAM2ImagePredictor(model)
    predictor.set_image(picture)
    masks, sure, _ = predictor.predict(
        point_coords=np.array([[30.5, 30.5]]), point_labels=np.ones(1, int)
    )
    np.testing.assert_array_equal(drawn, masks[sure.argmax()] > 0)
    (found,) = segmenter.segment(picture, [FRUIT])
    assert (found.mask is None) == bool(found.mask_failure)
    assert segmenter.runtime.startswith("torch-")
