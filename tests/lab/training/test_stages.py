from __future__ import annotations

from pathlib import Path

import pytest

from cucumbervision.errors import TrainingError
from cucumbervision_lab.training.stages import DONE, RUNNING, RunState, merge_plans, parse_stages


def test_plans_are_read() -> None:
    stages = parse_stages("320x8,448 x 6, 640×2")
    assert [s.plan for s in stages] == [(320, 8), (448, 6), (640, 2)]
    assert {s.status for s in stages} == {"waiting"}


@pytest.mark.parametrize("text", ["", "320", "320x0", "0x3", "330x2", "320x8,,640x2", "x8"])
def test_plans_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(TrainingError, match="multiples of 32"):
        parse_stages(text)


def state(plan: str = "64x2,96x1") -> RunState:
    return RunState("seg", "data.yaml", "yolo26n-seg.yaml", parse_stages(plan), seed=3)


def test_what_was_begun_stays_and_the_rest_may_change() -> None:
    known = state().at(0, status=DONE, fitness=0.5).stages
    longer = merge_plans(known, parse_stages("64x2,128x1,160x1"))
    assert [(s.plan, s.status, s.fitness) for s in longer] == [
        ((64, 2), "done", 0.5),
        ((128, 1), "waiting", None),
        ((160, 1), "waiting", None),
    ]
    with pytest.raises(TrainingError, match="has already begun 64x2; give stages that begin"):
        merge_plans(known, parse_stages("64x3,96x1"))
    with pytest.raises(TrainingError, match="begun 64x2,96x1"):
        merge_plans(state().at(0, status=DONE).at(1, status=RUNNING).stages, parse_stages("64x2"))


def test_state_survives_the_disk(tmp_path: Path) -> None:
    before = state().at(1, status=RUNNING)
    before.save(tmp_path)
    assert RunState.load(tmp_path) == before
    assert [p.name for p in tmp_path.iterdir()] == ["state.json"]
    assert before.folder(tmp_path, 1) == tmp_path / "stage2-96px"


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"stages": 3}', '{"stages": [{"a": 1}]}'])
def test_broken_state_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "state.json").write_text(text)
    with pytest.raises(TrainingError, match=r"state\.json: the state of the training cannot"):
        RunState.load(tmp_path)


def test_no_state_is_named(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="no training to go on with"):
        RunState.load(tmp_path)
