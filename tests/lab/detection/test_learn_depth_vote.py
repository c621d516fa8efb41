from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cucumbervision.cli.app import app
from cucumbervision.perception.depth_vote import FEATURES, DepthShape, read_depth_vote
from cucumbervision_lab.detection.learn import Candidate, fit_depth_vote


def candidates(count: int, rng: np.random.Generator) -> list[Candidate]:
    """Detections that are a fruit with the probability 1 / (1 + exp(-(1 - 4 far_share)))."""
    far = rng.uniform(0, 1, count)
    right = rng.uniform(size=count) < 1 / (1 + np.exp(-(1 - 4 * far)))
    sizes = rng.uniform(0.02, 0.05, count)
    return [
        Candidate(k // 4, rng.uniform(0.05, 0.9), DepthShape(w, 5 * w, f, 0.4), bool(y))
        for k, (f, w, y) in enumerate(zip(far, sizes, right, strict=True))
    ]


def test_fit_finds_what_the_detections_were_made_by() -> None:
    fit = fit_depth_vote(candidates(4000, np.random.default_rng(1)))
    weights = dict(zip(FEATURES, fit.vote.weights, strict=True))
    assert weights["far_share"] == pytest.approx(-4, abs=0.4)
    assert weights["logit_confidence"] == pytest.approx(0, abs=0.1)
    assert fit.fruit + fit.others == fit.vote.detections == 4000
    assert fit.log_loss < fit.log_loss_without - 0.05


def test_command_learns_from_a_drawn_set(tmp_path: Path) -> None:
    runner = CliRunner()
    data, out = tmp_path / "set", tmp_path / "vote.json"
    drawn = runner.invoke(app, ["synth", "--out", str(data), "--frames", "6", "--seed", "71"])
    assert drawn.exit_code == 0, drawn.output
    learnt = runner.invoke(app, ["train", "depth-vote", str(data), "--out", str(out)])
    assert learnt.exit_code == 0, learnt.output
    assert "log loss on held-out scenes" in " ".join(learnt.output.split())
    assert read_depth_vote(out).detections >= 5
