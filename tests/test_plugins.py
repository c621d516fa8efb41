"""Parts of other packages are called by one thread at a time; the package's own are not held up."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier, BrokenBarrierError

import pytest

from cucumbervision.plugins import Plugin

OTHER = Plugin("detectors", "theirs", "other:Theirs", "other", "1.0")
OWN = Plugin("methods", "M1", "cucumbervision.methods.paper_methods:M1")


@pytest.mark.parametrize(("plugin", "together"), [(OWN, True), (OTHER, False)])
def test_another_packages_part_is_called_by_one_thread_at_a_time(
    plugin: Plugin, together: bool
) -> None:
    both = Barrier(2, timeout=20 if together else 0.2)

    def met() -> bool:
        try:
            both.wait()
        except BrokenBarrierError:
            return False
        return True

    with ThreadPoolExecutor(2) as threads:
        answers = [threads.submit(plugin.call, met) for _ in range(2)]
        assert [answer.result(30) for answer in answers] == [together] * 2
