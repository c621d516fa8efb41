"""Rows are the same wherever captures are measured, and a process that dies costs none."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import CaptureRef, CaptureSource, ReadOptions, example_captures
from cucumbervision.errors import CaptureError, CucumberVisionError
from cucumbervision.methods.result import MethodName
from cucumbervision.run.batch import (
    Engine,
    Item,
    Listed,
    Outcome,
    Processes,
    ResultWorker,
    Worker,
    in_process,
    in_turn,
    list_captures,
    measure_all,
)
from cucumbervision.run.measurer import Failure, Measurer
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import BatchOptions, measure_inputs

OPTIONS = MeasureOptions(instances="dataset", methods=(MethodName.M1, MethodName.M3))


def test_two_processes_give_the_rows_of_one_and_recordings_are_read_in_the_parent(
    tmp_path: Path,
) -> None:
    here = os.getpid()

    def opener(path: Path, options: ReadOptions) -> CaptureSource:
        """The bundled captures, the second as a recording's: known by loading it alone."""
        first, second, third = open_source(path, options)

        def load() -> Capture:
            assert os.getpid() == here
            return second.load()

        played = replace(second, parts=None, load=load)
        refs = [first, played, third, CaptureRef("end", -1, _raise, "end")]
        return CaptureSource(path, "test", lambda: iter(refs), len(refs))

    tables: list[list[bytes]] = []
    for engine in (in_process, Processes(2)):
        out = tmp_path / f"out{len(tables)}"
        batch = BatchOptions(opener=opener, engine=engine)
        result = measure_inputs([example_captures()], out, OPTIONS, batch=batch)
        assert (result.captures, result.exit_code) == (3, 1)
        tables.append([(out / f"{n}.csv").read_bytes() for n in ("measurements", "failures")])
    assert tables[0] == tables[1]


def _raise() -> Capture:
    raise CaptureError("stopped in the middle", source="recording")


def killing(path: Path, once: Path) -> Capture:
    """Kill the process that reads it, the first time or always."""
    if not once.exists():
        if once.parent.exists():
            once.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return next(iter(open_source(path))).load()


@pytest.mark.parametrize("always", [False, True])
def test_a_worker_that_is_killed_costs_at_most_its_own_capture(
    tmp_path: Path, always: bool
) -> None:
    house = Path(shutil.copytree(example_captures(), tmp_path / "house"))
    once = tmp_path / ("nowhere" if always else "house") / "once"

    def opener(path: Path, options: ReadOptions) -> CaptureSource:
        def refs() -> Iterator[CaptureRef]:
            first, *others = open_source(path, options)
            yield replace(first, load=Killing(house / first.name, once))
            yield from others

        return CaptureSource(path, "test", refs, 3)

    batch = BatchOptions(opener=opener, engine=Processes(2))
    result = measure_inputs([house], tmp_path / "out", OPTIONS, batch=batch)
    assert (result.captures, result.exit_code) == ((2, 1) if always else (3, 0))
    assert [failure.capture for failure in result.failures] == ["simulated-bench"] * always
    assert all("was killed twice" in failure.message for failure in result.failures)


class Killing:
    """A loader that can be sent to another process."""

    def __init__(self, path: Path, once: Path) -> None:
        self._path, self._once = path, once

    def __call__(self) -> Capture:
        return killing(self._path, self._once)


class Names(Worker[str]):
    """Makes of each result its capture's name."""

    def measure(self, capture: Capture) -> Outcome[str]:
        return Outcome(capture.name)


@pytest.mark.parametrize("engine", [in_turn, in_process, Processes(2)])
def test_outcomes_come_in_order_with_failures_as_values(engine: Engine) -> None:
    first, second, third = list_captures([example_captures()], OPTIONS.reading)
    nowhere = Failure("nowhere", "", "CaptureError", "nowhere: does not exist")
    broken = Listed("house", CaptureRef("broken", 0, _raise), "broken")
    items = [first, nowhere, second, broken, third]
    done = list(measure_all(items, Names(Measurer(OPTIONS)), engine))
    assert [item for item, _ in done] == items
    names = ["simulated-bench", None, "simulated-row-a", None, "simulated-row-b"]
    assert [outcome.value for _, outcome in done] == names
    told = [[failure.message for failure in outcome.failures] for _, outcome in done]
    assert told == [[], ["nowhere: does not exist"], [], ["recording: stopped in the middle"], []]


def test_in_turn_asks_for_no_item_before_the_last_was_dealt_with() -> None:
    log: list[str] = []

    def items() -> Iterator[Item]:
        for capture in list_captures([example_captures()], OPTIONS.reading):
            assert isinstance(capture, Listed)
            log.append(f"asked {capture.name[-1]}")
            yield capture

    for item, outcome in measure_all(items(), ResultWorker(Measurer(OPTIONS)), in_turn):
        assert isinstance(item, Listed)
        assert outcome.value is not None
        log.append(f"done {outcome.value.capture.name[-1]}")
    assert log == ["asked h", "done h", "asked a", "done a", "asked b", "done b"]


def test_a_stopped_loop_begins_nothing_and_still_names_what_failed() -> None:
    first, second, _ = list_captures([example_captures()], OPTIONS.reading)
    nowhere = Failure("nowhere", "", "CaptureError", "nowhere: does not exist")
    seen: list[str | None] = []
    for _, outcome in measure_all(
        [first, second, nowhere], Names(Measurer(OPTIONS)), in_turn, lambda: bool(seen)
    ):
        seen.append(outcome.value or "".join(failure.message for failure in outcome.failures))
    assert seen == ["simulated-bench", "", "nowhere: does not exist"]


def test_what_nothing_can_be_measured_without_ends_the_loop(tmp_path: Path) -> None:
    lost = replace(OPTIONS, calibration=tmp_path / "gone.json")
    listed = list_captures([example_captures()], lost.reading)
    with pytest.raises(CucumberVisionError, match=r"gone\.json"):
        list(measure_all(listed, ResultWorker(Measurer(lost))))
