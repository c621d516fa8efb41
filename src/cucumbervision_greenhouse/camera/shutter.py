"""The shutter: a press grabs a burst, which one thread fuses and saves; it is measured later."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

from cucumbervision.capture.frames import Stop
from cucumbervision_greenhouse.camera.cameras import Feed, FolderFeed, PictureGoneError
from cucumbervision_greenhouse.resources import fault_of
from cucumbervision_greenhouse.rounds.walking import last_step, round_for_capture, unless_taken
from cucumbervision_greenhouse.store.records import key_of
from cucumbervision_greenhouse.store.repository import Store
from cucumbervision_greenhouse.store.waiting import Waiting, WaitingCaptures

_REMEMBERED = 2000  # presses that are remembered, since a browser may send them again


def is_lost(queued: Future[Waiting]) -> bool:
    """Return whether the image of a press is no longer held, so that it would be refused again."""
    return queued.done() and isinstance(queued.exception(), PictureGoneError)


class Shutter:
    """Grabs and saves a burst at each press.

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
        self._lock = threading.Lock()
        self._pressed: OrderedDict[tuple[str, str], Future[Waiting]] = OrderedDict()

    def press(
        self,
        feed: Feed | FolderFeed,
        burst: int,
        round_key: str,
        stop: Stop,
        number: str,
        at_s: float,
    ) -> Future[Waiting] | None:
        """Grab a burst for a press; return its capture to come, or None if it was saved before.

        The same press sent again gets the same outcome and makes one stop. If the feed no longer
        holds its picture, the outcome is that error; after another fault, such as a full disk, it
        is tried again. Returns at once: another thread waits for the burst's last frames and for
        the disk.

        Parameters
        ----------
        feed : Feed or FolderFeed
            The camera, or what replaces it.
        burst : int
            Frames that are fused.
        round_key : str
            The open round.
        stop : Stop
            Where the button was pressed.
        number : str
            Number given by the browser: a press that is sent twice counts once.
        at_s : float
            When, seconds since 1970, by this machine's clock.
        """
        name, at_s = (round_key, number), min(at_s, time.time())
        key = key_of("press", *name)
        with self._lock:
            before = self._pressed.get(name)
            if before is not None and (is_lost(before) or not fault_of(before)):
                return before
            # Before this program was started.
            if self._waiting.holds(key) or self._store.stop_is_deleted(key) is not None:
                return None
            queued = self._pool.submit(self._keep, feed, burst, round_key, stop, key, at_s)
            self._pressed[name] = queued
            while len(self._pressed) > _REMEMBERED:
                self._pressed.popitem(last=False)
            return queued

    def close(self) -> None:
        """Save all presses, then end."""
        self._pool.shutdown(wait=True)

    def _keep(
        self, feed: Feed | FolderFeed, burst: int, round_key: str, stop: Stop, key: str, at_s: float
    ) -> Waiting:
        capture = feed.grab(burst, at_s)
        home = round_for_capture(self._store, round_key, simulated=capture.simulated)
        waiting = [queued.stop for queued in self._waiting.captures() if queued.round_key == home]
        taken: list[Stop] = [*self._store.stops(home), *waiting]
        stop = replace(unless_taken(stop, taken), step=last_step(taken) + 1)
        capture = replace(capture, stop=stop, timestamp_s=at_s)
        queued = self._waiting.put(capture, key, home, at_s)
        self._on_queued()
        return queued
