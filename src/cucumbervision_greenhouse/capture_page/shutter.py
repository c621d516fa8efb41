"""The button: a burst is grabbed at the press, kept on disk, and measured when there is time.

Three threads, so that nothing holds a press up: one keeps the frames of bursts as they are, the
worker of all pages measures what waits, in order, and one codes what waits for long. What waits is
on disk, so that a kill loses nothing of it.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from cucumbervision.errors import CameraError, CucumberVisionError
from cucumbervision_greenhouse.backend.camera_feed import PictureGoneError
from cucumbervision_greenhouse.backend.jobs import fault_of, give_way
from cucumbervision_greenhouse.rounds.demonstration import round_for_capture
from cucumbervision_greenhouse.rounds.walking import last_step, unless_taken
from cucumbervision_greenhouse.store.records import key_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from cucumbervision.capture.frames import Stop
    from cucumbervision_greenhouse.backend.replay_feed import Burst, Feed
    from cucumbervision_greenhouse.store.repository import Store
    from cucumbervision_greenhouse.store.views import StopSummary
    from cucumbervision_greenhouse.store.waiting import Waiting, WaitingCaptures

_REMEMBERED = 2000  # presses that a browser may send again
_SOON = 4  # captures that are measured next are not coded before


@dataclass(frozen=True)
class Press:
    """A press of the button.

    Parameters
    ----------
    number : str
        Its own, made by the browser: a press that is sent twice counts once.
    at_s : float
        When, seconds since 1970, by this machine's clock.
    """

    number: str
    at_s: float


@dataclass(frozen=True, eq=False)
class Pressed:
    """The outcome of a press.

    Parameters
    ----------
    stop : Stop
        Where it was pressed.
    pressed_s : float
        When.
    queued : Future of Waiting
        The capture, once it is on disk.
    """

    stop: Stop
    pressed_s: float
    queued: Future[Waiting]

    @property
    def error(self) -> str:
        """Why there is no capture; empty where there is one, or will be."""
        return fault_of(self.queued)

    @property
    def is_lost(self) -> bool:
        """Whether its picture is not there any more: sent again, it would be refused again."""
        return self.queued.done() and isinstance(self.queued.exception(), PictureGoneError)

    @property
    def moved(self) -> Stop | None:
        """Where it was put because another stop has the place where it was pressed, if so."""
        if not self.queued.done() or self.queued.exception() is not None:
            return None
        stop = self.queued.result().stop
        return None if stop.position_m == self.stop.position_m else stop


class Shutter:
    """Takes a burst at each press and keeps it.

    Parameters
    ----------
    store : Store
        Where the rounds are.
    waiting : WaitingCaptures
        Where captures are kept until they are measured.
    on_queued : callable
        Called after each capture that was written to the queue.
    """

    def __init__(
        self, store: Store, waiting: WaitingCaptures, on_queued: Callable[[], object]
    ) -> None:
        self._store, self._waiting, self._on_queued = store, waiting, on_queued
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="shutter")
        self._coder = ThreadPoolExecutor(1, thread_name_prefix="coding", initializer=give_way)
        self._lock = threading.Lock()
        self._pressed: OrderedDict[tuple[str, str], Pressed] = OrderedDict()

    def press(
        self, feed: Feed, burst: int, round_key: str, stop: Stop, press: Press
    ) -> Pressed | None:
        """Grab a burst for a press; return its outcome, None for one that was kept before.

        The same press sent again gets the same outcome: one stop. Where the feed no longer holds
        the picture of its moment, the outcome is that error; where another fault kept it from being
        saved, such as a full disk, it is tried anew. Returns at once: the burst's last frames and
        the disk are waited for elsewhere.
        """
        name = (round_key, press.number)
        at_s = min(press.at_s, time.time())
        with self._lock:
            before = self._pressed.get(name)
            if before is not None and (before.is_lost or not before.error):
                return before
            if self._was_kept(key_of("press", *name)):  # before this program was started
                return None
            queued: Future[Waiting] = Future()
            try:
                grabbed = feed.grab(burst, at_s)
            except CameraError as error:
                queued.set_exception(error)
            else:
                queued = self._pool.submit(
                    self._keep, grabbed, round_key, stop, Press(press.number, at_s)
                )
            self._pressed[name] = Pressed(stop, at_s, queued)
            while len(self._pressed) > _REMEMBERED:
                self._pressed.popitem(last=False)
            return self._pressed[name]

    def _was_kept(self, key: str) -> bool:
        return self._waiting.holds(key) or self._store.stop_is_deleted(key) is not None

    def pressed(self, round_key: str) -> list[Pressed]:
        """Return the presses of a round that are remembered, the oldest first."""
        with self._lock:
            return [press for (key, _), press in self._pressed.items() if key == round_key]

    def close(self) -> None:
        """Keep what was pressed, then end."""
        self._pool.shutdown(wait=True)
        self._coder.shutdown(wait=True, cancel_futures=True)

    def _keep(self, grabbed: Burst, round_key: str, stop: Stop, press: Press) -> Waiting:
        home = round_for_capture(self._store, round_key, simulated=grabbed.simulated)
        waiting = [
            capture.stop for capture in self._waiting.captures() if capture.round_key == home
        ]
        taken: list[Stop | StopSummary] = [*self._store.stops(home), *waiting]
        stop = replace(unless_taken(stop, taken), step=last_step(taken) + 1)
        key = key_of("press", round_key, press.number)
        queued_capture = grabbed.keep(self._waiting, key, home, stop)
        self._on_queued()
        self._coder.submit(self._code, queued_capture)
        return queued_capture

    def _code(self, queued_capture: Waiting) -> None:
        """Code a capture that is not measured at once: as it is, it takes five times the room."""
        waiting = {capture.key: capture for capture in self._waiting.captures()[_SOON:]}
        if queued_capture.key in waiting:
            with suppress(CucumberVisionError):  # it stays as it is
                self._waiting.code(waiting[queued_capture.key])
