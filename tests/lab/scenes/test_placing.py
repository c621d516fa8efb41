from itertools import combinations

import numpy as np

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision_lab.scenes.bodies import arc_tube, random_fruit
from cucumbervision_lab.scenes.placing import Ground, crate_rods, place_lying

CAMERA = Intrinsics(320, 180, 228.0, 228.0, 160.0, 90.0)


def above(ground: Ground, points: np.ndarray) -> np.ndarray:
    return np.asarray((points - ground.point_m) @ ground.frame[2])


def test_a_straight_fruit_lies_on_the_ground() -> None:
    ground = Ground.seen(np.random.default_rng(1), 0.6)
    (placed,) = place_lying(np.random.default_rng(2), CAMERA, ground, [arc_tube(0.2, 0.02)])
    # Its axis runs level, a radius above.
    np.testing.assert_allclose(above(ground, placed.centres_m), 0.02, atol=1e-9)


def test_on_an_open_ground_its_middle_is_in_the_picture() -> None:
    ground = Ground.seen(np.random.default_rng(5), 0.7)
    u, v = 200.0, 60.0
    x, y = ground.below(CAMERA, u, v)
    np.testing.assert_allclose(CAMERA.project(ground.at(x, y, 0.0)[None])[0], [u, v], atol=1e-6)


def test_no_fruit_is_inside_another_nor_below_the_ground() -> None:
    rng = np.random.default_rng(3)
    ground = Ground.seen(rng, 0.6)
    bodies = [random_fruit(rng, 0.25, balls=200) for _ in range(9)]
    placed = place_lying(rng, CAMERA, ground, bodies, (0.30, 0.15))
    assert len(placed) == 9
    # Nine fruit of 4 cm do not fit side by side into 15 cm: some lie on others.
    assert max(above(ground, f.centres_m).max() for f in placed) > 0.05
    for a, b in combinations(placed, 2):
        gap = np.linalg.norm(a.centres_m[:, None] - b.centres_m[None], axis=2)
        # Every eighth ball stood for the body: a touch may be up to a third of a millimetre deep.
        assert (gap - a.radii_m[:, None] - b.radii_m[None]).min() > -0.0004
    for fruit in placed:
        assert (above(ground, fruit.centres_m) - fruit.radii_m).min() > -1e-4


def test_a_crate_stands_around_what_lies_in_it() -> None:
    rng = np.random.default_rng(4)
    ground = Ground.seen(rng, 0.9)
    rods = crate_rods(rng, ground, (0.30, 0.20))
    assert len(rods) >= 3 * 4 + 4
    for rod in rods:
        place = (rod.vertices_m - ground.point_m) @ ground.frame.T
        assert (np.abs(place[:, 0]) >= 0.15).all() or (np.abs(place[:, 1]) >= 0.10).all()
        assert (place[:, 2] >= rod.radius_m - 1e-12).all()
