from __future__ import annotations

import numpy as np
import pytest

from cucumbervision_lab.synthesis.appearance import Assets
from cucumbervision_lab.synthesis.colors import (
    jitter,
    mix,
    sample,
    scale_colors,
    smooth_noise,
    smoothstep,
    to_linear,
    to_srgb,
)
from cucumbervision_lab.synthesis.textures import (
    MATERIALS,
    far_view,
    leaf_level,
    leaf_photo_texture,
    leaf_texel,
    leaf_texture,
    material_color,
    material_tile,
)


def test_linear_light_and_back_gives_the_same_srgb() -> None:
    values = np.arange(256, dtype=np.uint8)
    back = to_srgb(to_linear(values)).astype(int)
    # 4096 levels are coarser than sRGB only in the darkest tones.
    assert np.abs(back - values).max() <= 1
    assert (back[8:] == values[8:]).mean() > 0.95


def test_linear_light_follows_the_standard() -> None:
    # IEC 61966-2-1 by hand: 10 / 255 is on the straight part, 188 / 255 on the curve.
    expected = [10 / 255 / 12.92, ((188 / 255 + 0.055) / 1.055) ** 2.4]
    assert np.allclose(to_linear([10, 188]), expected, atol=1e-6)
    assert np.allclose(to_linear(np.array([10, 188], np.uint8)), expected, atol=1e-6)


def test_colours_mix_and_dim_place_by_place() -> None:
    picture = np.arange(12, dtype=np.float32).reshape(2, 2, 3)
    share = np.array([[0.0, 0.5], [0.25, 1.0]], np.float32)
    expected = picture + share[..., None] * (np.array([8.0, 0.0, 4.0]) - picture)
    assert np.allclose(mix(picture, (8.0, 0.0, 4.0), share), expected)
    assert np.allclose(mix((8.0, 0.0, 4.0), picture, 1 - share), expected)
    assert np.allclose(scale_colors(picture, share), picture * share[..., None])


def test_smoothstep_falls_where_the_limits_are_swapped() -> None:
    assert smoothstep(2.0, 0.0, np.array([0.0, 1.0, 2.0])).tolist() == [1.0, 0.5, 0.0]


def test_noise_goes_over_its_seam_as_smoothly_as_anywhere() -> None:
    noise = smooth_noise(np.random.default_rng(3), (64, 120), (10.0, 12.0), wrap=True)
    steps = np.abs(np.diff(noise, axis=1)).mean(axis=0)
    assert noise.shape == (64, 120)
    assert np.abs(noise[:, 0] - noise[:, -1]).mean() < 1.2 * steps.max()
    plain = smooth_noise(np.random.default_rng(3), (64, 120), (10.0, 12.0))
    assert np.abs(plain[:, 0] - plain[:, -1]).mean() > 2 * steps.max()


def test_noise_has_the_grain_asked_for() -> None:
    fine = smooth_noise(np.random.default_rng(1), (200, 200), 2)
    coarse = smooth_noise(np.random.default_rng(1), (200, 200), 20)
    assert np.abs(np.diff(coarse, axis=0)).mean() < 0.25 * np.abs(np.diff(fine, axis=0)).mean()
    assert 0.4 < coarse.std() < 1.2


def test_sampling_lies_between_pixels_and_repeats() -> None:
    texture = np.arange(12, dtype=np.float32).reshape(3, 4)
    x, y = np.array([1.5, 1.0, 5.0], np.float32), np.array([0.0, 1.5, 1.0], np.float32)
    assert sample(texture, x, y).tolist() == [1.5, 7.0, 5.0]
    colors = np.dstack([texture, 2 * texture])
    assert sample(colors, x, y).tolist() == [[1.5, 3.0], [7.0, 14.0], [5.0, 10.0]]
    many = sample(texture, np.zeros(40_000, np.float32), np.ones(40_000, np.float32))
    assert many.shape == (40_000,)
    assert (many == 4.0).all()


