from pathlib import Path

from typer.testing import CliRunner

from cucumbervision.cli.app import app
from cucumbervision_lab.data.coco import read_coco


def test_it_draws_a_set_and_says_what_is_in_it(tmp_path: Path) -> None:
    out = tmp_path / "set"
    words = ["synth", "--out", str(out), "--frames", "3", "--size", "160x96", "--workers", "1"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    data = read_coco(out)
    fruit = sum(len(picture.labels) for picture in data.pictures)
    assert f"3 pictures (3 train, 0 val, 0 test) with {fruit} cucumbers" in result.output
    assert len(list((out / "depth").glob("*.png"))) == 3


def test_a_size_that_is_none_is_named(tmp_path: Path) -> None:
    words = ["synth", "--out", str(tmp_path), "--size", "big"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code != 0
    assert "--size" in str(result.exception)
