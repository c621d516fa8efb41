from __future__ import annotations

import numpy as np
import pytest

from cucumbervision_lab.scenes.appearance import Assets
from cucumbervision_lab.scenes.colors import sample, smooth_noise, to_linear
from cucumbervision_lab.scenes.textures import (
    MATERIALS,
    far_view,
    leaf_photo_texture,
    leaf_texture,
    material_color,
    material_tile,
)


def test_linear_light_follows_the_standard() -> None:
    # IEC 61966-2-1 by hand: 10 / 255 is on the straight part, 188 / 255 on the curve.
    expected = [10 / 255 / 12.92, ((188 / 255 + 0.055) / 1.055) ** 2.4]
    assert np.allclose(to_linear([10, 188]), expected, atol=1e-6)
    assert np.allclose(to_linear(np.array([10, 188], np.uint8)), expected, atol=1e-6)


def test_noise_goes_over_its_seam_as_smoothly_as_anywhere() -> None:
    noise = smooth_noise(np.random.default_rng(3), (64, 120), (10.0, 12.0), wrap=True)
    steps = np.abs(np.diff(noise, axis=1)).mean(axis=0)
    assert noise.shape == (64, 120)
    assert np.abs(noise[:, 0] - noise[:, -1]).mean() < 1.2 * steps.max()
    plain = smooth_noise(np.random.default_rng(3), (64, 120), (10.0, 12.0))
    assert np.abs(plain[:, 0] - plain[:, -1]).mean() > 2 * steps.max()


def test_sampling_lies_between_pixels_and_repeats() -> None:
    texture = np.arange(12, dtype=np.float32).reshape(3, 4)
    x, y = np.array([1.5, 1.0, 5.0], np.float32), np.array([0.0, 1.5, 1.0], np.float32)
    assert sample(texture, x, y).tolist() == [1.5, 7.0, 5.0]
    colors = np.dstack([texture, 2 * texture])
    assert sample(colors, x, y).tolist() == [[1.5, 3.0], [7.0, 14.0], [5.0, 10.0]]
    many = sample(texture, np.zeros(40_000, np.float32), np.ones(40_000, np.float32))
    assert many.shape == (40_000,)
    assert (many == 4.0).all()


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


def test_a_photo_far_away_is_a_piece_of_it() -> None:
    # Red rises to the right, so it does in any piece, or falls where that is mirrored.
    picture = np.zeros((200, 300, 3), np.uint8)
    picture[..., 0] = np.linspace(50, 250, 300).astype(np.uint8)
    view = far_view(np.random.default_rng(2), "photo", 64, 48, Assets(backgrounds=(picture,)))
    steps = np.diff(view[..., 0].mean(axis=0))
    assert view.shape == (48, 64, 3)
    assert (steps > 0).all() or (steps < 0).all()
    assert view[..., 1].max() == 0