def test_jitter_stays_a_colour_near_its_start() -> None:
    rng = np.random.default_rng(2)
    drawn = np.array([jitter(rng, (100, 150, 50), 0.1) for _ in range(400)])
    assert np.allclose(drawn.mean(axis=0), (100, 150, 50), rtol=0.03)
    assert 0.07 < (drawn / (100, 150, 50)).std() < 0.14
    assert min(jitter(rng, (0, 255, 300), 5.0)) >= 2


def test_a_blade_has_veins_and_an_even_tone() -> None:
    blade = leaf_texture(3)
    tone, vein = blade[..., 0], blade[..., 1]
    assert blade.shape == (192, 192, 4)
    assert abs(tone.mean() - 1) < 0.12
    assert 0.05 < (vein > 0.5).mean() < 0.35
    # The middle vein runs from the stalk to the tip, through the texture's middle row.
    assert vein[92:100, 60:150].max(axis=0).mean() > 0.8
    assert not np.array_equal(blade, leaf_texture(4))


def test_a_place_on_the_blade_finds_its_pixel() -> None:
    # The middle lies between pixels 95 and 96; 1.3 half axes away is the texture's rim.
    place = np.array([0.0, -1.3, 1.3], np.float32)
    assert np.allclose(leaf_texel(place), [95.5, -0.5, 191.5], atol=1e-4)


def test_a_piece_of_a_photo_keeps_its_drawing_not_its_colour() -> None:
    rng = np.random.default_rng(1)
    leaf = rng.integers(60, 120, (300, 400, 3), dtype=np.uint8)
    piece, *_, coarse = leaf_photo_texture(rng, Assets(leaves=(leaf,)))
    assert piece.shape == (192, 192, 3)
    assert np.allclose(piece.mean(axis=(0, 1)), 1.0, atol=0.12)
    assert piece.std() > 0.05
    assert coarse.std() < 0.5 * piece.std()
    assert leaf_photo_texture(rng, Assets()) == ()


def test_a_small_leaf_gets_a_coarse_drawing() -> None:
    # 192 pixels over 2.6 half axes are 74 a half axis; with 18 the texture is four times too fine.
    level = leaf_level(18.5)
    assert level == 2
    fine, coarse = (np.abs(np.diff(leaf_texture(1, k)[..., 1])).mean() for k in (0, level))
    assert coarse < 0.6 * fine


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


def test_a_material_seen_from_afar_has_no_fine_grain() -> None:
    near, far = (
        material_tile(np.random.default_rng(1), "cloth", (200.0, 200.0, 200.0), pixel_m)
        for pixel_m in (0.0, 0.006)
    )
    fine = [np.abs(np.diff(tile[..., 0], axis=1)).mean() for tile in (near, far)]
    assert fine[1] < 0.3 * fine[0]
    assert far.mean() == pytest.approx(near.mean(), rel=0.01)


def test_an_unknown_material_is_refused() -> None:
    with pytest.raises(ValueError, match="choose one of wood, steel"):
        material_tile(np.random.default_rng(1), "gold", (200.0, 160.0, 40.0))


def test_far_views_are_what_they_are_called() -> None:
    views = {
        kind: np.mean(
            [far_view(np.random.default_rng(k), kind, 160, 90, Assets()) for k in range(8)],
            axis=(0, 1, 2),
        )
        for kind in ("leaves", "film", "dark")
    }
    assert views["leaves"][1] > 1.1 * views["leaves"][[0, 2]].mean()
    assert views["film"].mean() > 5 * views["dark"].mean()
    assert far_view(np.random.default_rng(1), "photo", 160, 90, Assets()).shape == (90, 160, 3)


def test_a_photo_far_away_is_a_piece_of_it() -> None:
    # Red rises to the right, so it does in any piece, or falls where that is mirrored.
    picture = np.zeros((200, 300, 3), np.uint8)
    picture[..., 0] = np.linspace(50, 250, 300).astype(np.uint8)
    view = far_view(np.random.default_rng(2), "photo", 64, 48, Assets(backgrounds=(picture,)))
    steps = np.diff(view[..., 0].mean(axis=0))
    assert view.shape == (48, 64, 3)
    assert (steps > 0).all() or (steps < 0).all()
    assert view[..., 1].max() == 0
