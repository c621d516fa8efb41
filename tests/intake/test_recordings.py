from __future__ import annotations

import io
import os
import re
import socket
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.capture.readers import ReadOptions, open_source
from cucumbervision.errors import CaptureError, CucumberVisionError
from cucumbervision.intake.archives import Limits, RecordingLimits
from cucumbervision.intake.recordings import open_guarded, play_in_process
from cucumbervision.intake.uploads import accept_uploads
from cucumbervision.pipeline.inputs import count_captures

posix = pytest.mark.skipif(os.name != "posix", reason="needs process groups and rlimits")


@pytest.fixture(scope="module")
def walk(
    tmp_path_factory: pytest.TempPathFactory, make_recording: Callable[[Path, int], Path]
) -> Path:
    """Seven frames, recorded by the SDK."""
    return make_recording(tmp_path_factory.mktemp("walk") / "walk.db3", 7)


def test_a_recording_reads_as_it_does_in_this_process(walk: Path, tmp_path: Path) -> None:
    with walk.open("rb") as stream:
        got = accept_uploads([("Row 3.db3", stream)], tmp_path)
    assert not got.refused
    (source,) = got.sources
    apart = [ref.load() for ref in source.open()]
    assert {one.source for one in apart} == {"Row 3.db3"}
    here = [ref.load() for ref in open_source(walk)]
    assert [c.frame for c in apart] == [c.frame for c in here]
    assert [c.name for c in apart] == [f"Row_3_{c.frame:06d}" for c in here]
    for one, other in zip(apart, here, strict=True):
        np.testing.assert_array_equal(one.color, other.color)
        np.testing.assert_allclose(one.depth_m, other.depth_m, rtol=0, atol=1e-6)
        assert one.intrinsics == other.intrinsics
        assert one.burst_size == other.burst_size


