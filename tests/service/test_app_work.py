"""One request at a time, and none for clients that have left."""

from __future__ import annotations

import io
import threading
from dataclasses import replace

import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.errors import UploadError
from cucumbervision.run.measurer import Measurer
from cucumbervision.service.app import ServiceSettings, Work
from cucumbervision.service.client import packed


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


def test_what_was_sent_is_answered_under_its_own_name(measurer: Measurer, bench: Capture) -> None:
    name, data = packed(bench)
    sent = {name: data, "../x\0.png": b"MZ", "n.txt": b"our walk"}
    files = [(title, io.BytesIO(content)) for title, content in sent.items()]
    reply = Work(measurer, ServiceSettings()).measure(files)
    (capture,) = reply.captures
    assert (capture.name, capture.simulated, len(capture.fruit)) == ("simulated-bench", True, 3)
    assert (capture.width, capture.height) == bench.intrinsics.size
    assert [fault.name for fault in reply.failures] == ["x.png"]
    assert reply.ignored == ["n.txt"]
    assert "/tmp" not in reply.model_dump_json()


def test_more_pictures_than_are_taken_at_once_are_refused(measurer: Measurer) -> None:
    settings = ServiceSettings(limits=replace(ServiceSettings().limits, files=2))
    files = [(f"{k}.png", io.BytesIO(b"x")) for k in range(3)]
    with pytest.raises(UploadError, match="3 files were sent, at most 2 are taken at once"):
        Work(measurer, settings).detect(files)
