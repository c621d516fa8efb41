"""The fuzzer finds what it should, its seeds are valid, and a short run finds nothing."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from random import Random
from typing import Any

import pytest

from cucumbervision.errors import CucumberVisionError
from cucumbervision_lab.robustness import fuzz as fuzzing
from cucumbervision_lab.robustness.fuzz import Limits, find_targets, fuzz, replay
from cucumbervision_lab.robustness.fuzz_log import add_to_log
from cucumbervision_lab.robustness.mutations import damaged
from cucumbervision_lab.robustness.seed_folder import SeedFolder
from cucumbervision_lab.robustness.targets import TARGETS, Target

PNG_HEAD = b"\x89PNG\r\n\x1a\n"


def test_every_reader_bears_a_short_run(tmp_path: Path) -> None:
    pytest.importorskip("pyrealsense2", exc_type=ImportError)  # it records one of the seeds
    result = fuzz(600, seed=20, out=tmp_path)
    assert result.found == Counter(), result.finds
    assert sum(result.tried.values()) == 600
    # Damage reaches deep only where some inputs still pass and most do not.
    assert 200 < sum(result.refused.values()) < 590


@pytest.mark.parametrize(
    "target", [d for d in TARGETS if d.whole and d.weight > 5], ids=lambda d: d.name
)
def test_seeds_are_valid(target: Target, tmp_path: Path) -> None:
    target.seed(tmp_path)
    target.read(tmp_path, "")


def _fails(error: type[BaseException], when: bytes = b"") -> Target:
    def read(folder: Path, _name: str) -> None:
        if (folder / "a.txt").read_bytes() != b"1 2 3\n":
            raise error("broken")

    def seed(folder: Path) -> None:
        (folder / "a.txt").write_text("1 2 3\n")

    return Target("made here", seed, read, 1)


@pytest.mark.parametrize(
    ("error", "kind"), [(KeyError, "unnamed"), (MemoryError, "memory"), (SystemExit, "unnamed")]
)
def test_what_has_no_name_is_a_find(error: type[BaseException], kind: str, tmp_path: Path) -> None:
    target = _fails(error)
    target.seed(tmp_path)
    folder = SeedFolder.of(tmp_path)
    found = [fuzzing._one(target, folder, 1, n, Limits(), Counter()) for n in range(20)]
    kinds = {one.kind for one in found if one is not None}
    assert kinds == {kind}
    # Whatever was done to it, the folder is as it was.
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_bytes() == b"1 2 3\n"


def test_an_input_is_made_again_from_its_number(tmp_path: Path) -> None:
    targets = find_targets(["poses"])
    first, second = (
        {p.name: p.read_bytes() for p in sorted(folder.iterdir()) if p.is_file()}
        for folder in (tmp_path / "a", tmp_path / "b")
        if replay(4, 7, folder, targets).name == "poses"
    )
    assert first == second


def test_damage_to_a_chunk_keeps_its_checksum_right(tmp_path: Path) -> None:
    from cucumbervision.capture.files import _whole_png
    from cucumbervision_lab.robustness.seeds import bop

    bop(tmp_path)
    data = (tmp_path / "rgb" / "000001.png").read_bytes()
    random = Random(5)
    changed = {fuzzing_png(data, random) for _ in range(40)} - {data}
    assert len(changed) > 10
    assert all(_whole_png(one) for one in changed)


def fuzzing_png(data: bytes, random: Random) -> bytes:
    from cucumbervision_lab.robustness.mutations import _png

    return _png(data, random)


def test_json_damage_reaches_values(tmp_path: Path) -> None:
    made = {damaged(b'{"a": [1, 2], "b": "x"}', "json", Random(n)) for n in range(200)}
    longest = max(made, key=len)
    assert b"9" * 6000 in b"".join(made)
    assert len(longest) > 50_000
    with pytest.raises((RecursionError, ValueError)):
        json.loads(longest)


def test_counts_of_several_runs_add_up(tmp_path: Path) -> None:
    log = tmp_path / "runs.jsonl"
    poses = find_targets(["poses"])
    sums = [add_to_log(fuzz(n, seed=seed, targets=poses), log) for n, seed in ((30, 1), (20, 2))]
    assert [(one.runs, one.inputs, one.finds) for one in sums] == [(1, 30, 0), (2, 50, 0)]
    # The same run made again is the same inputs: it counts once.
    assert add_to_log(fuzz(20, seed=2, targets=poses), log).inputs == 50


def test_of_runs_with_one_seed_the_longest_counts_however_short_the_others(tmp_path: Path) -> None:
    log, targets = tmp_path / "runs.jsonl", find_targets(["poses", "truth"])
    short = fuzz(1, seed=1, targets=targets)
    assert sorted(short.tried.values()) == [0, 1]  # one of the readers had no turn
    add_to_log(short, log)
    together = add_to_log(fuzz(30, seed=1, targets=targets), log)
    assert (together.runs, together.inputs) == (1, 30)


def test_what_a_process_says_last_is_heard_on_a_busy_machine(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It ends between the moment when there was nothing to hear yet and the look at it."""
    follow = fuzzing._Worker.follow

    class Late:
        def __init__(self, worker: fuzzing._Worker) -> None:
            self.pipe, self.process, self.asked = worker._here, worker._process, 0

        def poll(self, seconds: float) -> bool:
            self.asked += 1
            if self.asked == 1:
                self.process.join()
                return False
            return self.pipe.poll(seconds)

        def recv(self) -> Any:
            return self.pipe.recv()

        def close(self) -> None:
            self.pipe.close()

    def late(self: fuzzing._Worker, *given: Any) -> int:
        self._here = Late(self)  # type: ignore[assignment]
        return follow(self, *given)

    monkeypatch.setattr(fuzzing._Worker, "follow", late)
    result = fuzz(30, seed=1, targets=find_targets(["poses"]))
    assert (sum(result.tried.values()), result.found) == (30, Counter())


