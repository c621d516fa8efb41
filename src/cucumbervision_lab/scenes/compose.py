"""Compose random scenes: fruit on the plant, on a bench or in a crate, with a handheld camera.

All bodies are in camera coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision_lab.arrays import Array, Generator
from cucumbervision_lab.scenes import placing
from cucumbervision_lab.scenes.bodies import SIZES, Tube, Variety, random_fruit, rotation
from cucumbervision_lab.scenes.scene import Leaf, Scene, Stem

MOST_FRUIT = 12
_TRIES = 30
# Of fruit that are bent to a bow; of scenes with a petiole, a stem or a pipe across a fruit.
_BOW_SHARE, _PETIOLE_SHARE, _STEM_SHARE, _PIPE_SHARE = 0.1, 0.25, 0.25, 0.1


class Setting(StrEnum):
    """Setting of a scene."""

    HANGING = "hanging"
    BENCH = "bench"
    CRATE = "crate"


@dataclass(frozen=True, eq=False)
class Composition:
    """A composed scene.

    Parameters
    ----------
    scene : Scene
        The scene in camera coordinates.
    setting : Setting
        Setting of the scene.
    variety : Variety
        Variety of all cucumbers.
    up : tuple of float
        Unit vector against gravity, camera coordinates.
    """

    scene: Scene
    setting: Setting
    variety: Variety
    up: tuple[float, float, float]


@dataclass(frozen=True)
class Difficulty:
    """How difficult a scene is for a detector.

    Parameters
    ----------
    nearer, farther : float
        Factors for the minimum and maximum distance.
    stop : float
        Parameter of the geometric distribution of the number of fruit on a plant or bench.
    most : int
        Maximum number of fruit.
    covered : float
        Probability that a leaf occludes a fruit on the plant.
    leaves : float
        Factor for the number of loose leaves in the foreground.
    slim : float
        Factor for the least radius of a variety.
    """

    nearer: float = 1.0
    farther: float = 1.0
    stop: float = 0.28
    most: int = MOST_FRUIT
    covered: float = 0.45
    leaves: float = 1.0
    slim: float = 1.0


PLAIN = Difficulty()
"""Difficulty of test scenes."""

HARD = Difficulty(nearer=0.75, farther=1.9, stop=0.16, most=18, covered=0.65, leaves=1.5, slim=0.65)
"""Difficulty for training: smaller, larger and slimmer fruit, more crowded and more occluded.

