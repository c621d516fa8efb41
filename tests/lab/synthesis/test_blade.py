from __future__ import annotations

import numpy as np

from cucumbervision_lab.synthesis.assets import Assets
from cucumbervision_lab.synthesis.blade import blade_level, blade_photo, blade_pixel, blade_texture


def test_a_blade_has_veins_and_an_even_tone() -> None:
    blade = blade_texture(3)
    tone, vein = blade[..., 0], blade[..., 1]
    assert blade.shape == (192, 192, 4)
    assert abs(tone.mean() - 1) < 0.12
    assert 0.05 < (vein > 0.5).mean() < 0.35
    # The middle vein runs from the stalk to the tip, through the texture's middle row.
    assert vein[92:100, 60:150].max(axis=0).mean() > 0.8
    assert not np.array_equal(blade, blade_texture(4))


def test_a_place_on_the_blade_finds_its_pixel() -> None:
    # The middle lies between pixels 95 and 96; 1.3 half axes away is the texture's rim.
    place = np.array([0.0, -1.3, 1.3], np.float32)
    assert np.allclose(blade_pixel(place), [95.5, -0.5, 191.5], atol=1e-4)


def test_a_piece_of_a_photo_keeps_its_drawing_not_its_colour() -> None:
    rng = np.random.default_rng(1)
    leaf = rng.integers(60, 120, (300, 400, 3), dtype=np.uint8)
    piece, *_, coarse = blade_photo(rng, Assets(leaves=(leaf,)))
    assert piece.shape == (192, 192, 3)
    assert np.allclose(piece.mean(axis=(0, 1)), 1.0, atol=0.12)
    assert piece.std() > 0.05
    assert coarse.std() < 0.5 * piece.std()
    assert blade_photo(rng, Assets()) == ()


def test_a_small_leaf_gets_a_coarse_drawing() -> None:
    # 192 pixels over 2.6 half axes are 74 a half axis; with 18 the texture is four times too fine.
    level = blade_level(18.5)
    assert level == 2
    fine, coarse = (np.abs(np.diff(blade_texture(1, k)[..., 1])).mean() for k in (0, level))
    assert coarse < 0.6 * fine
