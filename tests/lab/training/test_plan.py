"""Plans counted in pictures, and the order in which pictures are seen."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.errors import TrainingError
from cucumbervision_lab.training.plan import (
    MixtureSampler,
    RunState,
    epoch_pictures,
    extend_plan,
    group_by_source,
    parse_plan,
)


def test_plan_is_read_as_written() -> None:
    plan = parse_plan("448x1000, 640 × 400", 300)
    # Whole epochs: 1000 pictures are four of 300.
    assert (plan.epochs, plan.text) == (6, "448x1000,640x400")
    assert [plan.size_at(k) for k in range(6)] == [448] * 4 + [640] * 2
    assert [plan.end_of_part(k) for k in (0, 3, 4, 5)] == [4, 4, 6, 6]
    assert [plan.progress(k) for k in (0, 3, 6, 9)] == [0.0, 0.5, 1.0, 1.0]


@pytest.mark.parametrize("text", ["", "448", "x1000", "450x1000", "448x0", "448-1000"])
def test_other_words_are_no_plan(text: str) -> None:
    with pytest.raises(TrainingError, match="invalid part of a plan"):
        parse_plan(text)


def test_plan_may_be_prolonged_not_rewritten() -> None:
    known = parse_plan("64x300,96x300", 100)
    longer = extend_plan(known, 4, parse_plan("64x300,96x600"))
    assert (longer.epochs, longer.per_epoch) == (9, 100)
    for other in ("64x400", "96x300,96x300", "64x300"):
        with pytest.raises(TrainingError, match="400 pictures of the plan"):
            extend_plan(known, 4, parse_plan(other))


def test_state_comes_back_as_saved(tmp_path: Path) -> None:
    plan = parse_plan("64x300,96x300", 100)
    state = RunState("seg", "data.yaml", "a.pt", plan, 2, 7, 1.5, {"learning_rate": 0.1})
    state.save(tmp_path)
    assert RunState.load(tmp_path) == state
    assert state.pictures == 200
    (tmp_path / "state.json").write_text(json.dumps({"task": "seg"}))
    with pytest.raises(TrainingError, match=r"'data': field required.*; start a new run in"):
        RunState.load(tmp_path)
    with pytest.raises(TrainingError, match="no training run to resume"):
        RunState.load(tmp_path / "none")


def test_sources_come_as_often_as_their_weights_say() -> None:
    sources = [np.arange(0, 40), np.arange(40, 45), np.arange(0, 0)]
    seen = Counter[int]()
    for epoch in range(20):
        row = epoch_pictures(sources, [0.6, 0.2, 0.2], 48, epoch, seed=3)
        assert len(row) == 48
        seen.update(row.tolist())
    # The empty one's weight goes to the others, 3 to 1: 720 and 240 of 960.
    assert sum(seen[k] for k in range(40)) == 720
    # And all pictures of a source equally often.
    assert {seen[k] for k in range(40)} == {18}
    assert {seen[k] for k in range(40, 45)} == {48}


def test_order_is_the_same_whenever_one_begins() -> None:
    sources = [np.arange(7), np.arange(7, 12)]
    through = MixtureSampler(sources, [1, 1], 6)
    rows = [list(through) for _ in range(4)]
    later = MixtureSampler(sources, [1, 1], 6, epoch=2)
    assert [list(later), list(later)] == rows[2:]
    assert len(later) == 6
    assert rows[0] != rows[1]


def test_files_belong_to_the_folder_they_lie_in() -> None:
    files = ["/a/x/1.jpg", "/a/xy/2.jpg", "/a/x/deep/3.jpg"]
    assert [one.tolist() for one in group_by_source(files, ["/a/x", "/a/xy"])] == [[0, 2], [1]]


@pytest.mark.parametrize("number", [0, -1, 10**12, 10**400])
def test_a_plan_without_or_with_endless_pictures_is_refused(number: int) -> None:
    values = asdict(RunState("seg", "data.yaml", "a.pt", parse_plan("448x900")))
    assert RunState.from_dict(values).plan.epochs == 2
    for changed in (
        {"per_epoch": number},
        {"parts": [{"size_px": 448, "pictures": number}]},
    ):
        broken = values | {"plan": values["plan"] | changed}
        with pytest.raises(TrainingError, match="a picture count of its plan"):
            RunState.from_dict(broken)
