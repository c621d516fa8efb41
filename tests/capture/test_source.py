from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.source import CaptureSource, Folder, fail, safe_name
from cucumbervision.errors import CaptureError


def named(*names: str) -> Folder:
    folder = Folder(Path("house"))
    for name in names:
        folder.add(name)
    return folder


def test_captures_of_one_name_stay_apart_and_load_under_theirs() -> None:
    loaded: list[str] = []

    def load(name: str) -> Capture:
        loaded.append(name)
        raise CaptureError("is empty", source=name)

    entries = [(text, number, load, Path(text), None) for number, text in enumerate("aA?a")]
    source = CaptureSource.listed(Path("house"), "native", entries)
    names = [ref.name for ref in source]
    assert names == ["a", "A-2", "_", "a-3"]
    assert (source.total, [ref.frame for ref in source]) == (4, [0, 1, 2, 3])
    for ref in source:
        with pytest.raises(CaptureError):
            ref.load()
    assert loaded == names


def test_an_error_waits_until_its_capture_is_loaded() -> None:
    error = CaptureError("cannot be read", source="a")
    entry = ("a", -1, lambda name: fail(error, name), Path("a"), None)
    (ref,) = CaptureSource.listed(Path("house"), "pair", [entry])
    with pytest.raises(CaptureError, match="cannot be read"):
        ref.load()


@given(st.text() | st.text("ab. ्é/\\", max_size=6) | st.text("é黄", min_size=60, max_size=300))
def test_every_text_makes_a_file_name(text: str) -> None:
    name = safe_name(text)
    assert 0 < len(name.encode()) <= 200
    assert not set(name) & {*'<>:"/\\|?* ', "\0"}
    assert name.strip(".") == name
    assert safe_name(name) == name


def test_long_names_are_cut_between_letters() -> None:
    # Three bytes a letter: of 183 bytes 61 letters stay, a dash and sixteen digits follow.
    name = safe_name("黄" * 100)
    assert name[:62] == "黄" * 61 + "-"
    assert len(name) == 62 + 16
    assert safe_name("x" * 200) == "x" * 200
