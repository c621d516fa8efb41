from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cucumbervision_lab.scenes.colors import to_srgb
from cucumbervision_lab.scenes.skin import LOOKS, Skin, SkinMaps, random_skin, skin_maps
from cucumbervision_lab.scenes.textures import Assets


def maps_of(skin: Skin, seed: int = 1, assets: Assets | None = None) -> SkinMaps:
    rng = np.random.default_rng(seed)
    return skin_maps(rng, skin, 0.2, 0.02, 0.0006, assets or Assets())


def band(maps: SkinMaps, low_m: float, high_m: float) -> np.ndarray:
    """The mean sRGB of a ring about the fruit, from the blossom end."""
    rows = (np.array([low_m, high_m]) / 0.2 * maps.albedo.shape[0]).astype(int)
    ring = maps.albedo[rows[0] : rows[1]].mean(axis=(0, 1))
    return to_srgb(ring.astype(np.float32)).astype(float)


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


def test_skin_has_no_seam() -> None:
    rng = np.random.default_rng(5)
    close_up = np.repeat(rng.integers(20, 235, (40, 64), dtype=np.uint8)[..., None], 3, axis=2)
    assets = Assets(skins=(close_up,))
    for seed, variety in enumerate(LOOKS):
        skin = replace(random_skin(np.random.default_rng(seed), variety, assets), texture=0)
        albedo = maps_of(skin, seed, assets).albedo
        steps = np.abs(np.diff(albedo, axis=1)).mean(axis=(0, 2))
        assert np.abs(albedo[:, 0] - albedo[:, -1]).mean() <= steps.max()
