"""Random appearance of a scene (skins, light, leaves, materials), and picture assets."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from cucumbervision.errors import CaptureError
from cucumbervision_lab.arrays import Array32, Generator, Pixels
from cucumbervision_lab.scenes.colors import Color, jitter, palette
from cucumbervision_lab.scenes.compose import Setting
from cucumbervision_lab.scenes.lighting import Light, random_light
from cucumbervision_lab.scenes.skin import LOOKS, Skin, random_skin
from cucumbervision_lab.scenes.textures import material_color

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from cucumbervision_lab.scenes.lighting import Vector
    from cucumbervision_lab.scenes.scene import Scene

_SHOWS_FRUIT = ("fruit", "rot_")

_PICTURES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"}

_LIGHTS = {".hdr", ".exr"}

_SKIN_PX = 512

_LEAF_PX = 512

_BACKGROUND_PX = 1600

_LIGHT_SIZE = (128, 64)


@dataclass(frozen=True, eq=False)
class Assets:
    """Picture assets for rendering. All may be empty; everything is then generated.

    Parameters
    ----------
    skins : tuple of ndarray of uint8, shape (H, W, 3)
        Close-ups of skin, RGB, the longer side at most 512 px.
    backgrounds : tuple of ndarray of uint8, shape (H, W, 3)
        Distant backgrounds, RGB, the longer side at most 1600 px.
    environments : tuple of ndarray of float32, shape (64, 128, 3)
        Environment maps, linear RGB, equirectangular, the top row up.
    leaves : tuple of ndarray of uint8, shape (H, W, 3)
        Close-ups of leaves, RGB, the longer side at most 512 px.
    """

    skins: tuple[Pixels, ...] = ()
    backgrounds: tuple[Pixels, ...] = ()
    environments: tuple[Array32, ...] = ()
    leaves: tuple[Pixels, ...] = ()


def load_assets(folder: Path | None) -> Assets:
    """Load picture assets by the names of their folders.

    Pictures below `textures` are skins, those below `backgrounds` are backgrounds, those in a
    folder `leaves` are leaves, and `.hdr` files below a folder whose name starts with `hdri` are
    environments. Each kind is sorted by path. Backgrounds and leaves whose names contain a word of
    `_SHOWS_FRUIT` are skipped: fruit in the background would have no label.

    Parameters
    ----------
    folder : Path, optional
        Folder of the assets; without it, the result is empty.

    Returns
    -------
    Assets
        Downscaled pictures. Unreadable files are skipped with a single warning.

    Raises
    ------
    CaptureError
        If the folder does not exist or contains no assets.

    Examples
    --------
    >>> load_assets(None)
    Assets(skins=(), backgrounds=(), environments=(), leaves=())
    """
    if folder is None:
        return Assets()
    if not folder.is_dir():
        raise CaptureError(
            "folder not found", source=folder, remedy="give a folder of assets, or omit the option"
        )
    bad: list[str] = []
    assets = Assets(
        _pictures(folder, "textures/**/*", _SKIN_PX, (), bad),
        _pictures(folder, "backgrounds/**/*", _BACKGROUND_PX, _SHOWS_FRUIT, bad),
        _environments(folder, bad),
        _pictures(folder, "**/leaves/**/*", _LEAF_PX, _SHOWS_FRUIT, bad),
    )
    if bad:
        names = ", ".join(sorted(set(bad)))
        warnings.warn(f"{folder}: unreadable pictures skipped: {names}", stacklevel=2)
    if not (assets.skins or assets.backgrounds or assets.environments or assets.leaves):
        raise CaptureError(
            "contains no textures, backgrounds or environment maps",
            source=folder,
            remedy="put pictures below textures/, backgrounds/ or hdri/",
        )
    return assets


def _pictures(
    folder: Path, pattern: str, longest_px: int, without: Sequence[str], bad: list[str]
) -> tuple[Pixels, ...]:
    pictures = []
    for picture in _read_all(folder, pattern, _PICTURES, without, bad):
        scale = min(longest_px / max(picture.shape[:2]), 1.0)
        if scale < 1:
            picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        pictures.append(np.ascontiguousarray(picture[..., ::-1], np.uint8))
    return tuple(pictures)


def _environments(folder: Path, bad: list[str]) -> tuple[Array32, ...]:
    environments = []
    for light in _read_all(folder, "**/hdri*/**/*", _LIGHTS, (), bad):
        sky = light[..., :3].astype(np.float32)
        small = cv2.resize(sky, _LIGHT_SIZE, interpolation=cv2.INTER_AREA)
        environments.append(np.ascontiguousarray(small[..., ::-1], np.float32))
    return tuple(environments)


def _read_all(
    folder: Path, pattern: str, endings: set[str], without: Sequence[str], bad: list[str]
) -> Iterator[NDArray[Any]]:
    """Yield the colour pictures that match a pattern, and append unreadable files to `bad`."""
    flag = cv2.IMREAD_UNCHANGED if endings is _LIGHTS else cv2.IMREAD_COLOR
    for path in sorted(set(folder.glob(pattern))):
        named = any(word.lower() in path.name.lower() for word in without)
        if named or path.suffix.lower() not in endings:
            continue
        # OpenCV raises for an empty file and returns None for a damaged one.
        try:
            picture = cv2.imdecode(np.fromfile(path, np.uint8), flag)
        except (OSError, cv2.error):
            picture = None
        if picture is None or picture.ndim != 3 or not np.isfinite(picture).all():
            bad.append(str(path.relative_to(folder)))
        else:
            yield np.asarray(picture)


_ROLES = ("leaf", "blossom", "stem", "stalk", "string", "crate")

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
    leaf_roles, stem_roles : tuple of str
        Role of each leaf and stem: "leaf" or "blossom"; "stem", "stalk", "string", "blossom" or
        "crate".
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
    leaf_roles: tuple[str, ...] = ()
    stem_roles: tuple[str, ...] = ()
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
    leaf_roles: Sequence[str] | None = None,
    stem_roles: Sequence[str] | None = None,
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
    leaf_roles, stem_roles : sequence of str, optional
        Role of each leaf and stem; by default all leaves are "leaf", and stems with a radius below
        2.5 mm are "string".
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
        If the setting or a role is unknown.

    Examples
    --------
    >>> from cucumbervision_lab.scenes.appearance import Assets
    >>> from cucumbervision_lab.scenes.raycast import Plane
    >>> from cucumbervision_lab.scenes.scene import Scene
    >>> bench = Scene((), planes=(Plane.facing(0.6),))
    >>> style = random_style(np.random.default_rng(1), bench, Assets(), "bench")
    >>> len(style.materials), style.light.up
    (1, (0.0, 0.0, -1.0))
    """
    hanging = Setting(setting) is Setting.HANGING
    leaves = tuple(leaf_roles) if leaf_roles is not None else ("leaf",) * len(scene.leaves)
    stems = tuple(stem_roles) if stem_roles is not None else _stem_roles(scene)
    if unknown := {*leaves, *stems} - {*_ROLES}:
        raise ValueError(f"unknown role {min(unknown)!r}: use one of {', '.join(_ROLES)}")
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
        leaf_colors=_leaf_colors(rng, leaves),
        stem_colors=_stem_colors(rng, stems),
        leaf_roles=leaves,
        stem_roles=stems,
        leaf_gloss=float(rng.uniform(0.05, 0.4)),
        leaf_relief=float(rng.uniform(0.15, 0.7)),
        leaf_photo=float(rng.uniform(0.3, 1.0)) if assets.leaves and rng.random() < 0.6 else 0.0,
        gloom_per_m=float(rng.uniform(0.0, 2.5)),
    )


