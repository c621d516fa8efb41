"""The newest of what keeps coming: a thread takes every frame, who is slow gets the last one."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Generic, TypeVar

from cucumbervision.capture.frames import Capture

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Arrival(Generic[T]):
    """Something that came, and when.

    Parameters
    ----------
    item : object
        What came.
    received_s : float
        When, by `time.monotonic`.
    dropped : int
        How many older ones were dropped since the one that was taken before it.
    """

    item: T
    received_s: float
    dropped: int = 0


def in_order(items: Iterable[T]) -> Iterator[Arrival[T]]:
    """Yield everything, one after the other: for what waits.

    Examples
    --------
    >>> [(one.item, one.dropped) for one in in_order("ab")]
    [('a', 0), ('b', 0)]
    """
    for item in items:
        yield Arrival(item, time.monotonic())


def newest_first(items: Iterable[T]) -> Iterator[Arrival[T]]:
    """Yield the newest of what comes; what came before it unseen is dropped and counted.

    A thread takes every item as it comes. It ends with the items, or with the next item after the
    iterator was closed. What the items raise is raised here, after the last that came.

    Parameters
    ----------
    items : iterable
        What comes by itself: a camera's frames.

    Examples
    --------
    >>> import threading
    >>> seen = threading.Event()
    >>> def frames():
    ...     yield 1
    ...     seen.wait()
    ...     yield from (2, 3, 4)
    >>> stream = newest_first(frames())
    >>> next(stream).item
    1
    >>> seen.set()
    >>> rest = [(one.item, one.dropped) for one in stream]
    >>> rest[-1][0], sum(dropped for _, dropped in rest) + len(rest)
    (4, 3)
    """
    inbox = _Inbox[T]()
    threading.Thread(target=inbox.fill, args=(items,), name="frames", daemon=True).start()
    try:
        while (arrival := inbox.take()) is not None:
            yield arrival
    finally:
        inbox.close()


class _Inbox(Generic[T]):
    """Room for the newest item."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._newest: Arrival[T] | None = None
        self._error: BaseException | None = None
        self._ended = self._closed = False

    def fill(self, items: Iterable[T]) -> None:
        try:
            for item in items:
                if self._put(Arrival(item, time.monotonic())):
                    break
        except BaseException as error:
            # Whatever it is belongs to who takes the items: this thread has nobody to tell.
            self._error = error
        finally:
            close = getattr(items, "close", None)
            if close is not None:
                close()  # lets a camera go in the thread that used it
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _put(self, arrival: Arrival[T]) -> bool:
        with self._changed:
            before = self._newest
            missed = 0 if before is None else before.dropped + 1
            self._newest = replace(arrival, dropped=missed)
            self._changed.notify_all()
            return self._closed

    def take(self) -> Arrival[T] | None:
        with self._changed:
            while self._newest is None and not self._ended:
                self._changed.wait()
            arrival, self._newest = self._newest, None
            if arrival is None and self._error is not None:
                raise self._error
            return arrival

    def close(self) -> None:
        with self._changed:
            self._closed = True


def paced(
    captures: Iterable[T],
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[T]:
    """Yield captures no sooner after the first than they were taken: a recording as a camera.

    Parameters
    ----------
    captures : iterable
        What is no `Capture`, or has no time, is not waited for.
    clock, sleep : callable
        Seconds that run on, and how to wait for some.

    Examples
    --------
    >>> list(paced(["no capture"]))
    ['no capture']
    """
    begun: tuple[float, float] | None = None
    for capture in captures:
        taken_s = capture.timestamp_s if isinstance(capture, Capture) else None
        if taken_s is not None:
            begun = begun or (clock(), taken_s)
            wait_s = (taken_s - begun[1]) - (clock() - begun[0])
            # A clock that was set back has no pace to follow.
            if wait_s > 0:
                sleep(min(wait_s, _LONGEST_WAIT_S))
        yield capture


_LONGEST_WAIT_S = 2.0  # between two frames: a recording may have been paused
