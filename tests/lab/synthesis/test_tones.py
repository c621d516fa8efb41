from __future__ import annotations

import numpy as np

from cucumbervision_lab.synthesis.tones import (
    dimmed,
    jitter,
    mix,
    sample,
    smooth_noise,
    smoothstep,
    to_linear,
    to_srgb,
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
    assert np.allclose(dimmed(picture, share), picture * share[..., None])


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
