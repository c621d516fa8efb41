from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.errors import CaptureError
from cucumbervision_lab.scenes.bodies import arc_tube, rotation
from cucumbervision_lab.scenes.placing import trellis
from cucumbervision_lab.scenes.shading import FAR, random_style
from cucumbervision_lab.scenes.textures import Assets, load_assets

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


def test_unreadable_files_are_named_and_the_rest_is_kept(tmp_path: Path) -> None:
    write(tmp_path / "textures/good.png")
    (tmp_path / "textures/empty.png").write_bytes(b"")
    (tmp_path / "textures/torn.jpg").write_bytes(b"\xff\xd8\xff\xe0 no more")
    with pytest.warns(UserWarning, match=r"textures/empty\.png, textures/torn\.jpg"):
        assets = load_assets(tmp_path)
    assert len(assets.skins) == 1


def test_a_folder_that_is_missing_or_holds_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="folder not found"):
        load_assets(tmp_path / "none")
    with pytest.raises(CaptureError, match="contains no textures"):
        load_assets(tmp_path)


CAMERA = Intrinsics(320, 180, 228.0, 228.0, 160.0, 90.0)


FRUIT = (
    arc_tube(0.2, 0.02).moved(rotation(-90), (0.0, 0.0, 0.5)),
    arc_tube(0.15, 0.02).moved(rotation(-90), (0.1, 0.0, 0.5)),
)


def test_every_body_gets_a_look() -> None:
    scene = trellis(np.random.default_rng(1), CAMERA, FRUIT)
    style = random_style(np.random.default_rng(2), scene, Assets(), "hanging")
    assert len(style.skins) == 2
    assert len(style.leaf_colors) == len(scene.leaves)
    # Of the four rods two are strings of 1.5 mm.
    assert [stem.role for stem in scene.stems] == ["string", "string", "stem", "stem"]
    assert style.materials == (FAR,)
    assert style == random_style(np.random.default_rng(2), scene, Assets(), "hanging")
