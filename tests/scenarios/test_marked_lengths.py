"""`benchmarks/marked_lengths.py`: a bent tube of known lengths, seen through a pinhole."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

MATRIX = np.array([[912.0, 0.0, 640.0], [0.0, 911.0, 360.0], [0.0, 0.0, 1.0]])
LENS = np.array([0.09, -0.15, 0.001, -0.0005])
RADIUS_CM, END_CM = 1.5, 2.55


@pytest.fixture(scope="module")
def marked() -> ModuleType:
    import marked_lengths

    return marked_lengths


class Scene:
    """A round tube, its ends half ellipsoids, on the plane z = 0; a camera 32 cm away.

    The body is balls around its axis. A half ellipsoid of depth c on a radius r is the balls of
    squared radii r^2 (1 - x^2 / (c^2 - r^2)) at x from 0 to (c^2 - r^2) / c.
    """

    def __init__(self, bend_cm: float, angle: float, turned: float, shift_cm: float) -> None:
        steps = np.linspace(-angle / 2, angle / 2, 1001)
        flat = np.c_[bend_cm * np.sin(steps), bend_cm * (np.cos(steps) - 1)]
        beyond = np.linspace(0, END_CM - RADIUS_CM**2 / END_CM, 250)
        ends = flat[[0, -1]] - flat[[1, -2]]
        ends /= np.linalg.norm(ends, axis=1)[:, None]
        caps = [flat[k] + np.outer(beyond, way) for k, way in zip((0, -1), ends, strict=True)]
        turn = np.array([[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]])
        balls = np.vstack([caps[0][::-1], flat, caps[1]])
        self.axis = np.c_[balls @ turn.T + [shift_cm, 0.0], np.full(len(balls), RADIUS_CM)]
        cap = RADIUS_CM * np.sqrt(1 - beyond**2 / (END_CM**2 - RADIUS_CM**2))
        self.radii = np.r_[cap[::-1], np.full(len(flat), RADIUS_CM), cap]
        tips = flat[[0, -1]] + END_CM * ends
        self.chord_cm = float(np.linalg.norm(tips[1] - tips[0]))
        self.centreline_cm = bend_cm * angle + 2 * END_CM
        self.thread_cm = self.centreline_cm + RADIUS_CM * angle
        centre = np.array([0.0, -18.0, 26.0])
        forward = -centre / np.linalg.norm(centre)
        down = np.cross(forward, [1.0, 0.0, 0.0])
        rotation = np.array([[1.0, 0.0, 0.0], down, forward])
        self.turn, self.shift = cv2.Rodrigues(rotation)[0], -rotation @ centre

    def pixels(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        seen = cv2.projectPoints(points, self.turn, self.shift, MATRIX, LENS)[0]
        return np.asarray(seen, np.float64).reshape(-1, 2)

    def edge(
        self, camera: Any, start: NDArray[np.float64], way: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return where the outline is, from a pixel inside along a direction."""
        low, high = 0.0, 200.0
        for _ in range(40):
            middle = (low + high) / 2
            ray = camera.rays((start + middle * way)[None])[0]
            apart = np.linalg.norm(np.cross(self.axis - camera.centre, ray), axis=1)
            low, high = (middle, high) if (apart < self.radii).any() else (low, middle)
        return start + low * way


@pytest.mark.parametrize(
    ("bend_cm", "angle", "turned", "shift_cm"),
    [(40.0, 0.5, 0.0, 0.0), (20.0, 0.9, 0.3, 2.0), (6.0, 2.6, 3.0, -1.0), (40.0, 0.5, -0.4, -4.0)],
)
def test_lengths_of_a_bent_tube_come_back(
    marked: ModuleType, bend_cm: float, angle: float, turned: float, shift_cm: float
) -> None:
    scene = Scene(bend_cm, angle, turned, shift_cm)
    places = np.array([(x, y) for x in range(-12, 13, 4) for y in range(-8, 9, 4)], float)
    on_plane = scene.pixels(np.c_[places, np.zeros(len(places))])
    camera = marked.camera_over(MATRIX, LENS, np.c_[on_plane, places])
    assert camera.error_px < 1e-3
    middles = scene.pixels(scene.axis)
    pairs = []
    for at in np.linspace(90, 1410, 9).astype(int):
        along = middles[at + 5] - middles[at - 5]
        across = np.array([-along[1], along[0]]) / np.linalg.norm(along)
        pairs.append([scene.edge(camera, middles[at], way) for way in (-across, across)])
    tips = []
    for near, inner in ((0, 100), (-1, -101)):
        along = middles[near] - middles[inner]
        tips.append(scene.edge(camera, middles[near], along / np.linalg.norm(along)))
    marks = marked.Marks(np.array(tips), (True, True), np.array(pairs).reshape(-1, 4))
    found = marked.marked_lengths(camera, marks)
    assert found.radius_cm == pytest.approx(RADIUS_CM, rel=0.01)
    assert found.centreline_cm == pytest.approx(scene.centreline_cm, rel=0.003)
    assert found.thread_cm == pytest.approx(scene.thread_cm, rel=0.01)
    assert found.chord_cm == pytest.approx(scene.chord_cm, abs=0.004 * scene.centreline_cm)


def test_a_lower_axis_is_further_and_longer(marked: ModuleType) -> None:
    matrix = np.array([[1000.0, 0.0, 500.0], [0.0, 1000.0, 500.0], [0.0, 0.0, 1.0]])
    places = np.array([[-10.0, -10.0], [10.0, -10.0], [10.0, 10.0], [-10.0, 10.0], [0.0, 5.0]])
    known = np.c_[500 + 25 * places, places]  # from 40 cm straight above
    camera = marked.camera_over(matrix, np.zeros(4), known)
    pairs = np.array([[500 + x, 460, 500 + x, 540] for x in (-200, -100, 0, 100, 200)], float)
    marks = marked.Marks(np.array([[270.0, 500.0], [730.0, 500.0]]), (False, False), pairs)
    level, lower = (marked.marked_lengths(camera, marks, share) for share in (1.0, 0.5))
    # half an angle of atan(0.04) at 40 cm less the radius: r = 40 sin / (1 + sin)
    sine = np.sin(np.arctan(0.04))
    radius = 40 * sine / (1 + sine)
    assert level.radius_cm == pytest.approx(radius, rel=0.002)
    assert level.chord_cm == pytest.approx(0.46 * (40 - radius), rel=0.001)
    assert level.thread_cm == pytest.approx(level.chord_cm, rel=1e-4)
    assert lower.chord_cm == pytest.approx(0.46 * (40 - radius / 2), rel=0.002)
