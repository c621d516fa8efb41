from __future__ import annotations

import os
import subprocess
import sys
import uuid
from dataclasses import replace
from pathlib import Path

import pytest

from cucumbervision.errors import CucumberVisionError
from cucumbervision.pipeline.fields import FIELDS
from cucumbervision.pipeline.folder import (
    JOURNAL,
    Journal,
    JournalRecord,
    OutputFolder,
    place_of,
)
from cucumbervision.pipeline.measurer import Failure
from cucumbervision.urls import as_path


@pytest.fixture(params=["local", "remote"])
def out(request: pytest.FixtureRequest, tmp_path: Path) -> OutputFolder:
    """An output folder on the disk, or on a store."""
    if request.param == "local":
        return OutputFolder(tmp_path / "out")
    pytest.importorskip("upath")
    return OutputFolder(as_path(f"memory://{uuid.uuid4().hex}"))


@pytest.fixture
def local(tmp_path: Path) -> OutputFolder:
    return OutputFolder(tmp_path / "out")


def record(name: str, content: str = "ab", fruit: int = 1) -> JournalRecord:
    cells = {field.name: None for field in FIELDS}
    rows = [{**cells, "capture": name, "fruit": k, "pose": None} for k in range(1, fruit + 1)]
    return JournalRecord(
        place=place_of("house/a", name),
        content=content,
        stages=("dataset", "kept"),
        digest="cd",
        capture={"name": name, "fruit": rows},
        failures=(Failure("house", name, "DepthError", "a: 黄瓜 has no depth"),),
        models=[{"name": "x"}],
        picture=None,
    )


def segments(out: OutputFolder) -> list[Path]:
    return sorted((out.path / JOURNAL).glob("*.jsonl"))


def test_a_file_replaces_another_and_leaves_no_other(out: OutputFolder) -> None:
    assert not out.has("overlays/a.png")
    for data in (b"first", b"second"):
        out.write("overlays/a.png", data)
    assert (out.path / "overlays/a.png").read_bytes() == b"second"
    assert [path.name for path in (out.path / "overlays").iterdir()] == ["a.png"]
    with out.replacing("table.csv") as path:
        assert path.suffix == ".csv"
        path.write_text("a,b\n")
    assert (out.path / "table.csv").read_text() == "a,b\n"


def test_what_fails_half_way_leaves_what_was_there(out: OutputFolder) -> None:
    out.write("table.csv", b"whole")

    def break_off() -> None:
        with out.replacing("table.csv") as path:
            path.write_bytes(b"ha")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        break_off()
    assert (out.path / "table.csv").read_bytes() == b"whole"
    assert [path.name for path in out.path.rglob("*") if path.is_file()] == ["table.csv"]


def test_the_next_run_removes_what_a_killed_one_left_half_written(local: OutputFolder) -> None:
    pytest.importorskip("fcntl")
    program = (
        "import os, signal, sys; from pathlib import Path\n"
        "from cucumbervision.pipeline.folder import OutputFolder\n"
        "with OutputFolder(Path(sys.argv[1])).replacing('overlays/a.png') as path:\n"
        "    path.write_bytes(b'ha'); os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", program, local.path], check=False)
    left = [path for path in local.path.rglob("*") if path.is_file()]
    assert [path.read_bytes() for path in left] == [b"ha"]
    with local.locked(".lock"):
        local.write("table.csv", b"whole")
    assert sorted(path.name for path in local.path.iterdir()) == [".lock", "overlays", "table.csv"]
    assert not list((local.path / "overlays").iterdir())


def test_two_runs_do_not_write_into_one_folder(local: OutputFolder) -> None:
    pytest.importorskip("fcntl")
    with local.locked(".lock"):
        folder = OutputFolder(local.path)
        with (
            pytest.raises(CucumberVisionError, match="another run is writing into it; wait"),
            folder.locked(".lock"),
        ):
            raise AssertionError
    with local.locked(".lock"):
        pass


def test_a_capture_has_a_place_by_its_location_and_its_name() -> None:
    places = {place_of(*pair) for pair in (("a", "b"), ("a", "c"), ("b", "b"), ("ab", ""))}
    assert len(places) == 4
    assert place_of("a", "b") in places
    assert {len(bytes.fromhex(place)) for place in places} == {16}