def _up(scene: Scene, *, hanging: bool) -> Vector:
    if hanging or not scene.planes:
        return 0.0, -1.0, 0.0
    plane = scene.planes[0]
    # Normal towards the camera, which is at the origin.
    off = plane.normal * -np.sign(plane.normal @ plane.point_m)
    x, y, z = (off / np.linalg.norm(off) + 0.0).tolist()
    return x, y, z


def _stem_roles(scene: Scene) -> tuple[str, ...]:
    return tuple("string" if stem.radius_m < 0.0025 else "stem" for stem in scene.stems)


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


def _leaf_colors(rng: Generator, roles: tuple[str, ...]) -> tuple[Color, ...]:
    main = jitter(rng, _LEAVES[rng.integers(len(_LEAVES))])
    colors = []
    for role in roles:
        if role == "blossom":
            choices = _ROLE_COLORS["blossom"]
            colors.append(jitter(rng, choices[rng.integers(len(choices))], 0.12))
        elif rng.random() < 0.04:
            colors.append(jitter(rng, _FADED[rng.integers(len(_FADED))]))
        elif rng.random() < 0.2:
            colors.append(jitter(rng, _LEAVES[rng.integers(len(_LEAVES))]))
        else:
            colors.append(jitter(rng, main, 0.14))
    return tuple(colors)


def _stem_colors(rng: Generator, roles: tuple[str, ...]) -> tuple[Color, ...]:
    main = {
        role: _ROLE_COLORS[role][rng.integers(len(_ROLE_COLORS[role]))] for role in _ROLE_COLORS
    }
    return tuple(jitter(rng, main.get(role, main["stem"]), 0.08) for role in roles)
