"""Parts of other packages are called by one thread at a time; the package's own are not held up."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier, BrokenBarrierError, Event

import pytest

from cucumbervision.plugins import Plugin

OTHER = Plugin("detectors", "theirs", "other:Theirs", "other", "1.0")
OWN = Plugin("methods", "M1", "cucumbervision.methods.paper_methods:M1")


def test_another_packages_part_is_called_by_one_thread_at_a_time() -> None:
    is_inside, may_leave, order = Event(), Event(), list[str]()

    def first() -> None:
        is_inside.set()
        assert may_leave.wait(20)
        order.append("first")

    with ThreadPoolExecutor(2) as threads:
        one = threads.submit(OTHER.call, first)
        assert is_inside.wait(20)
        # A part of any other kind waits, too; a call from inside a call does not.
        two = threads.submit(OTHER.call, OTHER.call, order.append, "second")
        assert not two.done()
        may_leave.set()
        one.result(20)
        two.result(20)
    assert order == ["first", "second"]


@pytest.mark.parametrize(("plugin", "together"), [(OWN, True), (OTHER, False)])
def test_only_the_packages_own_run_side_by_side(plugin: Plugin, together: bool) -> None:
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
