from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from cucumbervision.errors import CaptureError
from cucumbervision_lab.synthesis.assets import load_assets

RED = np.zeros((60, 80, 3), np.uint8)
RED[..., 2] = 200  # OpenCV writes BGR


def write(path: Path, picture: np.ndarray = RED) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), picture)


def test_pictures_are_sorted_by_the_folders_they_lie_in(tmp_path: Path) -> None:
    write(tmp_path / "textures/skin/a.png")
    write(tmp_path / "backgrounds/canopy/b.png", np.zeros((900, 3200, 3), np.uint8))
    write(tmp_path / "backgrounds/leaves/c.png")
    write(tmp_path / "photos/d.png")
    write(tmp_path / "hdri_mine/e.hdr", np.full((32, 64, 3), (0.5, 1.0, 8.0), np.float32))
    (tmp_path / "textures/skin/LICENSE").write_text("free")
    assets = load_assets(tmp_path)
    assert [len(assets.skins), len(assets.backgrounds), len(assets.leaves)] == [1, 2, 1]
    assert assets.skins[0][0, 0].tolist() == [200, 0, 0]
    assert assets.backgrounds[0].shape == (450, 1600, 3)
    (light,) = assets.environments
    assert light.shape == (64, 128, 3)
    assert np.allclose(light[10, 10], (8.0, 1.0, 0.5), rtol=0.02)


def test_backgrounds_that_say_they_show_fruit_are_passed_over(tmp_path: Path) -> None:
    write(tmp_path / "backgrounds/Pythium_Fruit_Rot_1.png")
    write(tmp_path / "backgrounds/row.png")
    write(tmp_path / "textures/fruit.png")
    assert len(load_assets(tmp_path).backgrounds) == 1
    assert len(load_assets(tmp_path).skins) == 1
    assert len(load_assets(tmp_path, without=()).backgrounds) == 2


def test_unreadable_files_are_named_and_the_rest_is_kept(tmp_path: Path) -> None:
    write(tmp_path / "textures/good.png")
    (tmp_path / "textures/empty.png").write_bytes(b"")
    (tmp_path / "textures/torn.jpg").write_bytes(b"\xff\xd8\xff\xe0 no more")
    with pytest.warns(UserWarning, match=r"textures/empty\.png, textures/torn\.jpg"):
        assets = load_assets(tmp_path)
    assert len(assets.skins) == 1


def test_a_folder_that_is_missing_or_holds_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="no such folder"):
        load_assets(tmp_path / "none")
    with pytest.raises(CaptureError, match="holds no textures"):
        load_assets(tmp_path)


@pytest.mark.realdata
def test_real_assets_load(shared_data: Path) -> None:
    assets = load_assets(shared_data)
    assert len(assets.skins) == 15
    assert len(assets.environments) == 8
    # Four of the 59 say by their names that they show fruit.
    assert (len(assets.backgrounds), len(assets.leaves)) == (55, 17)
    assert all(np.isfinite(light).all() and light.max() > 1 for light in assets.environments)
