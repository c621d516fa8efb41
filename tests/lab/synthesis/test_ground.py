from __future__ import annotations

import numpy as np
import pytest

from cucumbervision_lab.synthesis.assets import Assets
from cucumbervision_lab.synthesis.ground import (
    MATERIALS,
    far_view,
    material_color,
    material_tile,
)
from cucumbervision_lab.synthesis.tones import to_linear


@pytest.mark.parametrize("material", MATERIALS)
def test_a_material_has_its_colour(material: str) -> None:
    rng = np.random.default_rng(1)
    color = material_color(rng, material)
    tile = material_tile(rng, material, color)
    assert tile.shape == (512, 512, 3)
    assert tile.dtype == np.float32
    assert 0 < tile.min() <= tile.max() < 1
    # Holes of a mesh are dark, so that it is darker than its plastic.
    expected = to_linear(color) * (0.6 if material == "mesh" else 1.0)
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
