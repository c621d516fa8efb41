from __future__ import annotations

import threading

import pytest

pytest.importorskip("streamlit")

from cucumbervision.errors import CameraError
from cucumbervision_greenhouse.resources import Job, JobQueue


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
