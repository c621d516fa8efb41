from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

from cucumbervision.capture.frames import Stop
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import CameraError
from cucumbervision.networks.registry import load_registry
from cucumbervision.run.options import MeasureOptions
from cucumbervision_greenhouse.jobs import Job, JobQueue, Progress, progress_of
from cucumbervision_greenhouse.measuring import SharedMeasurer, measure_waiting
from cucumbervision_greenhouse.store.records import Round, key_of
from cucumbervision_greenhouse.store.repository import Store
from cucumbervision_greenhouse.store.waiting import Waiting, WaitingCaptures


def test_jobs_run_one_after_the_other_in_their_order() -> None:
    done: list[int] = []
    go, worker = threading.Event(), JobQueue()
    first = worker.submit("first", lambda job: done.append(1) if go.wait(300) else None)
    second = worker.submit("second", lambda job: done.append(2))
    assert not second.future.running()
    assert not second.finished
    assert worker.unfinished() == [first, second]
    go.set()
    assert second.wait(300)
    assert done == [1, 2]
    assert worker.unfinished() == []


def test_a_named_error_is_shown_as_it_is_and_the_next_job_runs() -> None:
    def fails(job: Job) -> None:
        raise CameraError("no camera", remedy="connect one")

    worker = JobQueue()
    job, after = worker.submit("fails", fails), worker.submit("after", lambda job: 7)
    assert after.future.result(300) == 7
    assert (job.finished, job.error) == (True, "no camera; connect one")


def test_an_unforeseen_error_is_shown_with_its_kind() -> None:
    job = JobQueue().submit("divides", lambda job: 1 / 0)
    assert job.wait(300)
    assert job.error == "ZeroDivisionError: division by zero"


OWN, OTHER = key_of("own"), key_of("other")


def waits(number: int, round_key: str) -> Waiting:
    return Waiting(key_of(number), round_key, Stop(), float(number), Path(str(number)))


def test_what_waits_is_counted_by_round_whatever_it_came_in() -> None:
    queue = [waits(1, OWN), waits(2, OTHER), waits(3, OWN), waits(4, OTHER), waits(5, OTHER)]
    measured = {str(k): OWN for k in range(4)} | {str(k): OTHER for k in range(4, 9)}
    found = progress_of(OWN, queue, [], measured)
    assert found.words == "Measuring: 4 of 6 captures; 3 captures of other rounds wait"
    assert (found.waiting, found.done, found.total) == (2, 4, 6)


def test_work_on_another_round_is_not_this_one_s() -> None:
    jobs = [
        Job("Measuring", round_key=None),
        Job("Merging", round_key=OTHER),
        Job("Measuring fruit by all their views", OWN, 9, 4),
    ]
    assert progress_of(OWN, [], jobs=jobs).words == "Measuring fruit by all their views: 4 of 9"
    assert progress_of(OWN, [], jobs=jobs[:2]) == Progress()
    assert progress_of(OWN, [waits(1, OWN)], jobs=jobs).words == "Measuring: 0 of 1 capture"


def test_a_queue_is_counted_on_while_captures_come(store: Store, tmp_path: Path) -> None:
    capture = next(iter(open_source(example_captures()))).load()
    for key in (OWN, OTHER):
        store.save_round(Round(key))
    said: list[str] = []

    class Queue(WaitingCaptures):
        def press(self, number: int, key: str) -> None:
            place = Stop("1", "left", float(number))
            self.put(replace(capture, stop=place), key_of("press", number), key, float(number))

        def done(self, one: Waiting) -> None:
            super().done(one)
            said.append(progress_of(OWN, self.captures(), measured=job.measured).words)
            if len(said) == 1:
                self.press(5, OWN)

    queue, job = Queue(tmp_path / "waiting"), Job("Measuring", round_key=None)
    for number, key in ((1, OWN), (2, OTHER), (3, OWN), (4, OTHER)):
        queue.press(number, key)
    options, measurer = MeasureOptions(instances="auto"), SharedMeasurer(load_registry())
    assert measure_waiting(queue, measurer, store, lambda: options, print, job) == 5
    assert said == [
        "Measuring: 1 of 2 captures; 2 captures of other rounds wait",
        "Measuring: 1 of 3 captures; 1 capture of other rounds waits",
        "Measuring: 2 of 3 captures; 1 capture of other rounds waits",
        "Measuring: 2 of 3 captures",
        "",
    ]
