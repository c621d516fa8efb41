"""Render a scene by path tracing, with Blender's Cycles: true shadows, and light through leaves."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.errors import DataSetError
from cucumbervision.geometry.curve import arc_positions, points_along
from cucumbervision_lab.synthesis.appearance import FAR
from cucumbervision_lab.synthesis.bodies import rotation
from cucumbervision_lab.synthesis.colors import smooth_noise, to_linear
from cucumbervision_lab.synthesis.lighting import sky_map
from cucumbervision_lab.synthesis.raycast import Leaf, leaf_rim
from cucumbervision_lab.synthesis.skin import skin_maps
from cucumbervision_lab.synthesis.textures import (
    LEAF_REACH,
    LEAF_TEXTURES,
    TILE_M,
    far_view,
    leaf_photo_texture,
    leaf_texture,
    material_tile,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cucumbervision.capture.intrinsics import Intrinsics
    from cucumbervision_lab.synthesis.appearance import Assets, Style
    from cucumbervision_lab.synthesis.bodies import Tube
    from cucumbervision_lab.synthesis.lighting import Light
    from cucumbervision_lab.synthesis.raycast import Plane, Stem
    from cucumbervision_lab.synthesis.scene import Scene

    Array = NDArray[np.float32]

_TO_BLENDER = np.diag([1.0, -1.0, -1.0])  # the camera looks along -z, with y up
_COLUMNS, _CAP_ROWS = 32, 6
_RIM, _RINGS = 64, 6
_SHADING_LEAVES = 24
_TRANSLUCENT = (1.15, 1.3, 0.55)  # leaves transmit yellowish light


@dataclass(frozen=True, eq=False)
class Traced:
    """A path-traced picture.

    Parameters
    ----------
    linear : ndarray of float32, shape (H, W, 3)
        Linear RGB, input of `color_camera.expose`.
    fruit : ndarray of int32, shape (H, W)
        Index of the visible fruit of each pixel; -1 for anything else.
    """

    linear: Array
    fruit: NDArray[np.int32]


def path_trace(
    scene: Scene,
    camera: Intrinsics,
    style: Style,
    assets: Assets,
    rng: np.random.Generator,
    samples: int = 6,
) -> Traced:
    """Render a scene with Cycles on one processor core.

    Parameters
    ----------
    scene : Scene
        Scene in camera coordinates. Its leaves get waves, teeth and stalks.
    camera : Intrinsics
        The camera; distortion is ignored.
    style : Style
        Appearance of each body.
    assets : Assets
        Picture assets.
    rng : numpy.random.Generator
        Random generator.
    samples : int
        Paths per pixel; the noise that is left is removed by Open Image Denoise.

    Returns
    -------
    Traced
        Picture, and the visible fruit of each pixel.

    Raises
    ------
    DataSetError
        If Blender's module `bpy` is not installed.
    """
    stage = _Stage(_blender(), scene, style, assets, rng)
    stage.empty()
    stage.add_fruit()
    stage.add_leaves()
    stage.add_stems()
    stage.add_benches()
    stage.light_up()
    stage.place_camera(camera)
    picture = stage.render(samples)
    fruit = np.rint(stage.render_indices()).astype(np.int32) - 1
    opacity = picture[..., 3:]
    background = far_view(rng, style.far, camera.width, camera.height, assets)
    return Traced(np.asarray(picture[..., :3] + (1 - opacity) * background, np.float32), fruit)


def _blender() -> Any:
    try:
        import bpy
    except ImportError as error:
        # No extra of ours: it asks for NumPy 1, but does without.
        raise DataSetError(
            "path-traced pictures need Blender's module bpy",
            source="--samples",
            remedy="pip install --no-deps 'bpy==4.5.*' (Python 3.11)",
        ) from error
    return bpy


@dataclass(frozen=True, eq=False)
class _Stage:
    """The bodies of a scene, added one kind after another to Blender's only open file."""

    bpy: Any
    scene: Scene
    style: Style
    assets: Assets
    rng: np.random.Generator

    def empty(self) -> None:
        self.bpy.ops.wm.read_factory_settings(use_empty=True)

    def add_fruit(self) -> None:
        for index, tube in enumerate(self.scene.fruit):
            skin = self.style.skins[index]
            length, radius = tube.centreline_m, float(np.quantile(tube.radii_m, 0.8))
            maps = skin_maps(self.rng, skin, length, radius, 0.0007, self.assets)
            material = self._material(
                f"skin {index}",
                self._image(maps.albedo),
                roughness=0.6 - 0.3 * skin.gloss,
                bump=(self._image(maps.height_m), 1.0),
            )
            self._mesh(f"fruit {index}", *_tube_mesh(tube), material, number=index + 1)

    def add_leaves(self) -> None:
        numbers = self.rng.integers(LEAF_TEXTURES, size=5)
        photos = [leaf_photo_texture(self.rng, self.assets) for _ in numbers]
        looks: dict[tuple[int, int], Any] = {}
        pairs = zip(self.scene.stems, self.style.stem_roles, strict=True)
        targets = _points_on([stem for stem, role in pairs if role in ("stem", "string")])
        stalk = self._plain("leaf stalk", (104.0, 136.0, 72.0))
        for index, leaf in enumerate(self.scene.leaves):
            withered = self.style.leaf_roles[index] == "blossom"
            look = int(self.rng.integers(len(numbers))), -1 if withered else index % 7
            if withered or look not in looks:
                looks[look] = self._leaf_material(
                    f"leaf {index}",
                    leaf_texture(int(numbers[look[0]])),
                    photos[look[0]],
                    self.style.leaf_colors[index],
                    withered=withered,
                )
            self._mesh(f"leaf {index}", *_leaf_mesh(leaf, self.rng), looks[look])
            if not withered and len(targets):
                self._line(f"leaf stalk {index}", *_leaf_stalk(leaf, targets, self.rng), stalk)
        self._add_shading_leaves(next(iter(looks.values()), None))

    def _add_shading_leaves(self, material: Any) -> None:
        """Add leaves that the camera does not see, between the scene and the light."""
        if material is None or self.style.light.shade == 0:
            return
        sun = np.asarray(self.style.light.sun)
        middle = np.array([0.0, 0.0, 0.7])
        for index in range(int(self.rng.poisson(_SHADING_LEAVES * self.style.light.shade))):
            position = middle + sun * self.rng.uniform(0.4, 1.2) + self.rng.normal(0, 0.3, 3)
            turn = rotation(*self.rng.uniform(0, 360, 3))
            half = float(self.rng.uniform(0.06, 0.12))
            blade = _leaf_mesh(Leaf(position, turn.T, half, 0.8 * half, (0.0, 0.0), 0.1), self.rng)
            self._mesh(f"shade {index}", *blade, material).visible_camera = False

    def add_stems(self) -> None:
        for index, stem in enumerate(self.scene.stems):
            material = self._plain(f"stem {index}", self.style.stem_colors[index])
            self._line(f"stem {index}", stem.vertices_m, stem.radius_m, material)

    def add_benches(self) -> None:
        for index, plane in enumerate(self.scene.planes):
            name = self.style.materials[index]
            if name == FAR:
                continue
            tile = material_tile(self.rng, name, self.style.material_colors[index], 0.001)
            material = self._material(f"bench {index}", self._image(tile), roughness=0.6)
            self._mesh(f"bench {index}", *_plane_mesh(plane), material)

    def light_up(self) -> None:
        light = self.style.light
        sky, frame = sky_map(self.rng, light, self.assets)
        world = self.bpy.data.worlds.new("world")
        self.bpy.context.scene.world = world
        world.use_nodes = True
        nodes, links = world.node_tree.nodes, world.node_tree.links
        picture = nodes.new("ShaderNodeTexEnvironment")
        picture.image = self._image(sky[::-1])
        coordinates, turn = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeMapping")
        turn.inputs["Rotation"].default_value = _euler(frame @ _TO_BLENDER)
        links.new(coordinates.outputs["Generated"], turn.inputs["Vector"])
        links.new(turn.outputs["Vector"], picture.inputs["Vector"])
        links.new(picture.outputs["Color"], nodes["Background"].inputs["Color"])
        if light.sun_strength > 0:
            self._add_sun(light)

    def _add_sun(self, light: Light) -> None:
        sun = self.bpy.data.lights.new("sun", "SUN")
        sun.energy = np.pi * light.sun_strength
        sun.color = np.asarray(light.sun_color) / max(light.sun_color)
        sun.angle = np.deg2rad(self.rng.uniform(0.5, 6.0))  # glass and film scatter its light
        body = self.bpy.data.objects.new("sun", sun)
        towards = _TO_BLENDER @ np.asarray(light.sun)
        aside = np.cross((0.3, 0.5, 0.8), towards)
        aside /= np.linalg.norm(aside)
        body.rotation_euler = _euler(np.stack([aside, np.cross(towards, aside), towards], axis=1))
        self.bpy.context.collection.objects.link(body)

    def place_camera(self, camera: Intrinsics) -> None:
        lens = self.bpy.data.cameras.new("camera")
        lens.sensor_width, lens.lens = 36.0, 36.0 * camera.fx_px / camera.width
        lens.shift_x = -(camera.cx_px - (camera.width - 1) / 2) / camera.width
        lens.shift_y = (camera.cy_px - (camera.height - 1) / 2) / camera.width
        lens.clip_start, lens.clip_end = 0.02, 50.0
        body = self.bpy.data.objects.new("camera", lens)
        self.bpy.context.collection.objects.link(body)
        scene = self.bpy.context.scene
        scene.camera = body
        scene.render.resolution_x, scene.render.resolution_y = camera.width, camera.height
        scene.render.resolution_percentage = 100

    def render(self, samples: int) -> Array:
        scene = self.bpy.context.scene
        scene.render.engine, scene.render.use_persistent_data = "CYCLES", True
        scene.render.film_transparent = True
        scene.render.threads_mode, scene.render.threads = "FIXED", 1
        scene.view_settings.view_transform = "Raw"
        scene.render.image_settings.file_format = "OPEN_EXR"
        scene.render.image_settings.color_depth = "32"
        scene.render.image_settings.color_mode = "RGBA"
        cycles = scene.cycles
        cycles.device, cycles.samples, cycles.use_adaptive_sampling = "CPU", samples, False
        cycles.use_denoising, cycles.max_bounces, cycles.transparent_max_bounces = True, 4, 4
        cycles.denoising_quality, cycles.denoising_prefilter = "FAST", "FAST"
        cycles.caustics_reflective = cycles.caustics_refractive = False
        cycles.seed = int(self.rng.integers(2**31))
        return self._rendered()

    def render_indices(self) -> Array:
        """Return the number of the fruit that each pixel sees, 0 for none, shape (H, W)."""
        material = self.bpy.data.materials.new("index")
        material.use_nodes = True
        nodes, links = material.node_tree.nodes, material.node_tree.links
        nodes.clear()
        info, shine = nodes.new("ShaderNodeObjectInfo"), nodes.new("ShaderNodeEmission")
        out = nodes.new("ShaderNodeOutputMaterial")
        links.new(info.outputs["Object Index"], shine.inputs["Color"])
        links.new(shine.outputs["Emission"], out.inputs["Surface"])
        material.cycles.emission_sampling = "NONE"  # no lamps, which would take seconds to sort
        scene = self.bpy.context.scene
        scene.view_layers[0].material_override = material
        scene.cycles.samples, scene.cycles.use_denoising = 1, False
        scene.cycles.max_bounces, scene.cycles.filter_width = 0, 0.01
        return self._rendered()[..., 0]

    def _rendered(self) -> Array:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "picture.exr"
            self.bpy.context.scene.render.filepath = str(file)
            self.bpy.ops.render.render(write_still=True)
            picture = self.bpy.data.images.load(str(file))
            picture.colorspace_settings.name = "Non-Color"
            width, height = picture.size
            values = np.empty(width * height * 4, np.float32)
            picture.pixels.foreach_get(values)
        return np.ascontiguousarray(values.reshape(height, width, 4)[::-1])

    def _image(self, values: NDArray[Any]) -> Any:
        """Return an image of linear values, shape (H, W, 3) or (H, W), first row at v = 0."""
        height, width = values.shape[:2]
        image = self.bpy.data.images.new("values", width, height, float_buffer=True)
        image.colorspace_settings.name = "Non-Color"
        pixels = np.ones((height, width, 4), np.float32)
        pixels[..., :3] = values if values.ndim == 3 else values[..., None]
        image.pixels.foreach_set(pixels.ravel())
        image.pack()
        return image

    def _material(
        self,
        name: str,
        image: Any,
        *,
        roughness: float,
        bump: tuple[Any, float] | None = None,
        through: float = 0.0,
    ) -> Any:
        material = self.bpy.data.materials.new(name)
        material.use_nodes = True
        nodes, links = material.node_tree.nodes, material.node_tree.links
        body, out = nodes["Principled BSDF"], nodes["Material Output"]
        color = nodes.new("ShaderNodeTexImage")
        color.image = image
        links.new(color.outputs["Color"], body.inputs["Base Color"])
        body.inputs["Roughness"].default_value = roughness
        if bump is not None:
            height, shape = nodes.new("ShaderNodeTexImage"), nodes.new("ShaderNodeBump")
            height.image = bump[0]
            shape.inputs["Strength"].default_value = 1.0
            shape.inputs["Distance"].default_value = bump[1]
            links.new(height.outputs["Color"], shape.inputs["Height"])
            links.new(shape.outputs["Normal"], body.inputs["Normal"])
        if through > 0:
            tint, pass_on = nodes.new("ShaderNodeMixRGB"), nodes.new("ShaderNodeBsdfTranslucent")
            tint.blend_type = "MULTIPLY"
            tint.inputs["Fac"].default_value = 1.0
            tint.inputs["Color2"].default_value = (*_TRANSLUCENT, 1.0)
            links.new(color.outputs["Color"], tint.inputs["Color1"])
            links.new(tint.outputs["Color"], pass_on.inputs["Color"])
            mixture = nodes.new("ShaderNodeMixShader")
            mixture.inputs["Fac"].default_value = through
            links.new(body.outputs["BSDF"], mixture.inputs[1])
            links.new(pass_on.outputs["BSDF"], mixture.inputs[2])
            links.new(mixture.outputs["Shader"], out.inputs["Surface"])
        return material

    def _leaf_material(
        self,
        name: str,
        texture: Array,
        photo: tuple[Array, ...],
        color: Sequence[float],
        *,
        withered: bool,
    ) -> Any:
        vein = 0.0 if withered else float(self.rng.uniform(0.05, 0.4))
        share = vein * texture[..., 1:2]
        albedo = to_linear(color) * (1 - share) + to_linear((150, 168, 104)) * share
        albedo = albedo * texture[..., :1]
        if photo and not withered:
            albedo = albedo * (1 + self.style.leaf_photo * (photo[0] - 1))
        height = 0.8 - 0.8 * texture[..., 1] + 0.15 * smooth_noise(self.rng, texture.shape[:2], 14)
        return self._material(
            name,
            self._image(np.clip(albedo, 0.003, 0.85)),
            roughness=0.75 - 0.7 * self.style.leaf_gloss,
            bump=(self._image(height), 0.0025 * self.style.leaf_relief),
            through=float(self.rng.uniform(0.25, 0.45)),
        )

    def _plain(self, name: str, color: Sequence[float]) -> Any:
        grain = 1 + 0.25 * smooth_noise(self.rng, (64, 16), (6, 3), wrap=True)
        albedo = np.clip(to_linear(color) * grain[..., None], 0.003, 0.9)
        return self._material(name, self._image(albedo), roughness=0.6)

    def _mesh(
        self,
        name: str,
        vertices: NDArray[np.float64],
        faces: NDArray[np.intp],
        uv: NDArray[np.float64],
        material: Any,
        number: int = 0,
    ) -> Any:
        mesh = self.bpy.data.meshes.new(name)
        mesh.from_pydata((vertices @ _TO_BLENDER).tolist(), [], faces.tolist())
        layer = mesh.uv_layers.new(name="uv")
        layer.data.foreach_set("uv", uv[faces.ravel()].astype(np.float32).ravel())
        mesh.polygons.foreach_set("use_smooth", np.ones(len(faces), np.bool_))
        mesh.materials.append(material)
        body = self.bpy.data.objects.new(name, mesh)
        body.pass_index = number
        self.bpy.context.collection.objects.link(body)
        return body

    def _line(self, name: str, line_m: NDArray[np.float64], radius_m: float, material: Any) -> None:
        curve = self.bpy.data.curves.new(name, "CURVE")
        curve.dimensions, curve.bevel_depth, curve.bevel_resolution = "3D", radius_m, 3
        curve.use_fill_caps = True
        spline = curve.splines.new("POLY")
        spline.points.add(len(line_m) - 1)
        points = np.column_stack([line_m @ _TO_BLENDER, np.ones(len(line_m))])
        spline.points.foreach_set("co", points.astype(np.float32).ravel())
        spline.use_smooth = True
        curve.materials.append(material)
        self.bpy.context.collection.objects.link(self.bpy.data.objects.new(name, curve))


