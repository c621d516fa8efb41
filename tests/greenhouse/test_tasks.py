from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("streamlit")

from cucumbervision.capture.frames import Stop
from cucumbervision_greenhouse import tasks
from cucumbervision_greenhouse.resources import Job
from cucumbervision_greenhouse.store.records import key_of
from cucumbervision_greenhouse.store.waiting import Waiting
from cucumbervision_greenhouse.tasks import Progress

OWN, OTHER = key_of("own"), key_of("other")


def waits(number: int, round_key: str) -> Waiting:
    return Waiting(key_of(number), round_key, Stop(), float(number), Path(str(number)))


def progress_of(key: str, queue: Sequence[Waiting], *jobs: Job, **measured: str) -> Progress:
    """Return the progress of a round where this waits, was measured and is to be done."""
    waiting = SimpleNamespace(captures=lambda: queue, set_aside=list)
    last = {"measure": Job("Measuring", None, measured=measured)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tasks, "waiting", lambda: waiting)
        patch.setattr(tasks, "worker", lambda: SimpleNamespace(unfinished=lambda: jobs))
        patch.setattr(tasks, "_last", lambda: last)
        return tasks.progress(key)


def test_what_waits_is_counted_by_round_whatever_it_came_in() -> None:
    queue = [waits(1, OWN), waits(2, OTHER), waits(3, OWN), waits(4, OTHER), waits(5, OTHER)]
    measured = {str(k): OWN for k in range(4)} | {str(k): OTHER for k in range(4, 9)}
    found = progress_of(OWN, queue, **measured)
    assert found.words == "Measuring: 4 of 6 captures; 3 captures of other rounds wait"
    assert (found.waiting, found.done, found.total) == (2, 4, 6)


def test_work_on_another_round_is_not_this_one_s() -> None:
    jobs = [
        Job("Measuring", round_key=None),
        Job("Merging", round_key=OTHER),
        Job("Measuring fruit by all their views", OWN, 9, 4),
    ]
    assert progress_of(OWN, [], *jobs).words == "Measuring fruit by all their views: 4 of 9"
    assert progress_of(OWN, [], *jobs[:2]) == Progress()
    assert progress_of(OWN, [waits(1, OWN)], *jobs).words == "Measuring: 0 of 1 capture"
