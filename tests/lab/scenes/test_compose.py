import numpy as np
import pytest

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision_lab.scenes.compose import (
    HARD,
    MOST_FRUIT,
    Composition,
    Difficulty,
    Setting,
    compose,
)
from cucumbervision_lab.scenes.scene import Kind, render, truth_of

CAMERA = Intrinsics(320, 180, 228.0, 228.0, 160.0, 90.0)


def cucumbers(staged: Composition) -> int:
    return sum(not tube.is_decoy for tube in staged.scene.fruit)


@pytest.mark.parametrize("setting", list(Setting))
@pytest.mark.parametrize("seed", range(8))
def test_every_scene_can_be_drawn(setting: Setting, seed: int) -> None:
    staged = compose(np.random.default_rng(seed), CAMERA, setting)
    scene = staged.scene
    assert cucumbers(staged) <= MOST_FRUIT
    view = render(scene, CAMERA)
    for truth in truth_of(scene, CAMERA, view):
        assert 0.0 <= truth.hidden_share <= 1.0
        assert 0.06 <= truth.centreline_m <= 0.4001
    assert np.isin(view.kind, [int(kind) for kind in Kind]).all()


def test_many_scenes_are_as_varied_as_growers_meet_them() -> None:
    counts, hidden, decoys, tilts = [], [], 0, []
    for seed in range(60):
        setting = list(Setting)[seed % 3]
        staged = compose(np.random.default_rng(seed), CAMERA, setting)
        counts.append(cucumbers(staged))
        decoys += len(staged.scene.fruit) - cucumbers(staged)
        for body, truth in zip(staged.scene.fruit, truth_of(staged.scene, CAMERA), strict=True):
            hidden.append(truth.hidden_share)
            chord = body.poles_m[1] - body.poles_m[0]
            tilts.append(np.degrees(np.arcsin(abs(chord[2]) / np.linalg.norm(chord))))
    assert min(counts) == 0
    assert max(counts) >= 10
    assert decoys > 0
    assert 0.1 < np.mean(hidden) < 0.6
    assert np.mean(np.array(hidden) < 0.05) > 0.2
    assert np.percentile(tilts, 90) > 25


def test_hanging_fruit_hang_down_and_lying_ones_lie_level() -> None:
    for seed in range(10):
        hung = compose(np.random.default_rng(seed), CAMERA, Setting.HANGING)
        lain = compose(np.random.default_rng(seed), CAMERA, Setting.BENCH)
        for staged in (hung, lain):
            assert np.linalg.norm(staged.up) == pytest.approx(1)
        # The stem end is up, but for a fruit that leans far over.
        rises = [(f.poles_m[1] - f.poles_m[0]) @ np.array(hung.up) for f in hung.scene.fruit]
        assert np.mean([rise > 0 for rise in rises] or [1]) > 0.8
        for fruit in lain.scene.fruit:
            assert abs((fruit.poles_m[1] - fruit.poles_m[0]) @ np.array(lain.up)) < 0.02


def test_hard_scenes_show_more_and_slimmer_fruit_at_more_distances() -> None:
    def drawn(*difficulty: Difficulty) -> tuple[float, list[float], list[float]]:
        seeds = map(np.random.default_rng, range(40))
        scenes = [compose(rng, CAMERA, Setting.BENCH, *difficulty) for rng in seeds]
        fruit = [body for staged in scenes for body in staged.scene.fruit]
        depths_m = [float(body.centres_m[:, 2].mean()) for body in fruit]
        diameters = [body.centreline_m / (2 * float(body.radii_m.max())) for body in fruit]
        return float(np.mean([cucumbers(staged) for staged in scenes])), depths_m, diameters

    (plain, plain_m, thick), (hard, hard_m, slim) = drawn(), drawn(HARD)
    assert hard > 1.3 * plain
    assert max(hard_m) > 1.25 * max(plain_m)
    assert np.quantile(slim, 0.9) > 1.15 * np.quantile(thick, 0.9)
