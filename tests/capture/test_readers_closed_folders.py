"""Folders that may not be read, as any user but root meets them."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.readers.native import write_native
from cucumbervision.errors import CaptureError


@pytest.fixture
def closed(monkeypatch: pytest.MonkeyPatch) -> Callable[[Path], None]:
    """Make `os.walk` meet a folder that it may not list, which root never does."""

    def close(folder: Path) -> None:
        walk = os.walk

        def refused(path: Any, onerror: Any = None, **how: Any) -> Iterator[Any]:
            for place, folders, files in walk(path, **how):
                if Path(place) == folder:
                    onerror(PermissionError(errno.EACCES, "Permission denied", str(folder)))
                else:
                    yield place, folders, files

        monkeypatch.setattr(os, "walk", refused)

    return close


def test_a_closed_folder_fails_by_its_name_and_the_others_load(
    tmp_path: Path, capture: Capture, closed: Callable[[Path], None]
) -> None:
    write_native(capture, tmp_path / "a")
    write_native(capture, tmp_path / "b")
    closed(tmp_path / "b")
    source = open_source(tmp_path)
    first, second = source
    assert source.total == 2
    assert first.load().frame == capture.frame
    with pytest.raises(CaptureError, match=r"/b: cannot be read \(Permission denied\); check who"):
        second.load()


def test_where_nothing_else_is_there_the_whole_fails(
    tmp_path: Path, closed: Callable[[Path], None]
) -> None:
    closed(tmp_path)
    with pytest.raises(CaptureError, match="cannot be read"):
        open_source(tmp_path)
