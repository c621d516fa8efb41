"""The page of proofs: every promise has a check that is there, and nothing is kept by default."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def proof() -> ModuleType:
    spec = importlib.util.spec_from_file_location("proof", ROOT / "benchmarks" / "proof.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["proof"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def run_of(proof: ModuleType, printed: str, **changes: Any) -> Any:
    given = {"key": "two", "form": "full", "command": "full one", "printed": printed, "code": 0}
    about = {"seconds": 1.5, "when": "2026-01-02 03:04 UTC", "machine": "2 cores", "commit": "abc"}
    return proof.Run(**{**given, **about, **changes})


def test_every_check_names_files_that_are_there(proof: ModuleType) -> None:
    found = proof.promises()
    assert len({one.key for one in found}) == len(found)
    for one in found:
        assert bool(one.not_checked) != bool(one.quick or one.full), one.key
        words = f"{one.quick} {one.full}".split()
        paths = [word for word in words if word.startswith(("benchmarks/", "tests/"))]
        assert [path for path in paths if not (ROOT / path).exists()] == []


def test_a_promise_is_kept_by_what_was_printed_and_how_it_ended(proof: ModuleType) -> None:
    two = proof.Promise(
        "two", "Twice as fast", "quick one", "full one", shown=r"times ([\d.,]+)", aim=">= 1.7"
    )
    verdicts = {
        "kept": run_of(proof, "times 1.2\ntimes 1.8"),
        "NOT REACHED": run_of(proof, "times 1.6"),
        "NOT KEPT": run_of(proof, "crash"),
        "not reached by the quick form": run_of(
            proof, "times 1", form="quick", command="quick one"
        ),
        "not checked: no run": None,
    }
    assert {proof.verdict(two, run): run for run in verdicts.values()} == verdicts
    assert proof.verdict(two, run_of(proof, "times 1.8", code=1)) == "NOT REACHED"


def test_the_page_is_made_of_what_a_folder_holds(proof: ModuleType, tmp_path: Path) -> None:
    first = proof.promises()[0]
    printed = "| pipeline beyond its networks | 7.5 % | <= 8: kept |"
    for form, text in (("quick", "nothing"), ("full", printed)):
        run = run_of(proof, text, key=first.key, form=form, command=first.command(full=True))
        run.keep(tmp_path)
    text = proof.page(tmp_path)
    assert f"| [{first.says}](#{first.key}) | kept | 7.5 (aim <= 8) |" in text
    assert "1 kept, 0 not reached or not shown" in text
    assert f"```text\n{printed}\n```" in text
    assert "2026-01-02 03:04 UTC, 2 cores, at abc, 1.5 s:" in text


def test_a_page_keeps_what_was_checked_before_and_nothing_else(
    proof: ModuleType, tmp_path: Path
) -> None:
    first, second, *_ = proof.promises()
    for one, printed in ((first, "beyond its networks | 9.5 |"), (second, "no answer")):
        run_of(proof, printed, key=one.key, command=one.full).keep(tmp_path / "before")
    before = proof.page(tmp_path / "before")
    (tmp_path / "none").mkdir()
    assert proof.page(tmp_path / "none", before) == before
    # A new run takes the place of the old one, and the other check stays as it was.
    run_of(proof, "pipeline beyond its networks | 7.5 |", key=first.key, command=first.full).keep(
        tmp_path / "now"
    )
    both = proof.page(tmp_path / "now", before)
    assert f"| [{first.says}](#{first.key}) | kept | 7.5 (aim <= 8) |" in both
    assert "9.5" not in both
    assert "```text\nno answer\n```" in both
    assert "1 kept, 1 not reached or not shown" in both
    # Of a promise that was changed nothing was shown.
    changed = proof.page(tmp_path / "none", before.replace(first.says, "Something else"))
    assert f"| {first.says} | not checked: no run |" in changed


def test_no_place_of_this_machine_is_shown(proof: ModuleType, tmp_path: Path) -> None:
    promise = proof.Promise("place", "Says where", "echo $PWD/runs/a.jsonl: 2 runs", shown="runs")
    assert proof.check(promise, full=False).printed == "runs/a.jsonl: 2 runs\n"
    printed = tmp_path / "printed.txt"
    printed.write_text(f"{ROOT}/runs/a.jsonl: 3 runs\n")
    taken = proof.take(f"place={printed}@abc", {"place": promise})
    assert taken.printed == "runs/a.jsonl: 3 runs\n"


def test_a_command_is_run_and_what_it_printed_is_kept(proof: ModuleType) -> None:
    promise = proof.Promise("echo", "It echoes", "echo times 2 {tmp}; exit 3", shown="times")
    run = proof.check(promise, full=False)
    assert (run.printed, run.code, run.form) == ("times 2 OUT\n", 3, "full")
    assert proof.verdict(promise, run) != "kept"