_Mesh = tuple["NDArray[np.float64]", "NDArray[np.intp]", "NDArray[np.float64]"]


def _grid_faces(rows: int, columns: int) -> NDArray[np.intp]:
    """Return the quads of a grid of vertices, row by row, shape (N, 4)."""
    number = np.arange(rows * columns).reshape(rows, columns)
    corners = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    return np.stack([corner.ravel() for corner in corners], axis=1)


def _tube_mesh(tube: Tube) -> _Mesh:
    """Return vertices, quads and texture coordinates (around, along) of a fruit."""
    rows = np.unique(np.linspace(0, len(tube.radii_m) - 1, 70).round().astype(int))
    centres, radii = tube.centres_m[rows], tube.radii_m[rows]
    along = np.gradient(tube.centres_m, axis=0)[rows]
    along /= np.linalg.norm(along, axis=1)[:, None]
    angle = np.linspace(np.pi / 2, 0, _CAP_ROWS, endpoint=False)
    rise, width = np.sin(angle)[:, None], np.maximum(np.cos(angle), 1e-3)
    blossom = centres[0] - rise * radii[0] * along[0]
    stem = centres[-1] + rise[::-1] * radii[-1] * along[-1]
    spine = np.vstack([blossom, centres, stem])
    reach = np.concatenate([radii[0] * width, radii, radii[-1] * width[::-1]])
    axis = np.vstack(
        [np.repeat(along[:1], _CAP_ROWS, 0), along, np.repeat(along[-1:], _CAP_ROWS, 0)]
    )
    out = tube.outward - (axis @ tube.outward)[:, None] * axis
    out /= np.linalg.norm(out, axis=1)[:, None]
    aside = np.cross(axis, out)
    turn = np.linspace(0, 2 * np.pi, _COLUMNS + 1)[None, :, None]
    vertices = spine[:, None] + reach[:, None, None] * (
        np.cos(turn) * out[:, None] + np.sin(turn) * aside[:, None]
    )
    run = arc_positions(spine)
    v, u = np.meshgrid(run / run[-1], turn.ravel() / (2 * np.pi), indexing="ij")
    return (
        vertices.reshape(-1, 3),
        _grid_faces(len(spine), _COLUMNS + 1),
        np.stack([u.ravel(), v.ravel()], axis=1),
    )


