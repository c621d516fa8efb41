"""The page on rounds: its examples are run, its pose columns and commands exist."""

from __future__ import annotations

import re
from pathlib import Path

import typer

from cucumbervision.cli.app import app
from cucumbervision_greenhouse.rounds.poses import PoseLine

PAGE = Path(__file__).parents[2] / "docs" / "rounds.md"


def test_every_pose_column_is_named() -> None:
    heads = re.findall(r"^\| (`[^|]+) \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    named = {name for head in heads for name in re.findall(r"`(\w+)`", head)}
    assert named == set(PoseLine.model_fields)


def test_commands_and_options_exist() -> None:
    command = typer.main.get_command(app)
    known = getattr(getattr(command, "commands", {})["round"], "commands", {})
    lines = re.findall(
        r"^cucumbervision round (.+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE
    )
    assert len(lines) > 6
    for line in lines:
        name, *rest = line.split("#")[0].split()
        options = {option for param in known[name].params for option in param.opts}
        assert {word for word in rest if word.startswith("--")} <= options
