from __future__ import annotations

import numpy as np
import pytest

from cucumbervision_lab.scenes.colors import to_linear
from cucumbervision_lab.scenes.textures import (
    MATERIALS,
    Assets,
    leaf_photo_texture,
    leaf_texture,
    material_color,
    material_tile,
)


def test_a_blade_has_veins_and_an_even_tone() -> None:
    blade = leaf_texture(3)
    tone, vein = blade[..., 0], blade[..., 1]
    assert blade.shape == (192, 192, 4)
    assert abs(tone.mean() - 1) < 0.12
    assert 0.05 < (vein > 0.5).mean() < 0.35
    # The middle vein runs from the stalk to the tip, through the texture's middle row.
    assert vein[92:100, 60:150].max(axis=0).mean() > 0.8
    assert not np.array_equal(blade, leaf_texture(4))


def test_a_piece_of_a_photo_keeps_its_drawing_not_its_colour() -> None:
    rng = np.random.default_rng(1)
    leaf = rng.integers(60, 120, (300, 400, 3), dtype=np.uint8)
    piece, *_, coarse = leaf_photo_texture(rng, Assets(leaves=(leaf,)))
    assert piece.shape == (192, 192, 3)
    assert np.allclose(piece.mean(axis=(0, 1)), 1.0, atol=0.12)
    assert piece.std() > 0.05
    assert coarse.std() < 0.5 * piece.std()
    assert leaf_photo_texture(rng, Assets()) == ()


@pytest.mark.parametrize("material", MATERIALS)
def test_a_material_has_its_colour(material: str) -> None:
    rng = np.random.default_rng(1)
    color = material_color(rng, material)
    tile = material_tile(rng, material, color)
    assert tile.shape == (512, 512, 3)
    assert tile.dtype == np.float32
    assert 0 < tile.min() <= tile.max() < 1
    expected = to_linear(color)
    assert np.allclose(tile.mean(axis=(0, 1)), expected, rtol=0.35, atol=0.01)
