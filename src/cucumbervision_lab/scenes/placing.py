"""Place fruit: hanging in a canopy, or lying on a surface or in a crate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision_lab.arrays import Array, Generator
from cucumbervision_lab.scenes.bodies import Tube, rotation
from cucumbervision_lab.scenes.scene import (
    Hit,
    Leaf,
    Plane,
    Scene,
    Stem,
    cast_leaf,
    cast_tube,
    scaled_camera,
)

_COARSE = 0.5  # resolution factor of the search for a leaf's size

_SEARCH_STEPS = 14
_LEAN = 0.03  # standard deviation of a string's inclination and bow, relative to the height

_THICKEST_STRING_M = 0.0025

_NEAREST = 0.4  # maximum distance of a leaf from its fruit, as a share of the fruit's distance


def foliage(
    rng: Generator,
    camera: Intrinsics,
    distance_m: float,
    depth_m: float = 0.35,
    density: float = 1.6,
) -> tuple[Leaf, ...]:
    """Generate a layer of leaves that fills the picture.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator.
    camera : Intrinsics
        The camera.
    distance_m, depth_m : float
        Distance and thickness of the layer, metres.
    density : float
        Leaf area per area of the view.

    Returns
    -------
    tuple of Leaf
        Leaves from far to near.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> camera = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    >>> leaves = foliage(np.random.default_rng(1), camera, 0.7)
    >>> len(leaves) > 20, bool(min(leaf.centre_m[2] for leaf in leaves) >= 0.7)
    (True, True)
    """
    first_ray = np.array(camera.rays(0.0, 0.0))
    last_ray = np.array(camera.rays(camera.width - 1.0, camera.height - 1.0))
    middle = distance_m + depth_m / 2
    area, filled, leaves = float(np.prod(last_ray - first_ray)) * middle**2, 0.0, []
    while filled < density * area:
        length, slim = rng.uniform(0.06, 0.12), rng.uniform(0.7, 0.95)
        z = rng.uniform(distance_m, distance_m + depth_m)
        spot = rng.uniform(1.1 * first_ray, 1.1 * last_ray) * z
        leaves.append(_leaf(rng, (spot[0], spot[1], z), length, slim * length))
        filled += np.pi * slim * length**2
    return tuple(sorted(leaves, key=lambda leaf: -float(leaf.centre_m[2])))


def _leaf(
    rng: Generator, centre_m: tuple[float, float, float], length_m: float, width_m: float
) -> Leaf:
    # Blades face the light, that is up and towards the camera.
    turn = rotation(rng.uniform(0, 360), rng.normal(0, 25), rng.normal(0, 25))
    lean = rotation(spin_deg=rng.uniform(-10, 50))
    bend = rng.normal(0, 1.5, 2)
    return Leaf(
        np.array(centre_m),
        (lean @ turn).T,
        length_m,
        width_m,
        (float(bend[0]), float(bend[1])),
        rng.uniform(0.05, 0.18),
    )


def string(rng: Generator, x_m: float, z_m: float, radius_m: float = 0.0015) -> Stem:
    """Generate a string or stem that crosses the view vertically.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator.
    x_m, z_m : float
        Position at the height of the camera, metres.
    radius_m : float
        Radius, metres: 1 to 2 mm for a string, 4 to 6 mm for a main stem.
    """
    y = np.linspace(-1.2, 1.2, 9) * z_m
    x = x_m + rng.normal(0, _LEAN) * y + rng.normal(0, _LEAN) * np.cos(2 * y / z_m) * 0.3 * z_m
    z = z_m + rng.normal(0, _LEAN) * y
    role = "string" if radius_m < _THICKEST_STRING_M else "stem"
    return Stem(np.stack([x, y, z], axis=1), radius_m, role)


def trellis(
    rng: Generator, camera: Intrinsics, fruit: tuple[Tube, ...], behind_m: float = 0.15
) -> Scene:
    """Add leaves, strings, stems and a distant wall behind hanging fruit.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator.
    camera : Intrinsics
        The camera.
    fruit : tuple of Tube
        Fruit in camera coordinates.
    behind_m : float
        Distance between the fruit and the leaves, metres.

    Returns
    -------
    Scene
        Scene without occlusion of fruit by leaves; see `occlude`.
    """
    rearmost_m = max(float((f.centres_m[:, 2] + f.radii_m).max()) for f in fruit)
    # Leaves can extend forward by their length.
    leaves = foliage(rng, camera, rearmost_m + behind_m + 0.10)
    half = camera.width / (2 * camera.fx_px) * (rearmost_m + behind_m)
    stems = [
        string(rng, x, rearmost_m + behind_m, radius)
        for x, radius in zip(
            rng.uniform(-half, half, 4), (0.0015, 0.0015, 0.004, 0.005), strict=True
        )
    ]
    wall = Plane.facing(rearmost_m + behind_m + rng.uniform(0.7, 1.5), *rng.uniform(-10, 10, 2))
    return Scene(fruit, leaves, tuple(stems), (wall,))


def occlude(
    scene: Scene,
    camera: Intrinsics,
    index: int,
    hidden_share: float,
    rng: Generator,
    *,
    ends_free: bool = True,
) -> Scene:
    """Add a leaf that occludes a given share of a fruit.

    Parameters
    ----------
    scene : Scene
        Scene in which the fruit is not occluded.
    camera : Intrinsics
        The camera.
    index : int
        Index of the fruit.
    hidden_share : float
        Share of pixels to occlude, up to 0.6 with free ends, otherwise up to 0.9.
    rng : numpy.random.Generator
        Random generator.
    ends_free : bool
        Keep both ends visible; otherwise the leaf occludes one end.

    Returns
    -------
    Scene
        Scene with the leaf. The share is approximate; `truth_of` returns the exact one. The given
        scene if such a leaf would extend behind the camera.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> from cucumbervision_lab.scenes.scene import truth_of
    >>> from cucumbervision_lab.scenes.bodies import arc_tube
    >>> camera = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
    >>> bare = Scene((arc_tube(0.25, 0.02).moved(rotation(-90), (0.0, 0.0, 0.5)),))
    >>> covered = occlude(bare, camera, 0, 0.3, np.random.default_rng(1))
    >>> truth, = truth_of(covered, camera)
    >>> round(truth.hidden_share, 1), truth.keypoint_visibility[[0, 4]].tolist()
    (0.3, [2, 2])
    """
    if hidden_share <= 0:
        return scene
    tube = scene.fruit[index]
    rough = scaled_camera(camera, _COARSE)
    fruit = cast_tube(tube, rough)
    if fruit is None:
        return scene
    before = rng.uniform(0.02, 0.06)
    bend = float(rng.uniform(-1, 1)), float(rng.uniform(-1, 1))
    where = 0.5 + rng.uniform(-0.5, 0.5) * (0.75 - hidden_share) if ends_free else 0.0
    if not ends_free and rng.random() < 0.5:
        where = 1.0
    # Half the share would suffice for a rectangular leaf, but this one has lobes.
    shortest, longest = 0.0, (0.9 if ends_free else 1.8) * hidden_share
    for _ in range(_SEARCH_STEPS):
        reach = (shortest + longest) / 2
        leaf = _blade(tube, where, reach, before, bend)
        if in_front(leaf) and _hides(leaf, fruit, rough) < hidden_share:
            shortest = reach
        else:
            longest = reach
    return replace(scene, leaves=(*scene.leaves, leaf)) if in_front(leaf) else scene


def in_front(leaf: Leaf) -> bool:
    """Return whether all of a leaf is at least 5 cm in front of the camera."""
    reach = 1.3 * max(leaf.half_length_m, leaf.half_width_m)
    return float(leaf.centre_m[2]) - reach > 0.05


def _blade(
    tube: Tube, where: float, reach: float, before_m: float, bend_per_m: tuple[float, float]
) -> Leaf:
    k = round(where * (len(tube.radii_m) - 1))
    ahead, behind = min(k + 1, len(tube.radii_m) - 1), max(k - 1, 0)
    along = tube.centres_m[ahead] - tube.centres_m[behind]
    along /= np.linalg.norm(along)
    # Parallel to the fruit, on the camera ray through the point to occlude.
    distance = float(np.linalg.norm(tube.centres_m[k]))
    sight = -tube.centres_m[k] / distance
    off = sight - (sight @ along) * along
    off /= np.linalg.norm(off)
    radius = float(tube.radii_m.max())
    away = min((radius + before_m) / max(float(sight @ off), 0.3), _NEAREST * distance)
    return Leaf(
        tube.centres_m[k] + away * sight,
        np.stack([along, np.cross(off, along), off]),
        max(reach * tube.centreline_m, 1e-4),
        3.0 * radius,
        bend_per_m,
        0.1,
    )


def _hides(leaf: Leaf, fruit: Hit, camera: Intrinsics) -> float:
    blade = cast_leaf(leaf, camera)
    if blade is None:
        return 0.0
    before = np.full((camera.height, camera.width), np.inf)
    before[blade.window] = blade.depth_m
    hidden = fruit.mask & (before[fruit.window] < fruit.depth_m)
    return float(hidden.sum() / fruit.mask.sum())


_STEEPEST_DEG = 55.0

NEAREST_M = 0.24  # minimum distance of bodies from the camera

_TESTED_STEP = 8  # every eighth sphere of a body is used for collision tests

_TRIES = 12


@dataclass(frozen=True, eq=False)
class Ground:
    """A horizontal surface viewed from above.

    Parameters
    ----------
    point_m : ndarray of float64, shape (3,)
        Intersection with the optical axis, camera coordinates, metres.
    frame : ndarray of float64, shape (3, 3)
        Rows: two unit vectors in the surface, and its normal towards the camera.
    """

    point_m: Array
    frame: Array

    @classmethod
    def seen(cls, rng: Generator, distance_m: float) -> Ground:
        """Sample a surface viewed from 0 to 55 degrees off the vertical, at any heading.

        Examples
        --------
        >>> ground = Ground.seen(np.random.default_rng(1), 0.6)
        >>> bool(np.allclose(ground.frame @ ground.frame.T, np.eye(3)))
        True
        """
        off = np.deg2rad(rng.uniform(0, _STEEPEST_DEG))
        angle = rng.normal(0, 0.15) if rng.random() < 0.7 else rng.uniform(0, 2 * np.pi)
        # The far side of a bench is at the top of the picture (y points down).
        normal = np.array([0.0, -np.sin(off), -np.cos(off)])
        across = np.array([1.0, 0.0, 0.0])
        turn = rotation(roll_deg=float(np.rad2deg(angle)))
        frame = np.stack([across, np.cross(normal, across), normal]) @ turn.T
        return cls(np.array([0.0, 0.0, distance_m]), frame)

    @property
    def plane(self) -> Plane:
        """The surface as a plane."""
        return Plane(self.point_m, self.frame[2])

    def at(self, x_m: float, y_m: float, height_m: float) -> Array:
        """Return a point from surface coordinates and height, metres."""
        return np.asarray(self.point_m + np.array([x_m, y_m, height_m]) @ self.frame)

    def below(self, camera: Intrinsics, u: float, v: float) -> tuple[float, float]:
        """Return the surface coordinates seen by a pixel, metres."""
        x, y = camera.rays(u, v)
        ray = np.array([float(x), float(y), 1.0])
        met = ray * float(self.frame[2] @ self.point_m) / float(self.frame[2] @ ray)
        place = self.frame @ (met - self.point_m)
        return float(place[0]), float(place[1])


def place_lying(
    rng: Generator,
    camera: Intrinsics,
    ground: Ground,
    bodies: Sequence[Tube],
    inner_m: tuple[float, float] | None = None,
) -> list[Tube]:
    """Place bodies on a surface one after another.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator.
    camera : Intrinsics
        The camera; on an open surface, bodies are placed inside its view.
    ground : Ground
        The surface.
    bodies : sequence of Tube
        Planar fruit from `random_fruit`.
    inner_m : tuple of float, optional
        Length and width of a crate centred on the optical axis; bodies are roughly parallel to its
        length.

    Returns
    -------
    list of Tube
        Bodies in camera coordinates that do not intersect, without those too close to the camera.

    Notes
    -----
    A body stays horizontal and is lowered until it touches the surface or another body. The lowest
    of several random positions is used, so that fruit on an open surface are rarely stacked.
    """
    placed: list[Tube] = []
    lain: list[tuple[Array, Array]] = []
    for body in bodies:
        best = None
        for _ in range(_TRIES if inner_m is None else _TRIES // 3):
            spot, turn = _spot(rng, camera, ground, body, inner_m)
            flat = body.centres_m[::_TESTED_STEP] @ turn.T + np.array([*spot, 0.0])
            height = _rest(flat, body.radii_m[::_TESTED_STEP], lain)
            if best is None or height < best[0]:
                best = height, flat, turn, spot
        if best is None:
            continue
        height, flat, turn, spot = best
        lying = body.moved(turn, (*spot, height))
        in_view = lying.moved(ground.frame.T, ground.point_m)
        if in_view.centres_m[:, 2].min() < NEAREST_M:
            continue
        lain.append((flat + np.array([0.0, 0.0, height]), body.radii_m[::_TESTED_STEP]))
        placed.append(in_view)
    return placed


def _spot(
    rng: Generator,
    camera: Intrinsics,
    ground: Ground,
    body: Tube,
    inner_m: tuple[float, float] | None,
) -> tuple[tuple[float, float], Array]:
    """Sample a position and a rotation to ground coordinates."""
    if inner_m is None:
        yaw = rng.uniform(0, 2 * np.pi)
        u, v = rng.uniform(0.08, 0.92) * camera.width, rng.uniform(0.1, 0.9) * camera.height
        spot = ground.below(camera, u, v)
    else:
        yaw = rng.normal(0, 0.12) + np.pi * rng.integers(2)
        room = np.array(inner_m) / 2 - np.array([body.chord_m / 2, float(body.radii_m.max())])
        x, y = rng.uniform(-1, 1, 2) * np.maximum(room, 0)
        spot = float(x), float(y)
    cos, sin = np.cos(yaw), np.sin(yaw)
    over = rng.choice([-1.0, 1.0])  # either side may face down
    turn = np.array([[cos, -sin * over, 0.0], [sin, cos * over, 0.0], [0.0, 0.0, over]])
    return spot, turn


def _rest(flat_m: Array, radii_m: Array, lain: Sequence[tuple[Array, Array]]) -> float:
    """Return the height at which a lowered body touches the ground or another body."""
    height = float((radii_m - flat_m[:, 2]).max())
    for centres, radii in lain:
        across = ((flat_m[:, None, :2] - centres[None, :, :2]) ** 2).sum(axis=2)
        reach = (radii_m[:, None] + radii[None]) ** 2 - across
        touch = centres[None, :, 2] + np.sqrt(np.maximum(reach, 0)) - flat_m[:, None, 2]
        if (reach > 0).any():
            height = max(height, float(touch[reach > 0].max()))
    return height


def crate_rods(rng: Generator, ground: Ground, inner_m: tuple[float, float]) -> tuple[Stem, ...]:
    """Create a crate of bars around the centre of the ground.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator for height, thickness and number of bars.
    ground : Ground
        The surface.
    inner_m : tuple of float
        Inner length and width, metres.

    Returns
    -------
    tuple of Stem
        Horizontal bars and corner posts, without those that extend behind the camera.
    """
    radius = float(rng.uniform(0.004, 0.009))
    height = float(rng.uniform(0.07, 0.16))
    x, y = inner_m[0] / 2 + radius, inner_m[1] / 2 + radius
    corners = [(-x, -y), (x, -y), (x, y), (-x, y)]
    bars = []
    for level in np.linspace(radius, height, int(rng.integers(3, 7))):
        ring = [ground.at(*corner, float(level)) for corner in corners]
        bars += [np.stack([ring[k], ring[(k + 1) % 4]]) for k in range(4)]
    bars += [np.stack([ground.at(*c, radius), ground.at(*c, height)]) for c in corners]
    return tuple(Stem(bar, radius, "crate") for bar in bars if bar[:, 2].min() > NEAREST_M / 2)
