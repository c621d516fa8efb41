from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.errors import CaptureError
from cucumbervision_lab.scenes.bodies import arc_tube, rotation
from cucumbervision_lab.scenes.lighting import Light
from cucumbervision_lab.scenes.placing import string, trellis
from cucumbervision_lab.scenes.scene import Kind, Leaf, Plane, Scene, Stem, View, render
from cucumbervision_lab.scenes.shading import FAR, Style, random_style, shade
from cucumbervision_lab.scenes.skin import Skin
from cucumbervision_lab.scenes.textures import Assets, load_assets

CAMERA = Intrinsics(320, 240, 300.0, 300.0, 160.0, 120.0)
NONE = Assets()
MATT = Skin((60.0, 110.0, 50.0), (60.0, 110.0, 50.0), (60.0, 110.0, 50.0), gloss=0.0)
FRUIT = arc_tube(0.2, 0.02).moved(np.eye(3), (0.0, 0.0, 0.45))
EVEN = Light((0.0, -1.0, 0.0), environment=0)
ALL_ROUND = Assets(environments=(np.full((64, 128, 3), 1.0, np.float32),))
ON_PAPER = Scene((FRUIT,), planes=(Plane.facing(0.6),))


def painted(
    scene: Scene, style: Style, assets: Assets = NONE, seed: int = 1
) -> tuple[np.ndarray, View]:
    view = render(scene, CAMERA)
    return shade(scene, view, CAMERA, style, assets, np.random.default_rng(seed)), view


def paper(light: Light, skin: Skin = MATT) -> Style:
    return Style(
        (skin,),
        light,
        materials=("paper",),
        material_colors=((188.0, 188.0, 188.0),),
        gloom_per_m=0.0,
    )


def test_under_even_light_a_body_shows_its_own_colour() -> None:
    linear, view = painted(ON_PAPER, paper(EVEN), ALL_ROUND)
    # sRGB 188 is half the light (0.503), 110 is 0.156; corners take a little.
    assert np.median(linear[view.kind == Kind.PLANE]) == pytest.approx(0.503, rel=0.1)
    middle = view.mask(0) & (np.abs(view.share - 0.5) < 0.2)
    assert np.median(linear[middle][:, 1]) == pytest.approx(0.156, rel=0.2)


def test_leaves_and_rods_take_their_colours() -> None:
    leaf = Leaf(np.array([-0.1, 0.0, 0.5]), np.eye(3), 0.06, 0.05)
    rod = Stem(np.array([[0.1, -0.1, 0.5], [0.1, 0.1, 0.5]]), 0.008, "string")
    scene = Scene((), (leaf,), (rod,))
    style = Style(
        (),
        EVEN,
        leaf_colors=((60.0, 120.0, 50.0),),
        stem_colors=((200.0, 60.0, 60.0),),
        gloom_per_m=0.0,
    )
    linear, view = painted(scene, style, ALL_ROUND)
    green = linear[view.kind == Kind.LEAF].mean(axis=0)
    red = linear[view.kind == Kind.STEM].mean(axis=0)
    assert green.argmax() == 1
    assert red[0] > 4 * red[1]
    # A leaf also passes light on from behind.
    assert green[1] > 0.19  # sRGB 120 is 0.188


def test_every_kind_of_scene_is_painted_whole_and_the_same_again() -> None:
    rng = np.random.default_rng(3)
    hanging = trellis(rng, CAMERA, (FRUIT,))
    hanging = replace(hanging, stems=(*hanging.stems, string(rng, 0.0, 0.42)))
    for setting, scene in (("hanging", hanging), ("bench", ON_PAPER), ("crate", ON_PAPER)):
        for seed in range(3):
            style = random_style(np.random.default_rng(seed), scene, NONE, setting)
            linear, view = painted(scene, style, seed=seed)
            assert linear.shape == (240, 320, 3)
            assert linear.dtype == np.float32
            assert np.isfinite(linear).all()
            assert (linear >= 0).all()
            assert (linear[view.mask(0)].sum(axis=1) > 0).all()
            assert np.array_equal(linear, painted(scene, style, seed=seed)[0])


def test_rich_assets_change_skin_and_leaves() -> None:
    rng = np.random.default_rng(4)
    close_up = rng.integers(20, 230, (64, 64, 3), dtype=np.uint8)
    leaf = Leaf(np.array([-0.1, 0.0, 0.4]), np.eye(3), 0.06, 0.05)
    scene = replace(ON_PAPER, leaves=(leaf,))
    look_ = replace(
        paper(EVEN, replace(MATT, texture=0)), leaf_colors=((60.0, 120.0, 50.0),), leaf_photo=1.0
    )
    bare, view = painted(scene, look_, ALL_ROUND)
    rich, _ = painted(scene, look_, replace(ALL_ROUND, skins=(close_up,), leaves=(close_up,)))
    middle = view.mask(0) & (np.abs(view.share - 0.5) < 0.3)
    assert (rich[middle] / bare[middle]).std() > 0.1
    assert rich[view.kind == Kind.LEAF].std() > 1.5 * bare[view.kind == Kind.LEAF].std()


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


WIDE_CAMERA = Intrinsics(320, 180, 228.0, 228.0, 160.0, 90.0)


TWO_FRUIT = (
    arc_tube(0.2, 0.02).moved(rotation(-90), (0.0, 0.0, 0.5)),
    arc_tube(0.15, 0.02).moved(rotation(-90), (0.1, 0.0, 0.5)),
)


def test_every_body_gets_a_look() -> None:
    scene = trellis(np.random.default_rng(1), WIDE_CAMERA, TWO_FRUIT)
    style = random_style(np.random.default_rng(2), scene, Assets(), "hanging")
    assert len(style.skins) == 2
    assert len(style.leaf_colors) == len(scene.leaves)
    # Of the four rods two are strings of 1.5 mm.
    assert [stem.role for stem in scene.stems] == ["string", "string", "stem", "stem"]
    assert style.materials == (FAR,)
    assert style == random_style(np.random.default_rng(2), scene, Assets(), "hanging")
