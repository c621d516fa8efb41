from __future__ import annotations

from pathlib import Path

import pytest

from cucumbervision.capture.readers import open_source
from cucumbervision.errors import CaptureError


def test_what_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"none: does not exist; check the path"):
        open_source(tmp_path / "none")


def test_what_holds_no_captures(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(CaptureError, match="holds no captures that can be recognised; name a"):
        open_source(tmp_path)
    with pytest.raises(CaptureError, match=r"notes\.txt: '\.txt' files are no captures"):
        open_source(str(tmp_path / "notes.txt"))
