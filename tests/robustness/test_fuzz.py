"""The fuzzer finds what it should, its seeds are valid, and a short run finds nothing."""

from __future__ import annotations

import json
import os
import sqlite3
import struct
from contextlib import closing
from functools import partial
from pathlib import Path
from random import Random
from typing import Any, NoReturn

import numpy as np
import pytest
from tests.robustness import fuzz as fuzzing
from tests.robustness.counted import COUNTS, counts_table, read_counts, with_counts
from tests.robustness.fuzz import damage, find_targets, fuzz, read_input
from tests.robustness.mutations import damaged
from tests.robustness.targets import TARGETS, Target

from cucumbervision.errors import CucumberVisionError

PNG_HEAD = b"\x89PNG\r\n\x1a\n"


def test_every_reader_bears_a_short_run(tmp_path: Path) -> None:
    pytest.importorskip("pyrealsense2", exc_type=ImportError)  # it records one of the seeds
    counts = fuzz(600, seed=20, out=tmp_path)
    assert counts.findings == []
    assert counts.tried.total() == 600
    # Damage reaches deep only where some inputs still pass and most do not.
    assert 200 < counts.refused.total() < 590


@pytest.mark.parametrize(
    "target", [one for one in TARGETS if one.whole and one.weight > 5], ids=lambda one: one.name
)
def test_seeds_are_valid(target: Target, tmp_path: Path) -> None:
    target.seed(tmp_path)
    target.read(tmp_path, "")


def raising(error: type[BaseException]) -> Target:
    def read(folder: Path, _name: str) -> None:
        if [p.name for p in folder.iterdir()] != ["a.txt"] or (
            folder / "a.txt"
        ).read_bytes() != b"1 2 3\n":
            raise error("broken")

    return Target("made here", lambda folder: None, read, 1)


@pytest.mark.parametrize(
    ("error", "kind"), [(KeyError, "unnamed"), (MemoryError, "memory"), (SystemExit, "unnamed")]
)
def test_an_error_without_a_name_is_a_finding(
    error: type[BaseException], kind: str, tmp_path: Path
) -> None:
    seeds = tmp_path / "seeds"
    seeds.mkdir()
    (seeds / "a.txt").write_text("1 2 3\n")
    target = raising(error)
    found = [read_input(target, seeds, n, partial(damage, number=n, seed=1))[0] for n in range(20)]
    assert {one.kind for one in found if one is not None} == {kind}
    # The valid files are as they were, and nothing is left beside them.
    assert [p.name for p in tmp_path.rglob("*")] == ["seeds", "a.txt"]
    assert (seeds / "a.txt").read_bytes() == b"1 2 3\n"


def test_an_input_that_computes_for_ever_is_a_finding(tmp_path: Path) -> None:
    def read(_folder: Path, _name: str) -> NoReturn:
        while True:
            pass

    (tmp_path / "seeds").mkdir()
    (tmp_path / "seeds" / "a.txt").write_text("1")
    endless = Target("endless", lambda folder: None, read, 1)
    limits = fuzzing.Limits(cpu_s=0.2)
    finding, _ = read_input(endless, tmp_path / "seeds", 1, lambda _: "a.txt", limits)
    assert finding is not None
    assert finding.kind == "time"


def die(_folder: Path, name: str) -> None:
    if name:  # the valid files are read
        os._exit(7)


