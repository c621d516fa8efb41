from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.errors import TrainingError
from cucumbervision.fruit.crops import END_PX
from cucumbervision.fruit.mask_codes import Rle
from cucumbervision_lab.data.labels import DataSet, Label, LabelledPicture
from cucumbervision_lab.data.splits import is_held_out
from cucumbervision_lab.scenes.paste import Cutout
from cucumbervision_lab.train import end_crops
from cucumbervision_lab.train.end_crops import (
    END_CROP,
    HELD_OUT,
    collect_covered_ends,
    collect_end_crops,
    end_truths,
    joined_ends,
    labelled_fruit,
    measured_fruit,
    states_of,
)


def bent(radius_m: float = 0.15, length_m: float = 0.2) -> np.ndarray:
    """The axis of a fruit bent in the picture, half a metre away."""
    angle = np.linspace(0, length_m / radius_m, 41)
    return np.stack(
        [radius_m * np.sin(angle), radius_m * (1 - np.cos(angle)), np.full(41, 0.5)], axis=1
    )


@pytest.mark.parametrize("turned", [False, True])
def test_what_is_missing_is_measured_along_the_true_axis(turned: bool) -> None:
    true = bent()
    axis = true[8:39].copy()  # 8 of 40 steps of 5 mm are missing at the blossom end, 2 at the stem
    axis += (0.0, 0.0, 0.02)  # depth's error is none of an end
    missing_m, stem_first = end_truths(axis[::-1] if turned else axis, true)
    assert stem_first is turned
    assert missing_m[:: -1 if turned else 1] == pytest.approx([0.04, 0.01], abs=1e-3)


def test_labels_give_ends_where_the_mask_ends(drawn: DataSet) -> None:
    for picture in drawn.pictures:
        rng = np.random.default_rng(0)
        fruit = labelled_fruit(picture, rng)
        labels = [label for label in picture.labels if not label.ignore]
        assert len(fruit) <= len(labels)
        for one in fruit:
            assert one.given
            assert sum(one.missing_m) < one.true_m[0]
    # A mask whose last third is taken away misses a third there.
    camera = next(p.camera for p in drawn.pictures if p.camera is not None)
    axis = np.stack([np.linspace(-0.1, 0.1, 41), np.zeros(41), np.full(41, 0.5)], axis=1)
    left, right = camera.project(axis[[0, -1]])[:, 0]
    row = camera.project(axis[:1])[0, 1]
    v, u = np.mgrid[: camera.height, : camera.width]
    mask = (np.abs(v - row) < 9) & (u > left) & (u < left + (right - left) * 2 / 3)
    extras = {
        "axis_m": axis.tolist(),
        "radius_m": [0.02] * 41,
        "centreline_m": 0.2,
        "thread_m": 0.2,
        "chord_m": 0.2,
    }
    label = Label.of_mask(mask, extras=extras)
    picture = LabelledPicture("a.png", camera.width, camera.height, (label,), camera=camera)
    (one,) = labelled_fruit(picture, np.random.default_rng(1))
    blossom, stem = np.array(one.missing_m) / 0.2
    assert blossom == pytest.approx(0, abs=0.08)  # four deviations of what ends err
    assert stem == pytest.approx(1 / 3, abs=0.08)
    assert one.mask == Rle.of(mask)


def test_of_pasted_fruit_the_whole_outline_tells_what_is_missing() -> None:
    whole = np.zeros((120, 240), bool)
    whole[50:70, 20:220] = True
    seen = whole.copy()
    seen[:, 170:] = False
    label = Label.of_mask(seen, amodal=whole)
    cut = Label.of_mask(seen, amodal=whole, cut_off=True)
    picture = LabelledPicture("a.png", 240, 120, (label, cut), scene="a")
    (one,) = labelled_fruit(picture, np.random.default_rng(2))
    assert one.stem_first is None
    missing = sorted(np.array(one.missing_m) / one.true_m[0])
    # 50 of 200 px; ends err by a quarter of the radius of 10 px.
    assert missing == pytest.approx([0.0, 0.25], abs=0.06)
    assert one.diameter_m == pytest.approx(20 / 240 * 0.5, rel=0.25)


