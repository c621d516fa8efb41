from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cucumbervision_lab.synthesis.appearance import Assets
from cucumbervision_lab.synthesis.colors import to_srgb
from cucumbervision_lab.synthesis.skin import LOOKS, Skin, SkinMaps, random_skin, skin_maps

PLAIN = Skin((40.0, 90.0, 40.0), (150.0, 165.0, 80.0), (160.0, 190.0, 120.0), mottle=0.0, bloom=0.0)


def maps_of(skin: Skin, seed: int = 1, assets: Assets | None = None) -> SkinMaps:
    rng = np.random.default_rng(seed)
    return skin_maps(rng, skin, 0.2, 0.02, 0.0006, assets or Assets())


def band(maps: SkinMaps, low_m: float, high_m: float) -> np.ndarray:
    """The mean sRGB of a ring about the fruit, from the blossom end."""
    rows = (np.array([low_m, high_m]) / 0.2 * maps.albedo.shape[0]).astype(int)
    ring = maps.albedo[rows[0] : rows[1]].mean(axis=(0, 1))
    return to_srgb(ring.astype(np.float32)).astype(float)


def test_a_map_spans_the_fruit_in_texels() -> None:
    maps = maps_of(PLAIN)
    assert maps.albedo.shape == (334, 210, 3)  # 0.2 / 0.0006; 2 pi 0.02 / 0.0006
    assert maps.relief.shape == (334, 210, 3)
    assert 0.0 < maps.albedo.min() <= maps.albedo.max() < 1.0


@pytest.mark.parametrize("variety", LOOKS)
def test_the_ends_of_every_variety_can_be_told_apart(variety: str) -> None:
    for seed in range(6):
        skin = random_skin(np.random.default_rng(seed), variety, Assets())
        maps = maps_of(skin, seed)
        scar, rim = band(maps, 0.0, 0.0015), band(maps, 0.198, 0.2)
        # The blossom's scar is brown: red over green. The stem's rim is pale: green, and bright.
        assert scar[0] > scar[1] > scar[2]
        assert rim[1] > rim[0] > rim[2]
        assert rim.sum() > 1.4 * scar.sum()


def test_the_blossom_end_yellows_as_far_as_it_is_told_to() -> None:
    def yellow(maps: SkinMaps, at_m: float) -> float:
        red, green, _ = band(maps, at_m - 0.005, at_m + 0.005)
        return float(red / green)

    short, long = (maps_of(replace(PLAIN, tip_reach=r, stripe_strength=0.0)) for r in (0.1, 0.7))
    assert yellow(long, 0.06) > yellow(short, 0.06) + 0.1
    assert yellow(short, 0.11) == pytest.approx(40 / 90, abs=0.06)


def test_ridges_have_the_slope_of_their_height() -> None:
    # height = h / 2 cos(n angle): about the fruit the slope is h n / (2 r) sin, wobbling a little.
    flat, ridged = (maps_of(replace(PLAIN, ridges=8, ridge_m=h)) for h in (0.0, 0.001))
    middle = np.s_[150:200, :, 1]
    slope = ridged.relief[middle] - flat.relief[middle]
    assert slope.std() == pytest.approx(0.001 * 8 / (2 * 0.02) / np.sqrt(2), rel=0.05)


def test_warts_stand_as_thick_as_told() -> None:
    bare, warty = (maps_of(replace(PLAIN, warts_per_cm2=w, wart_m=0.001)) for w in (0.0, 2.0))
    steep = [np.abs(m.relief[30:-30, :, :2]).max() for m in (bare, warty)]
    assert steep[0] < 0.15
    assert steep[1] > 0.4
    pale = maps_of(replace(PLAIN, warts_per_cm2=2.0, wart_m=0.001, wart_tone=1.8))
    assert pale.albedo.mean() > warty.albedo.mean() > bare.albedo.mean()


def test_skin_has_no_seam() -> None:
    rng = np.random.default_rng(5)
    close_up = np.repeat(rng.integers(20, 235, (40, 64), dtype=np.uint8)[..., None], 3, axis=2)
    assets = Assets(skins=(close_up,))
    for seed, variety in enumerate(LOOKS):
        skin = replace(random_skin(np.random.default_rng(seed), variety, assets), texture=0)
        albedo = maps_of(skin, seed, assets).albedo
        steps = np.abs(np.diff(albedo, axis=1)).mean(axis=(0, 2))
        assert np.abs(albedo[:, 0] - albedo[:, -1]).mean() <= steps.max()


def test_streaks_of_a_close_up_run_along_the_fruit_however_it_was_held() -> None:
    streaks = np.zeros((64, 64, 3), np.uint8)
    streaks[:, ::8] = streaks[:, 1::8] = 180
    streaks += 40
    held = (streaks, np.ascontiguousarray(streaks.transpose(1, 0, 2)))
    for picture in held:
        albedo = maps_of(replace(PLAIN, texture=0), assets=Assets(skins=(picture,))).albedo
        middle = albedo[120:220].mean(axis=2)
        along, around = (np.abs(np.diff(middle, axis=a)).mean() for a in (0, 1))
        assert around > 3 * along


def test_chance_makes_the_varieties_what_they_are() -> None:
    rng = np.random.default_rng(7)
    many = {name: [random_skin(rng, name, Assets()) for _ in range(60)] for name in LOOKS}
    green = {name: np.mean([s.base[1] for s in skins]) for name, skins in many.items()}
    warts = {name: np.mean([s.warts_per_cm2 for s in skins]) for name, skins in many.items()}
    assert green["pale"] > green["mini"] > green["slicing"]
    assert warts["pickling"] > warts["slicing"] > warts["long"]
    assert all(s.texture == -1 for skins in many.values() for s in skins)
    with pytest.raises(ValueError, match="choose one of long, slicing"):
        random_skin(rng, "melon", Assets())
