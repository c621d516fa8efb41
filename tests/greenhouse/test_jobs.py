from __future__ import annotations

import threading

from cucumbervision.errors import CameraError
from cucumbervision_greenhouse.jobs import KEPT, Job, JobQueue


def test_jobs_run_one_after_the_other_in_their_order() -> None:
    done: list[int] = []
    go = threading.Event()
    with JobQueue() as worker:
        first = worker.submit("first", lambda job: done.append(1) if go.wait(300) else None)
        second = worker.submit("second", lambda job: done.append(2))
        assert not second.future.running()
        assert not second.finished
        assert worker.unfinished() == [first, second]
        go.set()
        assert second.wait(300)
    assert done == [1, 2]


def test_a_job_counts_its_steps_and_notes() -> None:
    def work(job: Job) -> str:
        job.total = 4
        job.step()
        job.step("a.png: broken")
        counted.append((job.done, job.total))
        return "done"

    counted: list[tuple[int, int]] = []
    with JobQueue() as worker:
        job = worker.submit("two of four", work)
        assert job.wait(300)
    assert counted == [(2, 4)]
    assert (job.result, job.notes) == ("done", ["a.png: broken"])


def test_a_named_error_is_told_as_it_is_and_the_next_job_runs() -> None:
    def fails(job: Job) -> None:
        raise CameraError("no camera", remedy="connect one")

    with JobQueue() as worker:
        job, after = worker.submit("fails", fails), worker.submit("after", lambda job: 7)
        assert after.wait(300)
    assert (job.finished, job.error) == (True, "no camera; connect one")
    assert after.result == 7


def test_an_unforeseen_error_is_told_with_its_kind() -> None:
    with JobQueue() as worker:
        job = worker.submit("divides", lambda job: 1 / 0)
        assert job.wait(300)
    assert job.error == "ZeroDivisionError: division by zero"


def test_old_results_are_dropped() -> None:
    with JobQueue() as worker:
        jobs = [worker.submit(str(k), lambda job: None) for k in range(KEPT)]
        assert jobs[-1].wait(300)
        for k in range(5):
            assert worker.submit(f"more {k}", lambda job: None).wait(300)
        held = [job for job in jobs if worker.get(job.number) is not None]
    assert len(held) < KEPT
    assert worker.get(None) is None