def test_a_record_comes_back_from_its_line() -> None:
    sent = record("黄瓜 [b]", fruit=2)
    line = sent.line()
    assert line.count(b"\n") == 1
    assert JournalRecord.from_line(line) == sent
    assert [list(row) for row in sent.rows] == [[field.name for field in FIELDS]] * 2
    assert [row["fruit"] for row in sent.rows] == [1, 2]


def test_the_last_record_of_a_place_counts(out: OutputFolder) -> None:
    first, again, other = record("a"), record("a", "new"), record("b")
    with Journal(out) as journal:
        for one in (first, other, again):
            journal.append(one)
        assert journal.find(first.place) == again
        assert journal.find(place_of("house/a", "c")) is None
        journal.flush()
        assert len(journal) == 2
    # The next run reads them, and writes a segment of its own.
    with Journal(out) as later:
        places = [other.place, place_of("nowhere", "x"), first.place]
        assert list(later.records(places)) == [other, again]
        later.append(replace(first, content="newest"))
        later.flush()
    with Journal(out) as last:
        found = last.find(first.place)
        assert found is not None
        assert found.content == "newest"
        assert last.damaged == 0
    numbers = [path.name.split("-")[0] for path in segments(out)]
    assert numbers == sorted(numbers)
    assert len(set(numbers)) == 3


def test_a_line_that_was_cut_short_is_no_record(local: OutputFolder) -> None:
    with Journal(local) as journal:
        for name in "ab":
            journal.append(record(name))
    (path,) = segments(local)
    path.write_bytes(path.read_bytes()[:-1])
    with Journal(local) as journal:
        assert journal.find(record("a").place) == record("a")
        assert journal.find(record("b").place) is None
        assert (len(journal), journal.damaged) == (1, 1)


@pytest.mark.parametrize("place", [0, 7, 8, 20, 40, 41, 60, -2])
def test_a_changed_byte_makes_a_line_no_record(local: OutputFolder, place: int) -> None:
    with Journal(local) as journal:
        for name in "ab":
            journal.append(record(name))
    (path,) = segments(local)
    head, first, second = path.read_bytes().splitlines(keepends=True)
    broken = bytearray(first)
    broken[place] ^= 1
    path.write_bytes(head + bytes(broken) + second)
    with Journal(local) as journal:
        assert journal.find(record("a").place) is None
        assert journal.find(record("b").place) == record("b")
        assert journal.damaged == 1


@pytest.mark.skipif(sys.platform == "win32", reason="no file sizes to limit")
def test_after_a_full_disk_the_next_record_is_whole(local: OutputFolder) -> None:
    import resource
    import signal

    with Journal(local) as journal:
        journal.append(record("a"))
        (path,) = segments(local)
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 100, limits[1]))
            with pytest.raises(OSError, match="File too large"):
                journal.append(record("b"))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
            signal.signal(signal.SIGXFSZ, before)
        journal.append(record("c"))
        assert journal.find(record("c").place) == record("c")
    with Journal(local) as journal:
        kept = [journal.find(record(name).place) for name in "abc"]
        assert kept == [record("a"), None, record("c")]


@pytest.mark.parametrize("name", ["copy of 000001.jsonl", "²3_.jsonl", "9" * 200 + ".jsonl"])
def test_a_file_of_another_name_in_the_journal_is_read(name: str, local: OutputFolder) -> None:
    with Journal(local) as journal:
        journal.append(record("a"))
    (first,) = segments(local)
    first.rename(first.with_name(name))
    for _ in range(2):
        with Journal(local) as journal:
            assert journal.find(record("a").place) == record("a")
    assert len(segments(local)) == 3


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("no folder")
    with pytest.raises(CucumberVisionError, match="out: cannot be"):
        Journal(OutputFolder(tmp_path / "out"))
    if os.geteuid() == 0:
        return
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o500)
    with pytest.raises(CucumberVisionError, match="closed: cannot be written"):
        Journal(OutputFolder(closed))