@pytest.mark.train
def test_a_set_is_measured_once_and_goes_on_where_it_was_cut_short(
    drawn: DataSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    some = replace(drawn, pictures=drawn.pictures[:3])
    asked: list[tuple[str, bool]] = []
    actual = end_crops.measure_drawn

    def noted(picture: LabelledPicture, data: DataSet, *, given: bool = True) -> object:
        asked.append((picture.file, given))
        return actual(picture, data, given=given)

    monkeypatch.setattr(end_crops, "measure_drawn", noted)
    keep = tmp_path / "ends.jsonl"
    fruit = measured_fruit(some, keep)
    assert {file for file, _ in asked} == {picture.file for picture in some.pictures}
    held = {picture.file: is_held_out(picture, HELD_OUT) for picture in some.pictures}
    assert all(given is not held[file] for file, given in asked)
    assert fruit
    assert all(one.features["distance_m"] > 0 for one in fruit)
    # What is missing at both ends is what the length lacks, but for axes that are far off.
    near = [one for one in fruit if one.features["distance_m"] < 1.2]
    off = [
        one.lengths_m[0] / one.true_m[0] - (1 - sum(one.missing_m) / one.true_m[0]) for one in near
    ]
    assert len(off) >= 8
    assert np.median(np.abs(off)) < 0.02
    asked.clear()
    lines = keep.read_text().splitlines()
    keep.write_text("\n".join(lines[:-1]) + "\n" + lines[-1][:40])
    assert len(measured_fruit(some, keep)) == len(fruit)
    assert len(asked) == 1


def test_ends_of_training_come_once_more_moved_along_the_axis(drawn: DataSet) -> None:
    rng = np.random.default_rng(0)
    fruit = [one for picture in drawn.pictures for one in labelled_fruit(picture, rng)]
    found = collect_end_crops(fruit, drawn)
    held = np.array([one.held_out for one in fruit])
    assert (found.held_out == held[found.fruit]).all()
    assert not (found.moved & found.held_out).any()
    plain = found[~found.moved]
    assert np.bincount(plain.fruit).tolist() == [2] * len(fruit)
    assert found.moved.sum() == 2 * (~held).sum()
    for end in (0, 1):
        expected = [one.missing_m[end] / one.true_m[0] for one in fruit]
        assert plain.missing[end::2] == pytest.approx(expected, abs=1e-6)
        assert plain.stem[end::2].tolist() == [float(one.stem_first is (end == 0)) for one in fruit]
    # Moved inward the fruit goes on under the end: the mask fills the middle of the crop.
    moved = np.flatnonzero(found.moved)
    inward = moved[(found.missing[moved] - found.missing[moved - 1]) > 0.1]
    beyond = found.planes[:, END_PX // 2, END_PX // 2 + 2 :, 5].mean(axis=1)
    assert (beyond[inward] >= beyond[inward - 1]).all()


def test_nothing_measured_is_named(drawn: DataSet) -> None:
    with pytest.raises(TrainingError, match="no measured fruit"):
        collect_end_crops([], drawn)


def test_states_are_by_what_is_missing() -> None:
    crops = np.zeros(3, END_CROP).view(np.recarray)
    crops.missing = [0.06, -0.06, 0.04]
    assert states_of(crops).tolist() == [1, 2, 0]


def test_fruit_of_several_sets_are_numbered_on() -> None:
    crops = np.zeros(4, END_CROP).view(np.recarray)
    crops.fruit = [0, 0, 1, 1]
    assert joined_ends([crops, crops]).fruit.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]


def test_covered_ends_miss_what_a_leaf_hides(drawn: DataSet) -> None:
    leaf = Cutout(np.full((60, 80, 3), (40, 160, 50), np.uint8), np.ones((60, 80), bool), None)
    rng = np.random.default_rng(0)
    fruit = [one for picture in drawn.pictures for one in labelled_fruit(picture, rng)]
    ends = [missing_m / one.true_m[0] for one in fruit for missing_m in one.missing_m]
    found = collect_covered_ends(fruit, drawn, [leaf], seed=1)
    assert len(found)
    assert not found.held_out.any()
    assert not any(fruit[number].held_out for number in found.fruit)
    # Some ends are covered by far more than any true end of these fruit misses; others stay true.
    assert (found.missing > max(0.05, 2 * max(x for x in ends if abs(x) <= 0.03))).any()
    assert (np.abs(found.missing) < 0.1).any()


def test_nothing_is_covered_in_scenes_held_out(drawn: DataSet) -> None:
    rng = np.random.default_rng(0)
    fruit = [one for picture in drawn.pictures for one in labelled_fruit(picture, rng)]
    held = [one for one in fruit if one.held_out]
    assert not len(collect_covered_ends(held, drawn, [], seed=1))
