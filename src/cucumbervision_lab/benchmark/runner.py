"""Run many cases on all cores, resumable at any moment."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from typing import TYPE_CHECKING

from cucumbervision._version import __version__
from cucumbervision.accuracy.records import Masks, append_record, read_records
from cucumbervision.errors import CucumberVisionError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from cucumbervision.accuracy.records import Record
    from cucumbervision.perception.sam import Segmenter
    from cucumbervision_lab.benchmark.measure_case import CaseOptions
    from cucumbervision_lab.benchmark.protocol import Case

__all__ = ["run_cases"]

CHUNK = 4  # cases a worker takes at once: few, so that a killed run loses little

_segmenters: dict[str, Segmenter] = {}


def run_cases(
    cases: Sequence[Case],
    options: CaseOptions,
    records: Path,
    workers: int = 2,
    report: Callable[[int], None] | None = None,
) -> list[Record]:
    """Measure the cases that are not in the file yet, and give all of theirs.

    Parameters
    ----------
    cases : sequence of Case
        What to measure.
    options : CaseOptions
        How.
    records : Path
        JSON lines; each finished case is appended at once. A file that other options or another
        version began is refused.
    workers : int
        Processes.
    report : callable, optional
        Called with the number of cases that were just finished; for progress bars.

    Returns
    -------
    list of Record
        Of these cases, in the file's order.

    Raises
    ------
    CucumberVisionError
        If the file belongs to another run.
    """
    done = _resume(records, options)
    missing = [c for c in cases if not _measured(c, options, done)]
    if report is not None and len(missing) < len(cases):
        report(len(cases) - len(missing))
    chunks = [missing[k : k + CHUNK] for k in range(0, len(missing), CHUNK)]
    if workers == 1:
        for chunk in chunks:
            _keep(_work(chunk, options), chunk, records, report)
    elif chunks:
        # Threads of a fork may be caught holding a lock: every worker starts afresh.
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(workers, context) as pool:
            jobs = {pool.submit(_work, chunk, options): chunk for chunk in chunks}
            try:
                for job in as_completed(jobs):
                    _keep(job.result(), jobs[job], records, report)
            except BaseException:
                # What is finished is on disk; what waits would only delay the news.
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    names = {case.name for case in cases}
    return [r for r in read_records([records]) if r.case in names] if records.exists() else []


def _keep(
    found: Sequence[Record],
    chunk: Sequence[Case],
    records: Path,
    report: Callable[[int], None] | None,
) -> None:
    for record in found:
        append_record(records, record)
    if report is not None:
        report(len(chunk))


def _work(chunk: Sequence[Case], options: CaseOptions) -> list[Record]:
    import cv2

    from cucumbervision_lab.benchmark.measure_case import measure_case

    cv2.setNumThreads(1)  # one core a worker
    segmenter = _segmenter(options.prompt) if Masks.PERCEIVED in options.masks else None
    return [r for case in chunk for r in measure_case(case, options, segmenter)]


def _segmenter(prompt: str) -> Segmenter:
    if prompt not in _segmenters:
        from cucumbervision.perception.sam import Segmenter

        _segmenters[prompt] = Segmenter("mobile-sam", prompt=prompt, full_precision=True)
    return _segmenters[prompt]


def _measured(case: Case, options: CaseOptions, done: set[tuple[str, str, str]]) -> bool:
    return all((str(case.suite), case.name, str(kind)) in done for kind in options.masks)


def _resume(records: Path, options: CaseOptions) -> set[tuple[str, str, str]]:
    """Check that the file was begun by this run, or begin it."""
    stamp = {"version": __version__, "options": asdict(options)}
    mark = hashlib.sha256(json.dumps(stamp, sort_keys=True).encode()).hexdigest()
    head = records.with_suffix(".run")
    records.parent.mkdir(parents=True, exist_ok=True)
    if not records.exists():
        head.write_text(mark + "\n")
        return set()
    if not head.exists() or head.read_text().strip() != mark:
        raise CucumberVisionError(
            "was begun with other options or by another version",
            source=records,
            remedy="delete it, or choose another --out",
        )
    return {record.key for record in read_records([records])}