def test_broken_recordings_cost_the_others_nothing(
    walk: Path, tmp_path: Path, frame_npz: bytes
) -> None:
    data = bytearray(walk.read_bytes())
    cut = bytes(data[: len(data) // 2])
    for place in range(100, len(data), 997):
        data[place] ^= 0x5A
    files = [
        ("cut.db3", io.BytesIO(cut)),
        ("flipped.db3", io.BytesIO(bytes(data))),
        ("good.npz", io.BytesIO(frame_npz)),
    ]
    got = accept_uploads(files, tmp_path)
    assert [source.title for source in got.sources] == ["upload", "cut.db3", "flipped.db3"]
    good, *broken = (list(source.open()) for source in got.sources)
    assert good[0].load().name == "good"
    for source, refs in zip(got.sources[1:], broken, strict=True):
        with pytest.raises(CaptureError, match=f"^{re.escape(source.title)}"):
            refs[-1].load()


def run(code: str, folder: Path, **limits: float) -> list[str]:
    """Let Python run something else in the player's place."""
    order = "import sys, json; order = json.loads(sys.argv[1]); "
    errors = play_in_process(
        Path("a.bag"),
        folder / "out",
        RecordingLimits(**limits),  # type: ignore[arg-type]
        command=("-c", order + code),
    )
    assert not [*folder.glob("out/*/capture.json")]
    return [str(error) for error in errors]


@posix
def test_a_hang_is_ended_with_all_that_it_started(tmp_path: Path) -> None:
    import fcntl

    lock, held = tmp_path / "lock", tmp_path / "held"
    child = (
        f"import fcntl, pathlib, time; lock = open({str(lock)!r}, 'w'); "
        f"fcntl.flock(lock, fcntl.LOCK_EX); pathlib.Path({str(held)!r}).touch(); time.sleep(3600)"
    )
    code = f"import subprocess; subprocess.run([sys.executable, '-c', {child!r}])"
    for number, wall_s in enumerate((2.0, 20.0, 200.0)):  # until the child had the time to start
        faults = run(code, tmp_path / str(number), wall_s=wall_s, still_s=1000.0)
        assert faults == [f"a.bag: took longer than {wall_s:g} s; copy or record it again"]
        if held.exists():
            break
    with lock.open("w") as stream:  # waits for as long as the child lives
        fcntl.flock(stream, fcntl.LOCK_EX)


def test_a_player_that_goes_round_without_giving_anything_is_ended(tmp_path: Path) -> None:
    # A damaged recording did so: the SDK computed on, and no frame came.
    round_and_round = "import collections, itertools; collections.deque(itertools.repeat(0), 0)"
    faults = run(round_and_round, tmp_path, still_s=2.0)
    assert faults == ["a.bag: has given nothing for 2 s; copy or record it again"]


@posix
def test_a_crash_is_one_named_error(tmp_path: Path) -> None:
    faults = run("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", tmp_path)
    assert faults == ["a.bag: broke the player (signal 11); copy or record it again"]


@posix
def test_its_memory_and_its_files_are_limited(tmp_path: Path) -> None:
    limited = (
        "from cucumbervision.intake.recordings import limit_this_process as limit; "
        "limit(order['limits']); "
    )
    faults = run(limited + "x = bytearray(3_000_000_000)", tmp_path, memory_bytes=2_000_000_000)
    assert faults == ["a.bag: broke the player (exit code 1); copy or record it again"]
    wrote = limited + "open(order['folder'] + '/report.jsonl', 'wb').write(bytes(2_000_000))"
    (tmp_path / "out").rename(tmp_path / "first")
    faults = run(wrote, tmp_path, output_bytes=1_000_000)
    assert "broke the player" in faults[0] or "unpacks to more" in faults[0]


@posix
def test_what_a_broken_player_writes_is_not_believed(tmp_path: Path) -> None:
    code = "import os; os.makedirs(order['folder'] + '/000000'); "
    code += "os.symlink('/etc/passwd', order['folder'] + '/000000/capture.json')"
    faults = run(code, tmp_path)
    assert len(faults) == 1
    assert "broke the player, which wrote 'capture.json'" in faults[0]
    assert list((tmp_path / "out").iterdir()) == []


def test_an_upload_limit_reaches_the_player(walk: Path, tmp_path: Path) -> None:
    limits = Limits(recording=RecordingLimits(captures=1))
    got = accept_uploads([("walk.db3", walk)], tmp_path, limits)
    refs = got.sources[0].open(ReadOptions(depth_unit_m=0.5, burst=2)).refs()
    capture = next(refs).load()
    assert capture.burst_size == 2
    assert 0.59 < capture.depth_m[5, 5] < 0.61  # the recording's own unit
    with pytest.raises(CucumberVisionError, match="more than 1 captures"):
        next(refs).load()
    assert next(refs, None) is None


@posix
def test_it_sees_no_network_where_the_system_allows(tmp_path: Path) -> None:
    listener = socket.create_server(("127.0.0.1", 0))
    code = (
        "from cucumbervision.intake.recordings import drop_network; import socket; "
        "sys.exit(9) if not drop_network() else None; "
        f"socket.create_connection(('127.0.0.1', {listener.getsockname()[1]}), 5)"
    )
    faults = run(code, tmp_path)
    listener.close()
    if "exit code 9" in faults[0]:
        pytest.skip("user namespaces are off here")
    assert faults == ["a.bag: broke the player (exit code 1); copy or record it again"]


def test_a_guarded_recording_gives_the_same_captures(walk: Path, tmp_path: Path) -> None:
    guarded, plain = (
        [(ref.name, ref.load()) for ref in opener(walk, ReadOptions(burst=3))]
        for opener in (open_guarded, open_source)
    )
    assert [name for name, _ in guarded] == [name for name, _ in plain]
    for (_, one), (_, other) in zip(guarded, plain, strict=True):
        assert (one.frame, one.burst_size, one.source) == (
            other.frame,
            other.burst_size,
            other.source,
        )
        np.testing.assert_allclose(one.depth_m, other.depth_m, rtol=0, atol=1e-6)
    assert count_captures([walk], ReadOptions(), open_guarded) is None
    cut = tmp_path / "cut.db3"
    cut.write_bytes(walk.read_bytes()[:20_000])
    *_, end = open_guarded(cut)
    with pytest.raises(CaptureError, match=r"cut\.db3: "):
        end.load()


def test_what_is_no_recording_is_opened_as_ever(tmp_path: Path, frame_npz: bytes) -> None:
    (tmp_path / "a.npz").write_bytes(frame_npz)
    assert open_guarded(tmp_path / "a.npz").kind == "pair"
    with pytest.raises(CaptureError, match="does not exist"):
        open_guarded(tmp_path / "none.bag")
