"""Run a function for many jobs in several processes, and go on after an interruption."""

from __future__ import annotations

import json
import multiprocessing
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import cv2

from cucumbervision.errors import DataSetError, wrap_reader_errors
from cucumbervision.run.batch import end_with_parent
from cucumbervision_lab.arrays import Progress

Job = TypeVar("Job")
Result = TypeVar("Result")


def each_done(
    function: Callable[[Job], Result], jobs: Sequence[Job], workers: int
) -> Iterator[Result]:
    """Yield the results of a function for each job as they complete.

    Parameters
    ----------
    function : callable
        Function that can be pickled; runs with one OpenCV thread per process.
    jobs : sequence
        Arguments of the calls.
    workers : int
        Number of processes. With one worker or one job, everything runs in this process, in order.

    Yields
    ------
    object
        A result. No further job is started after an error or an interruption.

    Examples
    --------
    >>> list(each_done(str, [1, 2], workers=1))
    ['1', '2']
    """
    if workers <= 1 or len(jobs) <= 1:
        yield from map(function, jobs)
        return
    # Forking a process with OpenCV or torch threads may deadlock.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, _begin_worker) as pool:
        waiting = [pool.submit(function, job) for job in jobs]
        try:
            for job in as_completed(waiting):
                yield job.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _begin_worker() -> None:
    cv2.setNumThreads(1)
    threading.Thread(target=end_with_parent, daemon=True).start()


def kept_rows(
    file: Path,
    jobs: Mapping[str, Job],
    function: Callable[[Job], list[dict[str, Any]]],
    workers: int = 1,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Return the rows that a function gives for each job; those in a file are not computed again.

    Parameters
    ----------
    file : Path
        JSON lines, to which each finished job is appended: its name as `picture`, its rows as
        `fruit`. A last line that an interruption cut short is removed.
    jobs : mapping of str to job
        Jobs by name.
    function : callable
        Function that can be pickled; gives rows of JSON values.
    workers : int
        Number of processes.
    progress : callable, optional
        Called with the number of jobs finished since the last call.

    Raises
    ------
    DataSetError
        If a line is damaged.

    Examples
    --------
    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "rows.jsonl"
    >>> kept_rows(file, {"a": 1}, lambda n: [{"length_m": n}])
    [{'length_m': 1}]
    >>> kept_rows(file, {"a": 1, "b": 2}, lambda n: [{"length_m": 10 * n}])
    [{'length_m': 1}, {'length_m': 20}]
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    text = file.read_text(encoding="utf-8") if file.exists() else ""
    rows: dict[str, list[dict[str, Any]]] = {}
    for number, line in enumerate(text.split("\n")[:-1], 1):
        with wrap_reader_errors(f"{file}, line {number}", DataSetError, "delete the file"):
            content = json.loads(line)
            rows[content["picture"]] = content["fruit"]
    file.write_text(text[: text.rfind("\n") + 1], encoding="utf-8")
    missing = [job for job in jobs.items() if job[0] not in rows]
    if progress is not None and len(missing) < len(jobs):
        progress(len(jobs) - len(missing))
    for name, made in each_done(partial(_named, function), missing, workers):
        rows[name] = made
        with file.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps({"picture": name, "fruit": made}) + "\n")
        if progress is not None:
            progress(1)
    return [row for name in jobs for row in rows[name]]


def _named(
    function: Callable[[Job], list[dict[str, Any]]], job: tuple[str, Job]
) -> tuple[str, list[dict[str, Any]]]:
    return job[0], function(job[1])
