"""Run a function for many jobs in several processes, and go on after an interruption."""

from __future__ import annotations

import json
import multiprocessing
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, TypeVar

import cv2

from cucumbervision.errors import DataSetError, wrap_reader_errors
from cucumbervision.run.batch import end_with_parent
from cucumbervision_lab.arrays import Progress

Job = TypeVar("Job")
Rows = list[dict[str, Any]]


def kept_rows(
    file: Path,
    jobs: Mapping[str, Job],
    function: Callable[[Job], Rows],
    workers: int = 1,
    progress: Progress | None = None,
) -> Rows:
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
        Number of processes, each with one OpenCV thread; with one, all runs in this process.
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
    rows: dict[str, Rows] = {}
    for number, line in enumerate(text.split("\n")[:-1], 1):
        with wrap_reader_errors(f"{file}, line {number}", DataSetError, "delete the file"):
            content = json.loads(line)
            rows[content["picture"]] = content["fruit"]
    file.write_text(text[: text.rfind("\n") + 1], encoding="utf-8")
    missing = {name: job for name, job in jobs.items() if name not in rows}
    if progress is not None and len(missing) < len(jobs):
        progress(len(jobs) - len(missing))
    for name, made in _each_done(function, missing, workers):
        rows[name] = made
        with file.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps({"picture": name, "fruit": made}) + "\n")
        if progress is not None:
            progress(1)
    return [row for name in jobs for row in rows[name]]


def _each_done(
    function: Callable[[Job], Rows], jobs: Mapping[str, Job], workers: int
) -> Iterator[tuple[str, Rows]]:
    """Yield the name and the rows of each job as it completes; the first error ends them all."""
    if workers <= 1 or len(jobs) <= 1:
        yield from ((name, function(job)) for name, job in jobs.items())
        return
    # Forking a process with OpenCV or torch threads may deadlock.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, _begin_worker) as pool:
        calls = {pool.submit(function, job): name for name, job in jobs.items()}
        try:
            for call in as_completed(calls):
                yield calls[call], call.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _begin_worker() -> None:
    cv2.setNumThreads(1)
    threading.Thread(target=end_with_parent, daemon=True).start()
