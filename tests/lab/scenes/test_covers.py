from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from cucumbervision_lab.scenes.covers import CoverKind, FruitPicture, cover_end, read_pieces
from cucumbervision_lab.scenes.paste import Cutout

RADIUS_PX, SURFACE_M, RADIUS_M = 15.0, 0.5, 0.02
AXIS_PX = np.column_stack([np.linspace(270, 70, 41), np.full(41, 150.0)])
LEAF = Cutout(np.full((90, 120, 3), (40, 160, 50), np.uint8), np.ones((90, 120), bool), None)


def fruit() -> FruitPicture:
    mask = np.zeros((300, 420), np.uint8)
    corners = [tuple(point) for point in AXIS_PX[[0, -1]].astype(int).tolist()]
    cv2.line(mask, corners[0], corners[1], 1, int(2 * RADIUS_PX))
    color = np.where(mask[..., None] > 0, (20, 70, 30), (150, 150, 160)).astype(np.uint8)
    depth = np.where(mask > 0, SURFACE_M, 1.5).astype(np.float32)
    return FruitPicture(color, depth, mask > 0)


def laid(kind: CoverKind, seed: int) -> tuple[FruitPicture, float] | None:
    return cover_end(
        fruit(),
        AXIS_PX,
        RADIUS_PX,
        [LEAF],
        np.random.default_rng(seed),
        kind,
        surface_m=SURFACE_M,
        radius_m=RADIUS_M,
    )


@pytest.mark.parametrize("kind", [CoverKind.LEAF_OVER, CoverKind.STEM_OVER])
def test_what_lies_over_an_end_takes_it_from_the_mask(kind: CoverKind) -> None:
    found = [covered for seed in range(12) if (covered := laid(kind, seed)) is not None]
    assert len(found) >= 8
    for picture, share in found:
        columns = np.nonzero(picture.mask[150])[0]
        # The axis runs from 270 to 70: what is hidden is counted from the right.
        assert share == pytest.approx((270 - columns.max()) / 200, abs=0.01)
        assert share > 0
        assert columns.min() < 80
        assert (picture.mask <= fruit().mask).all()


@pytest.mark.parametrize(
    "kind", [CoverKind.LEAF_BESIDE, CoverKind.STEM_BEYOND, CoverKind.LEAF_BEHIND]
)
def test_what_lies_beside_or_behind_an_end_leaves_it_true(kind: CoverKind) -> None:
    found = [covered for seed in range(12) if (covered := laid(kind, seed)) is not None]
    assert len(found) >= 4
    for picture, share in found:
        assert share == 0
        assert (picture.color != fruit().color).any()
        near = np.zeros_like(picture.mask)
        near[150 - 4 : 150 + 5, 80:262] = True  # the middle of the fruit stays in sight
        assert picture.mask[near].mean() > 0.95


def test_depth_of_a_cover_is_near_the_fruit_or_not_read() -> None:
    for seed in range(8):
        covered = laid(CoverKind.LEAF_OVER, seed)
        if covered is None:
            continue
        picture, _ = covered
        changed = picture.depth_m[picture.depth_m != fruit().depth_m]
        off = changed[changed > 0] - SURFACE_M
        assert np.abs(off).max(initial=0) < 4 * RADIUS_M


def test_a_fruit_goes_on_in_sight_beyond_a_stem() -> None:
    beyond = []
    for seed in range(12):
        covered = laid(CoverKind.STEM_OVER, seed)
        if covered is not None:
            lost = fruit().mask & ~covered[0].mask
            kept_color = np.abs(covered[0].color.astype(int) - fruit().color).max(axis=2) < 40
            beyond.append((lost & kept_color).sum())
    assert max(beyond) > 300


def test_pieces_are_pictures_with_transparency(tmp_path: Path) -> None:
    leaf = np.zeros((8, 12, 4), np.uint8)
    leaf[2:6, 3:9] = (10, 200, 30, 255)
    cv2.imwrite(str(tmp_path / "leaf.png"), leaf)
    cv2.imwrite(str(tmp_path / "photo.png"), leaf[..., :3])
    (piece,) = read_pieces(tmp_path)
    assert piece.mask.sum() == 4 * 6
    assert piece.color[3, 4].tolist() == [30, 200, 10]
