"""The page on captures: its examples are run, its JSON is read."""

from __future__ import annotations

import doctest
import json
import re
from collections.abc import Callable
from pathlib import Path

from cucumbervision.capture.camera_file import read_camera_file
from cucumbervision.capture.readers.native import Manifest

PAGE = Path(__file__).parents[2] / "docs" / "captures.md"


def test_examples(run_page: Callable[[Path], doctest.TestResults]) -> None:
    result = run_page(PAGE)
    assert result.attempted > 20
    assert result.failed == 0


def test_json_blocks(tmp_path: Path) -> None:
    blocks = re.findall(r"```json\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    kinds = []
    for block in blocks:
        data = json.loads(block)
        if "format" in data:
            kinds.append("capture")
            Manifest.model_validate(data)
        else:
            kinds.append("intrinsics")
            (tmp_path / "k.json").write_text(block)
            assert read_camera_file(tmp_path / "k.json").intrinsics.size == (1280, 720)
    assert sorted(kinds) == ["capture"] + ["intrinsics"] * 3


def test_every_key_is_described() -> None:
    page = PAGE.read_text(encoding="utf-8")
    for key in Manifest.model_fields:
        assert f"`{key}`" in page, key
