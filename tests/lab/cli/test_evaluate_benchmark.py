from __future__ import annotations

import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cucumbervision.cli.app import app
from cucumbervision.errors import MissingExtraError


def test_a_tool_that_is_missing_is_named_before_anything_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.startswith("cucumbervision_lab.evaluate")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "pandas", None)
    result = CliRunner().invoke(app, ["benchmark", "--quick", "--out", str(tmp_path / "out")])
    assert isinstance(result.exception, MissingExtraError)
    assert "pandas is not installed; pip install" in str(result.exception)
    assert not (tmp_path / "out").exists()