def test_the_sum_says_which_readers_had_fewest_inputs(tmp_path: Path) -> None:
    log, targets = tmp_path / "runs.jsonl", find_targets(["poses", "truth"])
    add_to_log(fuzz(6, seed=1, targets=targets), log)
    together = add_to_log(fuzz(6, seed=2, targets=targets), log)
    assert sum(together.readers.values()) == 12
    assert set(together.readers) == {"poses", "truth tables"}


@pytest.mark.parametrize(
    ("name", "damaged", "left"),
    [
        ("native captures", "one/depth_000000.png", "burst/capture.json"),
        ("picture pairs, arrays", "arrays/depth_c.npy", "whole.npz"),
        ("profiles, registry, audit", "recipe.toml", "models.toml"),
        ("camera files", "bop.json", "matrix.json"),
        ("uploads", "walk.npz", "walk.zip"),
    ],
)
def test_only_what_reads_the_damaged_file_is_run(
    name: str, damaged: str, left: str, tmp_path: Path
) -> None:
    target = find_targets([name.lower()])[0]
    target.seed(tmp_path)
    (tmp_path / left).write_bytes(b"broken")
    target.read(tmp_path, damaged)
    with pytest.raises(CucumberVisionError):
        target.read(tmp_path, left)
    with pytest.raises(CucumberVisionError):
        target.read(tmp_path, "")
    (tmp_path / damaged).write_bytes(b"broken too")
    with pytest.raises(CucumberVisionError):
        target.read(tmp_path, damaged)


def test_damage_does_not_depend_on_what_was_damaged_before() -> None:
    data = json.dumps({"a": [[1, 2], {"b": [{}, []]}], "c": {"d": "x"}}).encode()
    alone = [damaged(data, "json", Random(n)) for n in range(300)]
    again = [damaged(data, "json", Random(n)) for n in reversed(range(300))]
    assert alone == again[::-1]
