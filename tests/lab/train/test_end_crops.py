from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cucumbervision.errors import TrainingError
from cucumbervision.fruit.crops import END_PX, PLANES
from cucumbervision_lab.data.labels import DataSet
from cucumbervision_lab.scenes.paste import Cutout
from cucumbervision_lab.train.end_crops import EndCrops, collect_covered_ends, collect_end_crops
from cucumbervision_lab.train.measured_ends import labelled_fruit


def crops(count: int) -> EndCrops:
    unknown = np.full(count, np.nan, np.float32)
    return EndCrops(
        np.zeros((count, END_PX, END_PX, PLANES), np.uint8),
        np.zeros((count, 2), np.float32),
        unknown,
        unknown,
        unknown,
        np.arange(count) // 2,
        np.zeros(count, bool),
        np.zeros(count, bool),
    )


def test_ends_of_training_come_once_more_moved_along_the_axis(drawn: DataSet) -> None:
    rng = np.random.default_rng(0)
    fruit = [one for picture in drawn.pictures for one in labelled_fruit(picture, rng)]
    found = collect_end_crops(fruit, drawn)
    held = np.array([one.held_out for one in fruit])
    assert (found.held_out == held[found.fruit]).all()
    assert not (found.moved & found.held_out).any()
    plain = found.only(~found.moved)
    assert np.bincount(plain.fruit).tolist() == [2] * len(fruit)
    assert found.moved.sum() == 2 * (~held).sum()
    for end in (0, 1):
        expected = [one.relative_missing[end] for one in fruit]
        assert plain.missing[end::2] == pytest.approx(expected, abs=1e-6)
        assert plain.stem[end::2].tolist() == [float(bool(one.ends[end].is_stem)) for one in fruit]
    # Moved inward the fruit goes on under the end: the mask fills the middle of the crop.
    moved = np.flatnonzero(found.moved)
    inward = moved[(found.missing[moved] - found.missing[moved - 1]) > 0.1]
    beyond = found.planes[:, END_PX // 2, END_PX // 2 + 2 :, 5].mean(axis=1)
    assert (beyond[inward] >= beyond[inward - 1]).all()


def test_nothing_measured_is_named(drawn: DataSet) -> None:
    with pytest.raises(TrainingError, match="no measured fruit"):
        collect_end_crops([], drawn)


def test_states_are_by_what_is_missing_or_by_eye() -> None:
    drawn = crops(4)
    missing = np.array([0.06, -0.06, 0.04, np.nan], np.float32)
    covered = np.array([np.nan, np.nan, np.nan, 1.0], np.float32)
    assert replace(drawn, missing=missing, covered=covered).state.tolist() == [1, 2, 0, 1]
    unknown = np.full(4, np.nan, np.float32)
    assert replace(drawn, missing=unknown, covered=unknown).state.tolist() == [-1] * 4


def test_covered_ends_miss_what_a_leaf_hides(drawn: DataSet) -> None:
    leaf = Cutout(np.full((60, 80, 3), (40, 160, 50), np.uint8), np.ones((60, 80), bool), None)
    rng = np.random.default_rng(0)
    fruit = [one for picture in drawn.pictures for one in labelled_fruit(picture, rng)]
    ends = [end.missing_m / one.true_m[0] for one in fruit for end in one.ends]
    found = collect_covered_ends(fruit, drawn, [leaf], seed=1)
    assert found is not None
    assert not found.held_out.any()
    assert not any(fruit[number].held_out for number in found.fruit)
    # Some ends are covered by far more than any true end of these fruit misses; others stay true.
    assert (found.missing > max(0.05, 2 * max(x for x in ends if abs(x) <= 0.03))).any()
    assert (np.abs(found.missing) < 0.1).any()


def test_nothing_is_covered_in_scenes_held_out(drawn: DataSet) -> None:
    rng = np.random.default_rng(0)
    fruit = [one for picture in drawn.pictures for one in labelled_fruit(picture, rng)]
    held = [one for one in fruit if one.held_out]
    assert collect_covered_ends(held, drawn, [], seed=1) is None
