import sys

import numpy as np
import pytest

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.errors import DataSetError
from cucumbervision_lab.synthesis import path_trace as module
from cucumbervision_lab.synthesis.appearance import Assets, random_style
from cucumbervision_lab.synthesis.bodies import arc_tube
from cucumbervision_lab.synthesis.frame import FrameOptions, draw_frame
from cucumbervision_lab.synthesis.path_trace import path_trace
from cucumbervision_lab.synthesis.raycast import Leaf, Stem
from cucumbervision_lab.synthesis.scene import Scene, render

CAMERA = Intrinsics(160, 120, 150.0, 150.0, 83.0, 55.0)


def scene() -> Scene:
    fruit = arc_tube(0.2, 0.02, 0.3).moved(np.eye(3), (0.0, 0.0, 0.5))
    leaf = Leaf(np.array([0.05, 0.0, 0.4]), np.eye(3), 0.03, 0.03)
    string = Stem(np.array([[-0.05, -0.3, 0.45], [-0.05, 0.3, 0.45]]), 0.002)
    return Scene((fruit,), (leaf,), (string,))


def test_a_mesh_has_the_length_and_the_radius_of_its_tube() -> None:
    vertices, faces, uv = module._tube_mesh(arc_tube(0.2, 0.02))
    assert np.ptp(vertices[:, 0]) == pytest.approx(0.2, abs=1e-6)
    assert np.hypot(vertices[:, 1], vertices[:, 2]).max() == pytest.approx(0.02, abs=1e-6)
    assert faces.max() == len(vertices) - 1
    assert (uv.min(), uv.max()) == (0, 1)
    # From the blossom end (-x) to the stem end.
    assert vertices[uv[:, 1] == 0, 0].max() < vertices[uv[:, 1] == 1, 0].min()


def test_a_blade_reaches_its_rim_and_bends_as_its_leaf_does() -> None:
    leaf = Leaf(np.zeros(3), np.eye(3), 0.02, 0.01, (30.0, 0.0))
    vertices, _, uv = module._leaf_mesh(leaf, np.random.default_rng(1))
    rim = vertices[-module._RIM - 1 :]
    assert np.hypot(rim[:, 0] / 0.02, rim[:, 1] / 0.01) == pytest.approx(1)
    # 30/m over 2 cm is 6 mm at the tip; its waves add at most 7 % of the half width.
    tip = rim[np.argmax(rim[:, 0])]
    assert tip[2] == pytest.approx(30 * 0.02**2 / 2, abs=0.07 * 0.01)
    assert ((uv >= 0) & (uv <= 1)).all()


def test_a_leaf_stalk_begins_at_its_blade_and_is_at_most_30_cm_long() -> None:
    leaf = Leaf(np.array([0.0, 0.0, 0.5]), np.eye(3), 0.1, 0.08)
    far = Stem(np.array([[2.0, -0.3, 0.5], [2.0, 0.3, 0.5]]), 0.004)
    line, radius = module._leaf_stalk(leaf, module._points_on([far]), np.random.default_rng(1))
    assert line[0] == pytest.approx([-0.062, 0.0, 0.5])
    assert np.linalg.norm(line[-1] - line[0]) == pytest.approx(0.3)
    assert 0.001 < radius < 0.004


def test_blender_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bpy", None)
    with pytest.raises(DataSetError, match="bpy"):
        draw_frame(1, 0, FrameOptions(64, 48, depth=False, samples=1), Assets())


def test_a_traced_picture_shows_the_fruit_where_ray_casting_does() -> None:
    pytest.importorskip("bpy")
    staged, rng = scene(), np.random.default_rng(2)
    style = random_style(rng, staged, Assets(), "hanging")
    traced = path_trace(staged, CAMERA, style, Assets(), rng, samples=2)
    expected = render(staged, CAMERA).mask(0)
    seen = traced.fruit == 0
    # The leaf has waves and a stalk that the cast one has not.
    assert (seen & expected).sum() > 0.9 * (seen | expected).sum()
    assert traced.linear.shape == (120, 160, 3)
    assert np.isfinite(traced.linear).all()
    assert traced.linear[seen].mean() > 0.001
