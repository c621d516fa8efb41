from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import ModelError
from cucumbervision.instances.instance import Instance
from cucumbervision.perception.crops import CROP_PX, CropClassifier, crop_square, lowered
from cucumbervision.perception.networks import NetworkLoader
from cucumbervision.perception.registry import load_registry

REGISTRY = load_registry(user=Path("/nowhere"))


def test_a_crop_is_centred_on_the_box_and_keeps_its_shape() -> None:
    picture = np.zeros((100, 200, 3), np.uint8)
    picture[40:60, 80:120] = 255  # 40 x 20 px about (100, 50)
    crop = crop_square(picture, np.array([79.5, 39.5, 119.5, 59.5]), side_px=80, margin=2.0)
    rows, columns = np.nonzero(crop[..., 0] > 127)
    # The square is 80 px wide: nothing is resized.
    assert (columns.min(), columns.max(), rows.min(), rows.max()) == (20, 59, 30, 49)


def test_what_lies_outside_the_picture_is_grey() -> None:
    picture = np.full((50, 50, 3), 255, np.uint8)
    crop = crop_square(picture, np.array([-0.5, -0.5, 9.5, 9.5]), side_px=20, margin=2.0)
    assert (crop[:5] == 114).all()
    assert (crop[:, :5] == 114).all()
    assert (crop[5:, 5:] == 255).all()


@pytest.mark.parametrize("box", [[3.0, 3, 3, 3], [49.2, 20, 49.5, 49.5], [-0.5, -0.5, 49.5, 49.5]])
def test_any_box_in_the_picture_has_a_crop(box: list[float]) -> None:
    crop = crop_square(np.zeros((50, 50, 3), np.uint8), np.array(box))
    assert crop.shape == (CROP_PX, CROP_PX, 3)


def test_a_confidence_is_never_raised() -> None:
    assert lowered(0.3, 5.0) == 0.3
    # logit(0.5) = 0, so that 0.7 * -10 / 7 = -1 is left: 1 / (1 + e)
    assert lowered(0.5, -10 / 7) == pytest.approx(1 / (1 + np.e))
    assert 0 < lowered(1.0, -4.0) < 1
    assert lowered(0.0, -4.0) == pytest.approx(0, abs=1e-6)


def test_the_packages_network_keeps_drawn_fruit_and_drops_a_grey_bar() -> None:
    classifier = CropClassifier(REGISTRY.resolve("cucumber-crops")["network"])
    loader = NetworkLoader(REGISTRY)
    plain = loader.yolo(REGISTRY.resolve("cucumber-seg")["network"])
    color = next(iter(open_source(example_captures()))).load().color
    fruit = plain.detect(color)
    assert fruit
    kept = classifier.rescore(color, fruit)
    assert [one.confidence for one in kept] == sorted((o.confidence for o in kept), reverse=True)
    assert max(one.confidence for one in kept) == pytest.approx(fruit[0].confidence, abs=0.2)
    bar = np.full((200, 200, 3), 90, np.uint8)
    bar[90:110, 20:180] = 160
    (lower,) = classifier.rescore(bar, [Instance(np.array([19.5, 89.5, 179.5, 109.5]), 0.5)])
    assert lower.confidence < 0.3
    assert classifier.rescore(bar, []) == ()


def test_the_registrys_detector_takes_a_second_look_and_a_users_file_does_not() -> None:
    loader = NetworkLoader(REGISTRY)
    assert loader.yolo("cucumber-seg").crops is not None
    assert {"cucumber-seg", "cucumber-crops"} == {model["name"] for model in loader.models}
    assert loader.yolo(REGISTRY.resolve("cucumber-seg")["network"]).crops is None


def test_another_kind_of_network_is_refused() -> None:
    with pytest.raises(ModelError, match=f"not crops of {CROP_PX} px"):
        CropClassifier(REGISTRY.resolve("cucumber-ends")["network"])
