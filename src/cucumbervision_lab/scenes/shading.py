"""Sample the appearance of a scene, and shade it: materials of all bodies, then lighting."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision_lab.arrays import Array32, Generator
from cucumbervision_lab.scenes import lighting, textures
from cucumbervision_lab.scenes.colors import (
    Color,
    jitter,
    mix,
    palette,
    sample,
    scale_colors,
    smooth_noise,
    to_linear,
)
from cucumbervision_lab.scenes.compose import Setting
from cucumbervision_lab.scenes.lighting import Light, Vector, random_light
from cucumbervision_lab.scenes.scene import Kind, Scene, View, ray_grid
from cucumbervision_lab.scenes.skin import LOOKS, Skin, random_skin, skin_maps
from cucumbervision_lab.scenes.textures import Assets

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
    >>> from cucumbervision_lab.scenes.scene import Plane
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
            *(textures.material_color(rng, name) for name in bench),
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


_FAR_M = 8.0
_PHOTOS = 3
_SEEN_THROUGH = np.array([1.15, 1.3, 0.55], np.float32)  # leaves transmit yellowish light


class _Shading:
    """The pixels of a scene while their materials and their light are computed.

    Per pixel, flat: colour, normal, gloss, the share of light that passes through, and where the
    colour shines by itself (a far view).
    """

    def __init__(
        self, scene: Scene, view: View, camera: Intrinsics, style: Style, rng: Generator
    ) -> None:
        self.scene, self.view, self.camera, self.style, self.rng = scene, view, camera, style, rng
        count = view.kind.size
        shapes = (count, 3), (count,), (count,)
        self.albedo, self.gloss, self.through = (np.zeros(shape, np.float32) for shape in shapes)
        self.normal = np.tile(np.array([0, 0, -1], np.float32), (count, 1))
        self.far = np.zeros(count, np.bool_)


def shade(
    scene: Scene, view: View, camera: Intrinsics, style: Style, assets: Assets, rng: Generator
) -> Array32:
    """Compute the radiance of each pixel.

    Parameters
    ----------
    scene : Scene
        Scene in camera coordinates.
    view : View
        Result of `render`.
    camera : Intrinsics
        The camera.
    style : Style
        Appearance of each body.
    assets : Assets
        Picture assets.
    rng : numpy.random.Generator
        Random generator.

    Returns
    -------
    ndarray of float32, shape (H, W, 3)
        Linear RGB, input of `colors.expose`.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> from cucumbervision_lab.scenes.textures import Assets
    >>> from cucumbervision_lab.scenes.scene import Plane
    >>> from cucumbervision_lab.scenes.scene import Scene, render
    >>> from cucumbervision_lab.scenes.bodies import arc_tube
    >>> camera, rng = Intrinsics(160, 120, 150.0, 150.0, 80.0, 60.0), np.random.default_rng(1)
    >>> tube = arc_tube(0.2, 0.02).moved(np.eye(3), (0.0, 0.0, 0.5))
    >>> scene = Scene((tube,), planes=(Plane.facing(0.52),))
    >>> style = random_style(rng, scene, Assets(), "bench")
    >>> shade(scene, render(scene, camera), camera, style, Assets(), rng).shape
    (120, 160, 3)
    """
    grid = ray_grid(camera)
    depth = view.depth_m.astype(np.float32)
    x, y = (g.astype(np.float32) for g in (grid.x, grid.y))
    points: Array32 = np.stack([x * depth, y * depth, depth], axis=-1).reshape(-1, 3)
    job = _Shading(scene, view, camera, style, rng)
    background = textures.far_view(rng, style.far, camera.width, camera.height, assets).reshape(
        -1, 3
    )
    photos = [
        textures.leaf_photo_texture(rng, assets) if style.leaf_photo else () for _ in range(_PHOTOS)
    ]
    tiles: dict[str, Array32] = {}
    for kind, index, pixels in _bodies(view):
        points_here = points[pixels]
        if kind == Kind.FRUIT:
            _fruit(job, pixels, index, points_here, assets)
        elif kind == Kind.LEAF:
            _leaf(job, pixels, index, points_here, photos[rng.integers(_PHOTOS)])
        elif kind == Kind.STEM:
            _stem(job, pixels, index, points_here)
        elif kind == Kind.PLANE and style.materials[index] != FAR:
            name = style.materials[index]
            if name not in tiles:
                seen_m = float(np.median(points_here[:, 2])) / camera.fx_px
                tiles[name] = textures.material_tile(
                    rng, name, style.material_colors[index], seen_m
                )
            _plane(job, pixels, index, points_here, tiles[name])
        else:
            job.albedo[pixels] = background[pixels]
            job.far[pixels] = True
    return _lit(job, lighting.light_maps(rng, style.light, assets))


def _bodies(view: View) -> list[tuple[int, int, NDArray[np.intp]]]:
    # A single stable sort of 16-bit keys groups the pixels by body.
    stride = int(view.body.max()) + 2
    key = (view.kind.astype(np.int32) * stride + view.body + 1).ravel()
    key = key.astype(np.uint16) if key.max() < 2**16 else key
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order].astype(np.int32), prepend=-1))
    bodies = []
    for pixels in np.split(order, starts[1:]):
        kind, body = divmod(int(key[pixels[0]]), stride)
        bodies.append((kind, body - 1, pixels))
    return bodies


def _fruit(
    job: _Shading, pixels: NDArray[np.intp], index: int, points: Array32, assets: Assets
) -> None:
    tube, view = job.scene.fruit[index], job.view
    share, normal = view.share.ravel()[pixels], view.normal.reshape(-1, 3)[pixels]
    balls = len(tube.radii_m)
    along = np.gradient(tube.centres_m, axis=0)
    steps = np.linalg.norm(along, axis=1)
    along /= steps[:, None]
    run = tube.radii_m[0] + np.concatenate([[0.0], np.cumsum((steps[1:] + steps[:-1]) / 2)])
    length = float(run[-1] + tube.radii_m[-1])
    radius = float(np.quantile(tube.radii_m, 0.8))
    texel = max(1.1 * float(np.median(points[:, 2])) / job.camera.fx_px, 0.0003)
    maps = skin_maps(job.rng, job.style.skins[index], length, radius, texel, assets)
    k = np.clip(np.rint(share * (balls - 1)), 0, balls - 1).astype(np.int32)
    tangent = along.astype(np.float32)[k]
    lean = np.einsum("ij,ij->i", normal, tangent)
    from_blossom_m = run.astype(np.float32)[k] + lean * tube.radii_m.astype(np.float32)[k]
    out = tube.outward - (along @ tube.outward)[:, None] * along
    out = (out / np.linalg.norm(out, axis=1)[:, None]).astype(np.float32)
    aside = np.cross(along, out).astype(np.float32)[k]
    out = out[k]
    angle = np.arctan2(
        np.einsum("ij,ij->i", normal, aside), np.einsum("ij,ij->i", normal, out)
    ) / np.float32(2 * np.pi)
    rows, columns = maps.albedo.shape[:2]
    x = (angle + np.float32(job.rng.random())) % 1 * columns - np.float32(0.5)
    y = np.clip(from_blossom_m / np.float32(length), 0, 1) * (rows - 1)
    job.albedo[pixels] = sample(maps.albedo, x, y)
    relief = sample(maps.relief, x, y)
    turned = 2 * np.float32(np.pi) * angle[:, None]
    round_about = np.cos(turned) * aside - np.sin(turned) * out
    job.normal[pixels] = _unit(normal - relief[:, :1] * tangent - relief[:, 1:2] * round_about)
    job.gloss[pixels] = relief[:, 2]


def _unit(vectors: Array32, sign: Array32 | float = 1.0) -> Array32:
    length = np.sqrt(np.einsum("ij,ij->i", vectors, vectors)) + np.float32(1e-9)
    return scale_colors(vectors, (np.float32(1) / length * sign).astype(np.float32))


def _leaf(
    job: _Shading, pixels: NDArray[np.intp], index: int, points: Array32, photo: tuple[Array32, ...]
) -> None:
    rng, style, leaf = job.rng, job.style, job.scene.leaves[index]
    frame = leaf.frame.astype(np.float32)
    local = (points - leaf.centre_m.astype(np.float32)) @ frame.T
    flip = np.float32(rng.choice((-1.0, 1.0)))
    x = textures.leaf_texel(local[:, 0] / np.float32(leaf.half_length_m))
    y = textures.leaf_texel(flip * local[:, 1] / np.float32(leaf.half_width_m))
    level = textures.leaf_level(
        job.camera.fx_px * leaf.half_length_m / float(np.median(points[:, 2]))
    )
    texels = sample(textures.leaf_texture(int(rng.integers(textures.LEAF_TEXTURES)), level), x, y)
    below = texels[:, 2:] * np.float32(style.leaf_relief)
    bend = np.asarray(leaf.bend_per_m, np.float32)
    slopes = local[:, :2] * bend + below * np.array([1, flip], np.float32)
    normal = frame[2] - slopes @ frame[:2]
    # Flip normals towards the camera, because both faces of a blade are visible.
    side = np.sign(np.einsum("ij,ij->i", normal, points))
    underside = float(side.mean()) > 0
    job.normal[pixels] = _unit(normal, -np.where(side == 0, 1, side))
    color = to_linear(style.leaf_colors[index])
    withered = leaf.role == "blossom"
    pale = to_linear((150, 168, 104))
    if underside and not withered:
        color = 0.65 * color + 0.35 * to_linear((140, 158, 122))
    vein = np.float32(0.0 if withered else rng.uniform(0.02, 0.35)) * texels[:, 1]
    albedo = mix(color, pale, vein)
    if photo and not withered:
        albedo *= 1 + np.float32(style.leaf_photo) * (sample(photo[level], x, y) - 1)
    job.albedo[pixels] = scale_colors(albedo, np.ascontiguousarray(texels[:, 0]))
    job.gloss[pixels] = np.float32(0.0 if underside or withered else style.leaf_gloss)
    job.through[pixels] = np.float32(0.55)


def _stem(job: _Shading, pixels: NDArray[np.intp], index: int, points: Array32) -> None:
    rng = job.rng
    line = job.scene.stems[index].vertices_m.astype(np.float32)
    first, step = line[:-1], np.diff(line, axis=0)
    squared = np.maximum(np.einsum("ij,ij->i", step, step), 1e-12)
    best = np.full(len(pixels), np.inf, np.float32)
    normal = np.zeros((len(pixels), 3), np.float32)
    run = np.zeros(len(pixels), np.float32)
    for k in range(len(step)):
        off = points - first[k]
        share = np.clip(off @ step[k] / squared[k], 0, 1)
        off -= share[:, None] * step[k]
        distance = np.einsum("ij,ij->i", off, off)
        closer = distance < best
        best[closer], normal[closer] = distance[closer], off[closer]
        run[closer] = (k + share[closer]) * np.sqrt(squared[k])
    normal = job.normal[pixels] = _unit(normal)
    color = to_linear(job.style.stem_colors[index])
    role = job.scene.stems[index].role
    if role == "string":
        tone = 1 + 0.2 * np.sin(run * 1600 + 6 * normal[:, 0])
    elif role == "crate":
        tone = 1 + 0.1 * sample(smooth_noise(rng, (64, 4), (6, 1), wrap=True), 0 * run, 90 * run)
    else:
        noise = smooth_noise(rng, (64, 4), (3, 1), wrap=True)
        tone = 1 + 0.12 * sample(noise, 2 + 2 * normal[:, 0], run * 400 % 63)
        tone *= 1 + 0.06 * np.cos(9 * np.arctan2(normal[:, 0], -normal[:, 2]))
    job.albedo[pixels] = color * np.clip(tone, 0.4, 1.6).astype(np.float32)[:, None]
    job.gloss[pixels] = np.float32(0.15)
    job.through[pixels] = np.float32(0.1 if role in ("stem", "stalk") else 0.0)


def _plane(
    job: _Shading, pixels: NDArray[np.intp], index: int, points: Array32, tile: Array32
) -> None:
    plane = job.scene.planes[index]
    frame = plane.tile_axes().astype(np.float32)
    place = (points - plane.point_m.astype(np.float32)) @ frame.T
    pixel = (place * np.float32(len(tile) / textures.TILE_M)) % len(tile)
    job.albedo[pixels] = sample(tile, pixel[:, 0], pixel[:, 1])
    job.normal[pixels] = plane.unit_normal().astype(np.float32)
    job.gloss[pixels] = np.float32(
        {"steel": 0.5, "plastic": 0.4}.get(job.style.materials[index], 0.03)
    )


def _lit(job: _Shading, maps: lighting.LightMaps) -> Array32:
    view, camera, style = job.view, job.camera, job.style
    shape = view.kind.shape
    grid = ray_grid(camera)
    background = job.far.reshape(shape)
    depth = np.where((view.depth_m > 0) & ~background, view.depth_m, _FAR_M).astype(np.float32)
    normal, albedo = (part.reshape(*shape, 3) for part in (job.normal, job.albedo))
    gloss, through = job.gloss.reshape(shape), job.through.reshape(shape)
    size = maps.front.shape[0]

    def found(picture: Array32, x: Array32, y: Array32) -> Array32:
        return np.asarray(cv2.remap(picture, x, y, cv2.INTER_LINEAR))

    half = np.float32(size / 2)
    x, y = ((normal[..., i] + 1) * half - np.float32(0.5) for i in range(2))
    open_ = lighting.ambient_occlusion(depth)
    front = found(maps.front, x, y)
    front += scale_colors(found(maps.back * _SEEN_THROUGH, x, y), through)
    nearest = float(np.quantile(depth[::8, ::8], 0.02))
    gloom = np.exp(-np.float32(style.gloom_per_m) * np.maximum(depth - nearest, 0))
    front = scale_colors(front, open_ * gloom)
    # The viewing direction, and with it the reflection, is inclined away from the picture's centre.
    x += np.float32(0.5) * half * grid.x.astype(np.float32)
    y += np.float32(0.5) * half * grid.y.astype(np.float32)
    x, y = np.clip(x, 0, size - 1), np.clip(y, 0, size - 1)
    # Schlick's approximation for a wax coating.
    edge = np.clip(1 + normal[..., 2], 0, 1) ** 4
    shine = gloss * (np.float32(0.045) + np.float32(0.35) * edge)
    gleam = found(maps.soft, x, y)
    gleam += scale_colors(found(maps.sharp, x, y), np.maximum(gloss - np.float32(0.4), 0))
    light = albedo * front
    light += scale_colors(gleam, shine * (0.3 + 0.7 * open_) * gloom)
    if style.light.sun_strength > 0:
        light += _sunlit(job, depth, gloom)
    light[background] = albedo[background]
    return light


def _sunlit(job: _Shading, depth_m: Array32, gloom: Array32) -> Array32:
    rng, light, shape = job.rng, job.style.light, depth_m.shape
    normal, albedo = (part.reshape(*shape, 3) for part in (job.normal, job.albedo))
    gloss, through = job.gloss.reshape(shape), job.through.reshape(shape)
    lit = lighting.sun_shadow(rng, depth_m, job.camera, light) * np.sqrt(gloom)
    if light.shade > 0:
        lit = lit * lighting.dappled_shade(rng, depth_m, job.camera, light)
    sun = np.asarray(light.sun, np.float32)
    halfway = sun + np.array([0, 0, -1], np.float32)
    halfway /= np.linalg.norm(halfway)
    cosines = cv2.transform(normal, np.stack([sun, halfway]))
    facing = cosines[..., 0]
    matt, back_light = np.maximum(facing, 0), through * np.maximum(-facing, 0)
    shine = cv2.pow(np.maximum(cosines[..., 1], 0), 60.0) * gloss * (facing > 0)
    strength = np.asarray(light.sun_color, np.float32) * np.float32(light.sun_strength)
    body = cv2.merge([matt + part * back_light for part in _SEEN_THROUGH.tolist()]) * albedo
    gleam = np.float32(0.9) * shine
    return scale_colors(body + cv2.merge([gleam, gleam, gleam]), lit) * strength
