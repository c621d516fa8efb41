"""Random appearance of a scene: skins, light, leaves and materials."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from cucumbervision_lab.arrays import Generator
from cucumbervision_lab.scenes.colors import Color, jitter, palette
from cucumbervision_lab.scenes.compose import Setting
from cucumbervision_lab.scenes.lighting import Light, random_light
from cucumbervision_lab.scenes.skin import LOOKS, Skin, random_skin
from cucumbervision_lab.scenes.textures import Assets, material_color

if TYPE_CHECKING:
    from cucumbervision_lab.scenes.lighting import Vector
    from cucumbervision_lab.scenes.scene import Scene


FAR = "far"

_LEAVES = palette("2a4626 325c26 42742a 54882e 70983c")

_FADED = palette("969642 80683c")

_ROLE_COLORS: dict[str, tuple[Color, ...]] = {
    "blossom": palette("deb428 c49646 8c683e 604a32"),
    "stem": palette("607c42 7a9254 506838"),
    "stalk": palette("688442 829854 547034"),
    "string": palette("e2e2dc aaaaa6 8c7454 28282a"),
    "crate": palette("2a2c2e 28643c 285aa0 bea076 c8cacc aa3228"),
}

_BENCHES = ("wood", "steel", "plastic", "cloth", "concrete", "cardboard", "paper", "soil")


@dataclass(frozen=True)
class Style:
    """Appearance of each body of a scene, in the order of the scene's bodies.

    Parameters
    ----------
    skins : tuple of Skin
        Skin of each fruit.
    light : Light
        Light of the scene.
    far : str
        Distant background, see `textures.far_view`.
    materials : tuple of str
        Material of each plane, or "far" for a wall that shows the distant background.
    material_colors : tuple of tuple of float
        Colour of each plane, sRGB, 0 to 255.
    leaf_colors, stem_colors : tuple of tuple of float
        Colour of each leaf and stem, sRGB, 0 to 255.
    leaf_gloss, leaf_relief : float
        Gloss and surface relief of leaves, 0 to 1.
    leaf_photo : float
        Weight of photo textures on leaves, 0 to 1.
    gloom_per_m : float
        Attenuation of light behind the nearest leaves, 1/m.
    """

    skins: tuple[Skin, ...]
    light: Light
    far: str = "leaves"
    materials: tuple[str, ...] = ()
    material_colors: tuple[Color, ...] = ()
    leaf_colors: tuple[Color, ...] = ()
    stem_colors: tuple[Color, ...] = ()
    leaf_gloss: float = 0.3
    leaf_relief: float = 0.4
    leaf_photo: float = 0.0
    gloom_per_m: float = 1.0


def random_style(
    rng: Generator,
    scene: Scene,
    assets: Assets,
    setting: Setting | str,
    *,
    up: Vector | None = None,
) -> Style:
    """Sample a random appearance for a scene.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator.
    scene : Scene
        The scene.
    assets : Assets
        Picture assets.
    setting : Setting or str
        Setting of the scene. Unless the fruit hang, the first plane is the surface they lie on;
        the other planes show the distant background.
    up : tuple of float, optional
        Unit vector up in camera coordinates; by default -y for hanging fruit, otherwise the normal
        of the first plane.

    Returns
    -------
    Style
        Random appearance.

    Raises
    ------
    ValueError
        If the setting is unknown.

    Examples
    --------
    >>> import numpy as np
    >>> from cucumbervision_lab.scenes.raycast import Plane
    >>> from cucumbervision_lab.scenes.scene import Scene
    >>> bench = Scene((), planes=(Plane.facing(0.6),))
    >>> style = random_style(np.random.default_rng(1), bench, Assets(), "bench")
    >>> len(style.materials), style.light.up
    (1, (0.0, 0.0, -1.0))
    """
    hanging = Setting(setting) is Setting.HANGING
    light = random_light(rng, assets, _up(scene, hanging=hanging) if up is None else up)
    bench = () if hanging else tuple(str(rng.choice(_BENCHES)) for _ in scene.planes[:1])
    background_planes = len(scene.planes) - len(bench)
    background = str(rng.choice(["photo", "leaves", "film", "dark"], p=[0.45, 0.25, 0.22, 0.08]))
    return Style(
        skins=_skins(rng, scene, assets),
        light=light,
        far=background,
        materials=(*bench, *[FAR] * background_planes),
        material_colors=(
            *(material_color(rng, name) for name in bench),
            *[(0.0, 0.0, 0.0)] * background_planes,
        ),
        leaf_colors=_leaf_colors(rng, scene),
        stem_colors=_stem_colors(rng, scene),
        leaf_gloss=float(rng.uniform(0.05, 0.4)),
        leaf_relief=float(rng.uniform(0.15, 0.7)),
        leaf_photo=float(rng.uniform(0.3, 1.0)) if assets.leaves and rng.random() < 0.6 else 0.0,
        gloom_per_m=float(rng.uniform(0.0, 2.5)),
    )


def _up(scene: Scene, *, hanging: bool) -> Vector:
    if hanging or not scene.planes:
        return 0.0, -1.0, 0.0
    x, y, z = (scene.planes[0].unit_normal() + 0.0).tolist()
    return x, y, z


def _skins(rng: Generator, scene: Scene, assets: Assets) -> tuple[Skin, ...]:
    names = tuple(LOOKS)
    main = names[rng.choice(len(names), p=[0.36, 0.22, 0.14, 0.16, 0.12])]
    kin = random_skin(rng, main, assets)
    skins = []
    for _ in scene.fruit:
        if rng.random() < 0.15:
            skins.append(random_skin(rng, names[rng.integers(len(names))], assets))
        else:
            skins.append(_sibling(rng, kin, random_skin(rng, main, assets)))
    return tuple(skins)


def _sibling(rng: Generator, kin: Skin, neighbour: Skin) -> Skin:
    # Fruit of one plant are similar but not identical: some ripen, some become pale.
    return replace(
        kin,
        base=jitter(rng, kin.base, 0.10),
        tip=jitter(rng, kin.tip, 0.10),
        tip_reach=neighbour.tip_reach,
        stripe_strength=(kin.stripe_strength + neighbour.stripe_strength) / 2,
        bloom=neighbour.bloom,
        neck=neighbour.neck,
    )


def _leaf_colors(rng: Generator, scene: Scene) -> tuple[Color, ...]:
    main = jitter(rng, _LEAVES[rng.integers(len(_LEAVES))])
    colors = []
    for leaf in scene.leaves:
        if leaf.role == "blossom":
            choices = _ROLE_COLORS["blossom"]
            colors.append(jitter(rng, choices[rng.integers(len(choices))], 0.12))
        elif rng.random() < 0.04:
            colors.append(jitter(rng, _FADED[rng.integers(len(_FADED))]))
        elif rng.random() < 0.2:
            colors.append(jitter(rng, _LEAVES[rng.integers(len(_LEAVES))]))
        else:
            colors.append(jitter(rng, main, 0.14))
    return tuple(colors)


def _stem_colors(rng: Generator, scene: Scene) -> tuple[Color, ...]:
    main = {
        role: _ROLE_COLORS[role][rng.integers(len(_ROLE_COLORS[role]))] for role in _ROLE_COLORS
    }
    return tuple(jitter(rng, main[stem.role], 0.08) for stem in scene.stems)
