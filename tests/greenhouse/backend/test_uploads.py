from __future__ import annotations

import errno
import math
from pathlib import Path

import pytest
from pydantic import ValidationError

from cucumbervision.errors import UploadError
from cucumbervision_greenhouse.backend.uploads import (
    Sending,
    SentFile,
    Upload,
    UploadOutcome,
    Uploads,
)
from cucumbervision_greenhouse.store.records import key_of

ROUND = key_of("uploads")
FILES = Sending(round=ROUND, files=(SentFile(name="a.zip", size=6), SentFile(name="b", size=0)))


def only(uploads: Uploads) -> Upload:
    (one,) = uploads.all(ROUND)
    return one


def test_a_file_goes_on_where_it_ended_after_a_reload_and_a_restart(tmp_path: Path) -> None:
    uploads = Uploads(tmp_path / "up")
    assert uploads.begin(FILES, 10) == [0, 0]
    assert uploads.append(FILES.key, 0, 0, b"abc") == 3
    assert uploads.append(FILES.key, 0, 0, b"abc") == 3  # sent again: it is there
    assert uploads.append(FILES.key, 0, 5, b"f") == 3  # sent too early: not taken
    assert not uploads.is_whole(FILES.key)
    again = Uploads(tmp_path / "up")
    assert again.begin(FILES, 10) == [3, 0]
    assert again.to_measure() == []
    assert again.append(FILES.key, 0, 3, b"def") == 6
    assert again.to_measure() == [FILES.key]
    named = {name: path.read_bytes() for name, path in again.files(FILES.key)}
    assert named == {"a.zip": b"abcdef", "b": b""}


@pytest.mark.parametrize("damaged", [b"\xff", b"{", b"{}", b"[" * 100_000])
def test_a_damaged_upload_does_not_hold_up_the_others(damaged: bytes, tmp_path: Path) -> None:
    uploads = Uploads(tmp_path)
    other = FILES.model_copy(update={"camera": "x", "files": FILES.files[:1]})
    for sending in (FILES, other):
        uploads.begin(sending, 10)
    (tmp_path / FILES.key / "upload.json").write_bytes(damaged)
    assert [upload.sending for upload in uploads.all()] == [other]
    assert uploads.read(FILES.key) is None


def test_what_cannot_be_announced_leaves_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for odd in (math.nan, math.inf):
        with pytest.raises(ValidationError):
            SentFile(name="a.zip", size=6, changed=odd)

    def is_full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("cucumbervision_greenhouse.backend.uploads.replace_text", is_full)
    with pytest.raises(OSError, match="No space"):
        Uploads(tmp_path / "up").begin(FILES, 10)
    assert list((tmp_path / "up").iterdir()) == []


def test_a_file_is_named_with_its_folders() -> None:
    path = "house 7/" * 50 + "a.png"  # 405 characters, as a browser names the files of a folder
    assert SentFile(name=path, size=1).name == path
    with pytest.raises(ValidationError):
        SentFile(name="x" * 501, size=1)


def test_what_is_too_large_is_refused_before_it_is_sent(tmp_path: Path) -> None:
    uploads = Uploads(tmp_path / "up")
    with pytest.raises(UploadError, match="more than the 0 MB that are taken"):
        uploads.begin(FILES, 5)
    assert uploads.all() == []
    huge = Sending(round=ROUND, files=(SentFile(name="a.zip", size=10**18),))
    with pytest.raises(UploadError, match="the disk has room for"):
        uploads.begin(huge, 10**19)
    uploads.begin(FILES, 10)
    with pytest.raises(UploadError, match=r"a\.zip: is larger than it was"):
        uploads.append(FILES.key, 0, 0, b"seven b")
    for key, number in ((FILES.key, 2), (FILES.key, -1), (key_of("other"), 0)):
        with pytest.raises(UploadError, match="choose the files again"):
            uploads.append(key, number, 0, b"")


def test_outcomes_stay_and_a_killed_run_forgets_none(tmp_path: Path) -> None:
    uploads = Uploads(tmp_path / "up")
    uploads.begin(FILES, 10)
    uploads.append(FILES.key, 0, 0, b"abcdef")
    assert uploads.try_once(FILES.key).tries == 0
    saved = UploadOutcome(name="a", saved=True, words="3 fruit")
    uploads.note(FILES.key, [saved])
    again = Uploads(tmp_path / "up")  # killed here
    assert again.to_measure() == [FILES.key]
    assert again.try_once(FILES.key).tries == 1
    there = UploadOutcome(name="a", saved=False, words="is in the round already")
    lost = UploadOutcome(name="b", saved=False, words="cannot be read")
    again.note(FILES.key, [there, lost], done=True)
    assert only(again).outcomes == (saved, lost)
    assert again.to_measure() == []
    assert [path.name for path in (tmp_path / "up" / FILES.key).iterdir()] == ["upload.json"]
    # The same files sent again are a new upload.
    assert again.begin(FILES, 10) == [0, 0]
    assert only(again).outcomes == ()