def _leaf_mesh(leaf: Leaf, rng: np.random.Generator) -> _Mesh:
    """Return vertices, quads and texture coordinates of a blade with waves and a toothed edge."""
    angle = np.linspace(-np.pi, np.pi, _RIM + 1)
    large = leaf.half_length_m > 0.03
    rim = leaf_rim(angle, leaf.lobe, 0.025 if large else 0.0)
    share = np.linspace(0.02, 1, _RINGS)[:, None]
    p, q = share * rim * np.cos(angle), share * rim * np.sin(angle)
    s, t = p * leaf.half_length_m, q * leaf.half_width_m
    along, across = leaf.bend_per_m
    height = (along * s * s + across * t * t) / 2
    # The edge is longer than the flat outline, so it waves; the blade folds along its midrib.
    wave = rng.uniform(0.01, 0.05) * np.sin(rng.integers(3, 7) * angle + rng.uniform(0, 6))
    wave += rng.uniform(0.0, 0.02) * np.sin(11 * angle + rng.uniform(0, 6))
    height = height + share**2 * wave * leaf.half_width_m
    height += rng.uniform(-0.05, 0.25) * np.abs(t) * (1.0 if large else 0.0)
    local = np.stack([s, t, height], axis=-1).reshape(-1, 3)
    uv = (np.stack([p, q], axis=-1).reshape(-1, 2) / LEAF_REACH + 1) / 2
    return leaf.centre_m + local @ leaf.frame, _grid_faces(_RINGS, _RIM + 1), uv


