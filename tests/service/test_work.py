"""One request at a time, and none for clients that have left."""

from __future__ import annotations

import io
import threading
from dataclasses import replace

import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.pipeline.measurer import Measurer
from cucumbervision.service.client import packed
from cucumbervision.service.server import ServiceSettings
from cucumbervision.service.work import LeftError, Work


def test_nothing_is_begun_for_a_client_that_has_left(measurer: Measurer, bench: Capture) -> None:
    work, asked = Work(measurer, ServiceSettings()), [False, True]
    with pytest.raises(LeftError), work.turn(lambda: True):
        raise AssertionError
    two = [(f"{n}.zip", io.BytesIO(packed(replace(bench, name=n))[1])) for n in ("a", "b", "c")]
    # It leaves while the first capture is read.
    reply = work.measure(two, lambda: asked.pop(0) if asked else True)
    assert reply.captures == []


def test_requests_take_turns(measurer: Measurer, bench: Capture) -> None:
    work, inside, most = Work(measurer, ServiceSettings(waiting=8)), [0], [0]

    def one() -> None:
        with work.turn():
            inside[0] += 1
            most[0] = max(most[0], inside[0])
            inside[0] -= 1

    threads = [threading.Thread(target=one) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    assert most == [1]
