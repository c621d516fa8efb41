from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from cucumbervision.fruit.mask_codes import Rle
from cucumbervision_lab.data.labels import DataSet, Label, LabelledPicture
from cucumbervision_lab.data.splits import is_held_out
from cucumbervision_lab.train.measured_ends import (
    HELD_OUT,
    end_truths,
    labelled_fruit,
    measured_fruit,
)

if TYPE_CHECKING:
    from pathlib import Path


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
    ends = end_truths(axis[::-1] if turned else axis, true)
    ends = ends[::-1] if turned else ends
    assert [end.is_stem for end in ends] == [False, True]
    assert [end.missing_m for end in ends] == pytest.approx([0.04, 0.01], abs=1e-3)


def test_labels_give_ends_where_the_mask_ends(drawn: DataSet) -> None:
    for picture in drawn.pictures:
        rng = np.random.default_rng(0)
        fruit = labelled_fruit(picture, rng)
        labels = [label for label in picture.labels if not label.ignore]
        assert len(fruit) <= len(labels)
        for one in fruit:
            assert one.given
            assert sum(one.relative_missing) < 1
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
    blossom, stem = one.relative_missing
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
    assert [end.is_stem for end in one.ends] == [None, None]
    missing = sorted(one.relative_missing)
    # 50 of 200 px; ends err by a quarter of the radius of 10 px.
    assert missing == pytest.approx([0.0, 0.25], abs=0.06)
    assert one.diameter_m == pytest.approx(20 / 240 * 0.5, rel=0.25)


@pytest.mark.train
def test_a_set_is_measured_once_and_goes_on_where_it_was_cut_short(
    drawn: DataSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from cucumbervision_lab.train import measured_ends

    some = replace(drawn, pictures=drawn.pictures[:3])
    asked: list[tuple[str, bool]] = []
    actual = measured_ends.measure_drawn

    def noted(picture: LabelledPicture, data: DataSet, *, given: bool = True) -> object:
        asked.append((picture.file, given))
        return actual(picture, data, given=given)

    monkeypatch.setattr(measured_ends, "measure_drawn", noted)
    keep = tmp_path / "ends.jsonl"
    fruit = measured_fruit(some, keep)
    assert {file for file, _ in asked} == {picture.file for picture in some.pictures}
    held = {picture.file: is_held_out(picture, HELD_OUT) for picture in some.pictures}
    assert all(given is not held[file] for file, given in asked)
    assert fruit
    assert all(one.features["distance_m"] > 0 for one in fruit)
    # What is missing at both ends is what the length lacks, but for axes that are far off.
    near = [one for one in fruit if one.features["distance_m"] < 1.2]
    off = [one.lengths_m[0] / one.true_m[0] - (1 - sum(one.relative_missing)) for one in near]
    assert len(off) >= 8
    assert np.median(np.abs(off)) < 0.02
    asked.clear()
    lines = keep.read_text().splitlines()
    keep.write_text("\n".join(lines[:-1]) + "\n" + lines[-1][:40])
    assert len(measured_fruit(some, keep)) == len(fruit)
    assert len(asked) == 1