def _points_on(stems: Sequence[Stem]) -> NDArray[np.float64]:
    """Return points along all stems, shape (N, 3)."""
    shares = np.linspace(0, 1, 60)
    return np.vstack([np.empty((0, 3)), *(points_along(stem.vertices_m, shares) for stem in stems)])


def _leaf_stalk(
    leaf: Leaf, targets: NDArray[np.float64], rng: np.random.Generator
) -> tuple[NDArray[np.float64], float]:
    """Return polyline and radius of a leaf's stalk, towards a point of the stems near by."""
    base = leaf.centre_m - 0.62 * leaf.half_length_m * leaf.frame[0]
    away = np.linalg.norm(targets - base, axis=1)
    end = targets[int(np.argmin(np.abs(away - 0.12)))]
    reach = float(np.linalg.norm(end - base))
    if reach > 0.3:
        end = base + (end - base) * (0.3 / reach)
    share = np.linspace(0, 1, 7)[:, None]
    sag = rng.normal(0, 0.08, 3) * float(np.linalg.norm(end - base))
    return base + share * (end - base) + 4 * share * (1 - share) * sag, float(
        rng.uniform(0.0018, 0.0035)
    )


def _plane_mesh(plane: Plane) -> _Mesh:
    """Return a square of 6 m, with texture coordinates in tiles."""
    corners = 3.0 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], float)
    return plane.point_m + corners @ plane.tile_axes(), np.array([[0, 1, 2, 3]]), corners / TILE_M


def _euler(turn: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return the XYZ Euler angles of a rotation matrix, radians."""
    from scipy.spatial.transform import Rotation

    x, y, z = Rotation.from_matrix(turn).as_euler("xyz").tolist()
    return x, y, z