Their fruit are 3.5 to 11 diameters long (5th to 95th percentile), as 320 of a breeding trial are
by length; those of `PLAIN` 3 to 8.5.
"""


def compose(
    rng: Generator, camera: Intrinsics, setting: Setting | str, difficulty: Difficulty = PLAIN
) -> Composition:
    """Compose a random scene.

    Parameters
    ----------
    rng : numpy.random.Generator
        Random generator.
    camera : Intrinsics
        The camera.
    setting : Setting or str
        Setting of the scene.
    difficulty : Difficulty
        Difficulty of the scene.

    Returns
    -------
    Composition
        Scene of cucumbers that do not intersect; for `PLAIN`, 0 to 12 at 0.3 to 1.2 m.

    Raises
    ------
    ValueError
        If the setting is unknown.

    Examples
    --------
    >>> from cucumbervision.capture.intrinsics import Intrinsics
    >>> camera = Intrinsics(320, 180, 228.0, 228.0, 160.0, 90.0)
    >>> staged = compose(np.random.default_rng(4), camera, "bench")
    >>> len(staged.scene.fruit) <= MOST_FRUIT + 2, staged.setting.value
    (True, 'bench')
    """
    setting = Setting(setting)
    shares = [sizes.share for sizes in SIZES.values()]
    variety = list(SIZES)[int(rng.choice(len(shares), p=shares))]
    nearest, farthest = SIZES[variety].distance_m
    nearest, farthest = nearest * difficulty.nearer, farthest * difficulty.farther
    distance = float(np.exp(rng.uniform(np.log(nearest), np.log(farthest))))
    count = _count(rng, setting, difficulty)
    if setting is Setting.HANGING:
        return _compose_hanging(rng, camera, variety, distance, count, difficulty)
    return _compose_lying(rng, camera, setting, variety, distance, count, difficulty.slim)


def _count(rng: Generator, setting: Setting, difficulty: Difficulty) -> int:
    if setting is Setting.CRATE:
        return int(rng.integers(4, difficulty.most + 1))
    # 8 % of the pictures show no fruit, as negatives.
    return 0 if rng.random() < 0.08 else int(min(rng.geometric(difficulty.stop), difficulty.most))


def _random_of_variety(rng: Generator, variety: Variety, slim: float = 1.0) -> Tube:
    length_m = float(rng.uniform(*SIZES[variety].length_m))
    bend_m = length_m * float(rng.uniform(0.4, 0.9)) if rng.random() < _BOW_SHARE else None
    return random_fruit(rng, length_m, variety, bend_radius_m=bend_m, balls=400, slim=slim)


def _compose_hanging(
    rng: Generator,
    camera: Intrinsics,
    variety: Variety,
    distance_m: float,
    count: int,
    difficulty: Difficulty,
) -> Composition:
    placed: list[Tube] = []
    for _ in range(count):
        for _ in range(_TRIES):
            fruit = _random_hanging(rng, camera, variety, distance_m, difficulty.slim)
            if fruit.centres_m[:, 2].min() > placing.NEAREST_M + 0.03 and _is_separate(
                fruit, placed
            ):
                placed.append(fruit)
                break
    scene = _behind(rng, camera, tuple(placed), distance_m)
    for index in range(len(placed)):
        if rng.random() < difficulty.covered:
            share, free = float(rng.uniform(0.05, 0.6)), bool(rng.random() < 0.55)
            scene = placing.occlude(scene, camera, index, share, rng, ends_free=free)
    before = _loose_leaves(rng, camera, distance_m, difficulty.leaves, close=not placed)
    crossing = _crossing(rng, placed[int(rng.integers(len(placed)))]) if placed else ()
    petals, rods = _end_details(rng, placed)
    strings = _strings_before(rng, distance_m)
    scene = replace(
        scene,
        leaves=(*scene.leaves, *before, *petals),
        stems=(*scene.stems, *rods, *crossing, *strings),
    )
    scene, up = _tilt_view(rng, scene)
    return Composition(scene, Setting.HANGING, variety, up)


def _random_hanging(
    rng: Generator, camera: Intrinsics, variety: Variety, distance_m: float, slim: float
) -> Tube:
    z = distance_m * rng.uniform(0.88, 1.2)
    u, v = rng.uniform(0.04, 0.96) * camera.width, rng.uniform(0.06, 0.94) * camera.height
    x, y = (float(r) for r in camera.rays(u, v))
    fruit = _random_of_variety(rng, variety, slim)
    roll, tilt = -90.0 + rng.normal(0, 14), float(np.clip(rng.normal(0, 20), -65, 65))
    return fruit.moved(rotation(roll, tilt, rng.uniform(0, 360)), (x * z, y * z, z))


def _behind(
    rng: Generator, camera: Intrinsics, fruit: tuple[Tube, ...], distance_m: float
) -> Scene:
    if fruit:
        return placing.trellis(rng, camera, fruit, behind_m=float(rng.uniform(0.0, 0.25)))
    stand_in = _random_of_variety(rng, Variety.MINI).moved(rotation(-90.0), (0, 0, distance_m))
    return replace(placing.trellis(rng, camera, (stand_in,)), fruit=())


def _loose_leaves(
    rng: Generator, camera: Intrinsics, distance_m: float, factor: float, *, close: bool
) -> tuple[Leaf, ...]:
    leaves = []
    # Without fruit, leaves are near: leaves that fill the picture cause many false positives.
    many, nearest = (5.0, 0.3) if close else (2.2, 0.6)
    for _ in range(int(rng.poisson(factor * many))):
        length = rng.uniform(0.05, 0.11)
        z = distance_m * rng.uniform(nearest, 1.1)
        u, v = rng.uniform(0, camera.width), rng.uniform(0, camera.height)
        x, y = (float(r) for r in camera.rays(u, v))
        turn = rotation(rng.uniform(0, 360), rng.normal(0, 35), rng.uniform(-20, 60))
        leaf = Leaf(
            np.array([x * z, y * z, z]),
            turn.T,
            length,
            length * rng.uniform(0.7, 0.95),
            (float(rng.normal(0, 2)), float(rng.normal(0, 2))),
            rng.uniform(0.05, 0.18),
        )
        if placing.in_front(leaf):
            leaves.append(leaf)
    return tuple(leaves)


def _strings_before(rng: Generator, distance_m: float) -> tuple[Stem, ...]:
    count = int(rng.random() < 0.3) + int(rng.random() < 0.1)
    return tuple(
        placing.string(
            rng, rng.uniform(-0.4, 0.4) * distance_m, distance_m * rng.uniform(0.75, 0.95)
        )
        for _ in range(count)
    )


def _crossing(rng: Generator, fruit: Tube) -> tuple[Stem, ...]:
    """Return a petiole before a fruit, a stem and a pipe behind it, each or none of them."""
    middle = fruit.centres_m[int(rng.uniform(0.15, 0.85) * len(fruit.centres_m))]
    radius_m = float(fruit.radii_m.max())
    rods = []
    for share, off_m, thick_m, half_m, turn in (
        (_PETIOLE_SHARE, -radius_m - rng.uniform(0.01, 0.05), rng.uniform(0.002, 0.004), 0.15, 60),
        (_STEM_SHARE, radius_m + rng.uniform(0.01, 0.06), rng.uniform(0.004, 0.007), 0.6, 15),
        (_PIPE_SHARE, radius_m + rng.uniform(0.06, 0.2), rng.uniform(0.02, 0.03), 1.5, 0),
    ):
        angle = np.deg2rad(rng.normal(0, 5) if turn == 0 else rng.normal(90, turn))
        along = np.array([np.cos(angle), np.sin(angle), rng.normal(0, 0.1)])
        place = middle * (1 + off_m / middle[2]) + rng.normal(0, 0.5 * radius_m, 3) * (1, 1, 0)
        if rng.random() < share and place[2] - 0.2 * half_m > placing.NEAREST_M:
            line = np.stack([place - half_m * along, place + half_m * along])
            rods.append(Stem(line, thick_m, "string" if thick_m > 0.01 else "stem"))
    return tuple(rods)


def _end_details(
    rng: Generator, fruit_list: Sequence[Tube]
) -> tuple[tuple[Leaf, ...], tuple[Stem, ...]]:
    """Return the withered blossoms and the stalks of fruit, which identify their ends."""
    petals: list[Leaf] = []
    rods: list[Stem] = []
    for fruit in fruit_list:
        blossom, stem = fruit.poles_m
        if rng.random() < 0.85:
            rods.append(_stalk(rng, stem, fruit.centres_m[-1], float(fruit.radii_m.max())))
        if rng.random() >= 0.45:
            continue
        out = blossom - fruit.centres_m[0]
        out /= np.linalg.norm(out)
        tip = blossom + out * rng.uniform(0.004, 0.014)
        line = np.stack([blossom - 0.002 * out, tip])
        rods.append(Stem(line, rng.uniform(0.002, 0.004), "blossom"))
        for _ in range(int(rng.integers(0, 5))):
            turn = rotation(rng.uniform(0, 360), rng.uniform(-70, 70), rng.uniform(0, 360))
            length = rng.uniform(0.006, 0.014)
            position = tip + rng.normal(0, 0.003, 3)
            bend = float(rng.normal(0, 30)), float(rng.normal(0, 30))
            petals.append(Leaf(position, turn.T, length, 0.5 * length, bend, 0.0, "blossom"))
    return tuple(petals), tuple(rods)


def _stalk(rng: Generator, pole: Array, inner: Array, radius_m: float) -> Stem:
    out = pole - inner
    out /= np.linalg.norm(out)
    aside = rng.normal(0, 0.5, 3)
    length = rng.uniform(0.01, 0.02) if rng.random() < 0.5 else rng.uniform(0.02, 0.06)
    line = [
        pole - 0.003 * out,
        pole + 0.4 * length * out + 0.1 * length * aside,
        pole + length * out + 0.45 * length * aside,
    ]
    return Stem(np.stack(line), radius_m * rng.uniform(0.11, 0.34), "stalk")


def _tilt_view(rng: Generator, scene: Scene) -> tuple[Scene, tuple[float, float, float]]:
    """Return the scene and its up vector after a random, mostly level camera rotation."""
    pick = rng.random()
    if pick < 0.68:
        roll = rng.normal(0, 6)
    elif pick < 0.88:
        roll = rng.choice([-90.0, 90.0]) + rng.normal(0, 8)
    else:
        roll = rng.uniform(0, 360)
    turned = scene.moved(rotation(float(roll)), (0.0, 0.0, 0.0))
    up = rotation(float(roll)) @ np.array([0.0, -1.0, 0.0])
    middle = _middle(scene)
    for turn in (
        rotation(tilt_deg=float(rng.normal(0, 6))),
        rotation(spin_deg=float(rng.normal(0, 11))),
    ):
        tilted = turned.moved(turn, middle - turn @ middle)
        # Skip a rotation that would move bodies behind the camera.
        if _all_in_front(tilted):
            turned, up = tilted, turn @ up
    return turned, (float(up[0]), float(up[1]), float(up[2]))


def _middle(scene: Scene) -> Array:
    z = float(np.mean([f.centres_m[:, 2].mean() for f in scene.fruit])) if scene.fruit else 0.8
    return np.array([0.0, 0.0, z])


def _all_in_front(scene: Scene) -> bool:
    return (
        all(f.centres_m[:, 2].min() > placing.NEAREST_M for f in scene.fruit)
        and all(placing.in_front(leaf) for leaf in scene.leaves)
        and all(rod.vertices_m[:, 2].min() > 2 * rod.radius_m for rod in scene.stems)
    )


def _is_separate(fruit: Tube, neighbours: list[Tube]) -> bool:
    centres, radii = fruit.centres_m[::8], fruit.radii_m[::8]
    for neighbour in neighbours:
        gap = np.linalg.norm(centres[:, None] - neighbour.centres_m[None, ::8], axis=2)
        if (gap < radii[:, None] + neighbour.radii_m[None, ::8]).any():
            return False
    return True


def _compose_lying(
    rng: Generator,
    camera: Intrinsics,
    setting: Setting,
    variety: Variety,
    distance_m: float,
    count: int,
    slim: float,
) -> Composition:
    crated = setting is Setting.CRATE
    bodies = [_random_of_variety(rng, variety, slim) for _ in range(count)]
    if not crated:
        # Decoys with the shape but not the skin of a cucumber: carrots, bananas, pipes.
        for _ in range(int(rng.random() < 0.3) + int(rng.random() < 0.15)):
            kind = Variety(rng.choice([v.value for v in Variety]))
            bodies.append(replace(_random_of_variety(rng, kind), is_decoy=True))
    longest = max((f.chord_m for f in bodies), default=0.2)
    inner_m = (float(longest * rng.uniform(1.08, 1.5)), float(longest * rng.uniform(0.35, 0.8)))
    if crated:
        # Near enough to fill a large part of the picture.
        distance_m = max(float(inner_m[0] * rng.uniform(0.9, 1.8)), 0.38)
    ground = placing.Ground.seen(rng, distance_m)
    placed = placing.place_lying(rng, camera, ground, bodies, inner_m if crated else None)
    rods = placing.crate_rods(rng, ground, inner_m) if crated else ()
    petals, tips = _end_details(rng, [fruit for fruit in placed if not fruit.is_decoy])
    scene = Scene(tuple(placed), petals, (*rods, *tips), (ground.plane,))
    return Composition(scene, setting, variety, tuple(ground.frame[2].tolist()))