def test_an_input_that_ends_the_process_is_found_and_the_others_are_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Processes are forked here, so that they know the reader that is made here."""
    poses = find_targets(["poses"])[0]
    deadly = Target("deadly", poses.seed, die, poses.weight)
    targets = (poses, deadly)
    monkeypatch.setattr(fuzzing, "TARGETS", targets)
    monkeypatch.setattr(fuzzing, "_START", "fork")
    counts = fuzz(8, seed=1, targets=targets)
    of = [fuzzing.target_of(number, 1, targets).name for number in range(8)]
    assert {one.kind for one in counts.findings} == {"crash"}
    assert [one.number for one in counts.findings] == [n for n in range(8) if of[n] == "deadly"]
    assert counts.tried["poses"] == of.count("poses")


def test_an_input_is_made_again_from_its_number(tmp_path: Path) -> None:
    made = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        find_targets(["poses"])[0].seed(tmp_path / name)
        damage(tmp_path / name, 4, 7)
        made.append({p.name: p.read_bytes() for p in (tmp_path / name).iterdir() if p.is_file()})
    assert made[0] == made[1]


def test_damage_to_a_chunk_keeps_its_checksum_right(tmp_path: Path) -> None:
    from tests.robustness.mutations import _png
    from tests.robustness.seeds import bop

    from cucumbervision.capture.pictures import _whole_png

    bop(tmp_path)
    data = (tmp_path / "rgb" / "000001.png").read_bytes()
    random = Random(5)
    changed = {_png(data, random) for _ in range(40)} - {data}
    assert len(changed) > 10
    assert all(_whole_png(one) for one in changed)


def test_a_number_of_a_network_changes_and_the_network_stays_whole(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    from tests.robustness.binary_numbers import changed_number
    from tests.robustness.seeds import network

    network(tmp_path)
    data, random = (tmp_path / "net.onnx").read_bytes(), Random(3)
    changed = {
        changed_number(data, "onnx", random.randrange, 77, float("nan"), "word") for _ in range(200)
    }
    models = [onnx.ModelProto.FromString(model) for model in changed if model is not None]
    assert len(models) == len(changed) > 20
    weights = [
        onnx.numpy_helper.to_array(m.graph.initializer[0])
        for m in models
        if list(m.graph.initializer[0].dims) == [4, 3, 3, 3]
        and m.graph.initializer[0].data_type == 1
    ]
    assert {int(np.isnan(weight).sum()) for weight in weights} == {0, 1}
    assert {m.ir_version for m in models} == {9, 77}
    assert "word" in {entry.value for m in models for entry in m.metadata_props}
    assert changed_number(b"none", "onnx", random.randrange, 7, 0.0, "") is None


def test_a_number_of_a_recording_changes_and_its_messages_stay_whole(tmp_path: Path) -> None:
    from tests.robustness.binary_numbers import changed_number

    bag = tmp_path / "walk.db3"
    message = struct.pack("<IId", 256, 640, 600.5)
    text = struct.pack("<II", 256, 8) + b"fps: 30\0"
    with closing(sqlite3.connect(bag)) as connection:
        connection.execute("CREATE TABLE topics (id INTEGER PRIMARY KEY, type TEXT)")
        connection.execute(
            "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id, timestamp, data)"
        )
        connection.execute("INSERT INTO topics VALUES (1, 'std_msgs/msg/String'), (2, 'lens')")
        connection.execute(
            "INSERT INTO messages VALUES (1, 1, 5, ?), (2, 2, 6, ?)", (text, message)
        )
        connection.commit()
    random, rows = Random(4), set()
    for _ in range(80):
        changed = changed_number(bag.read_bytes(), "db3", random.randrange, -1, 0.5, "9999")
        assert changed is not None
        with closing(sqlite3.connect(":memory:")) as connection:
            connection.deserialize(changed)
            rows |= set(connection.execute("SELECT timestamp, data FROM messages"))
    assert {time_ns for time_ns, _ in rows} == {5, 6, -1}
    assert {body for _, body in rows if b"fps" in body} == {
        text,
        struct.pack("<II", 256, 10) + b"fps: 9999\0",
    }
    assert {body[8:] for _, body in rows if b"fps" not in body} >= {
        struct.pack("<d", 600.5),
        struct.pack("<I", 2**32 - 1) + struct.pack("<d", 600.5)[4:],
    }


def test_json_damage_reaches_values(tmp_path: Path) -> None:
    made = {damaged(b'{"a": [1, 2], "b": "x"}', "json", Random(n)) for n in range(400)}
    longest = max(made, key=len)
    assert b"9" * 6000 in b"".join(made)
    assert len(longest) > 50_000
    with pytest.raises((RecursionError, ValueError)):
        json.loads(longest)


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


@pytest.mark.parametrize("by", fuzzing.GENERATORS)
def test_a_run_goes_on_where_the_last_one_ended(by: str, tmp_path: Path) -> None:
    targets, counted = find_targets(["poses", "truth"]), tmp_path / "counts.json"
    for inputs in (20, 50):
        counts = fuzz(inputs, 3, targets, by=by, counted=counted)
    assert counts.findings == []
    assert (counts.numbers, counts.tried.total()) == (50, 50)
    said = read_counts(counted)[f"{by}: truth tables, poses"]
    assert (said["numbers"], said["seed"], sum(said["tried"].values())) == (50, 3, 50)


def test_what_was_found_and_is_none_any_more_is_counted_as_mended(tmp_path: Path) -> None:
    counted = tmp_path / "counts.json"
    found = fuzzing.Finding("poses", 4, "unnamed", "x.py:1 KeyError", "")
    fuzzing.Counts(findings=[found], numbers=10, seed=3).save(counted, "mutations: poses")
    counts = fuzz(10, 3, find_targets(["poses"]), counted=counted)
    assert (counts.findings, counts.mended) == ([], {found.key: 1})
    assert read_counts(counted)["mutations: poses"]["mended"] == {found.key: 1}


def test_what_was_tried_is_a_line_each() -> None:
    whole: dict[str, Any] = {"findings": [], "mended": {"x": 2}, "refused": {"poses": 1500}}
    whole["tried"] = {"ONNX": 1200, "poses": 800}
    part = {"tried": {"recordings": 300}, "refused": {}, "findings": [{}], "mended": {}}
    counts = {"mutations": whole, "hypothesis: recordings": part, "faults": {"kept everything": 14}}
    assert counts_table(counts).splitlines()[2:] == [
        "| damaged files, our mutations | 2,000 (1,200 of them ONNX) "
        "| 1,500 refused by name, the others read; 0 findings, 2 mended |",
        "| the same, Hypothesis: recordings | 300 "
        "| 0 refused by name, the others read; 1 findings |",
        "| faults in real commands | 14 | 14 kept everything, none lost |",
    ]


def test_the_documentation_has_the_counts() -> None:
    page = (Path(__file__).parents[2] / "docs" / "safety.md").read_text(encoding="utf-8")
    assert with_counts(page, read_counts(COUNTS)) == page
