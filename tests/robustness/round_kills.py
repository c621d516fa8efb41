"""A round that is killed with signal 9 again and again while it is added."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from contextlib import suppress
from functools import wraps
from random import Random
from typing import TYPE_CHECKING, Any

from tests.robustness.trial import Outcome, captures, last_line, stops_in

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from multiprocessing.connection import Connection
    from pathlib import Path

_STOPS = 8
_BEGUN, _ENDED = b"<", b">"
# All that `round add` imports: each kill needs a new process, and none needs to import it again.
_LOADED = (
    "cucumbervision.cli.app",
    "cucumbervision_greenhouse.cli.round",
    "cucumbervision.capture.readers",
    "cucumbervision.perception.networks",
    "cucumbervision_greenhouse.rounds.adding",
    "cucumbervision_greenhouse.rounds.merge_and_link",
    "cucumbervision_greenhouse.store.repository",
    "tests.robustness.round_kills",
)


def kill_rounds(
    folder: Path, kills: int, seed: int = 1, tick: Callable[[int], None] | None = None
) -> Outcome:
    """Kill `round add` with signal 9 at random moments and begin it again, until it is through.

    Parameters
    ----------
    folder : Path
        Empty.
    kills : int
        How many; a new round is begun whenever one is through before.
    seed : int
        Of the moments.
    tick : callable, optional
        Called with how many more kills there were.
    """
    source, random = captures(folder / "in", _STOPS), Random(seed)
    killed, inside, rounds = 0, 0, 0
    lost = ""
    while killed < kills and not lost:
        rounds += 1
        store = folder / f"house{rounds}.db"
        _Program(folder, "round", "new", "walk", "--store", store).end()
        words = ("round", "add", source, "--store", store, "--instances", "dataset")
        there: list[str] = []
        while len(there) < _STOPS and killed < kills and not lost:
            adding = _Program(folder, *words)
            adding.kill(random)
            there, lost = _compared(there, stops_in(store), adding)
            killed += adding.was_killed
            inside += adding.was_killed and adding.writing
            if tick is not None:
                tick(int(adding.was_killed))
        lost = lost or _at_the_end(store, _Program(folder, *words).end())
    kept = lost or f"{rounds} rounds of {_STOPS} stops, each stop whole and once"
    fault = f"`round add` killed {killed} times (kill -9), {inside} of them within a write"
    return Outcome(fault, "nothing; the same command again goes on", kept, bool(lost))


def _compared(before: list[str], now: list[str], adding: _Program) -> tuple[list[str], str]:
    """Return the stops that are there, and what is wrong with them."""
    if set(before) - set(now) or len(set(now)) != len(now):
        return now, f"after {before} there was {now}"
    if not adding.was_killed and len(now) < _STOPS:  # begun again it would end like this again
        return now, f"it ended by itself with {len(now)} of {_STOPS} stops: {adding.said}"
    return now, ""


def _at_the_end(store: Path, last: _Program) -> str:
    """Return what is wrong with a round that was added to its end, pictures included."""
    from cucumbervision_greenhouse.store.check import check_store
    from cucumbervision_greenhouse.store.repository import open_store

    if stops_in(store) != [f"c{k}" for k in range(_STOPS)]:
        return f"at the end there was {stops_in(store)}: {last.said}"
    with open_store(store, create=False) as opened:
        report = check_store(opened, grace_s=0, remove=True)  # pictures that no stop names
        return "" if check_store(opened, grace_s=0).sound else f"pictures: {report}"


class _Program:
    """The program in a process of its own, which says when it begins and ends to write."""

    def __init__(self, folder: Path, *words: object) -> None:
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(list(_LOADED))
        self._heard, said = context.Pipe(duplex=False)
        self._file = folder / "said.txt"
        given = [str(word) for word in words]
        self._process = context.Process(target=_run, args=(given, said, str(self._file)))
        self._process.start()
        said.close()
        self._at: list[bytes] = []

    @property
    def was_killed(self) -> bool:
        """Whether the kill ended it, and not itself."""
        return self._process.exitcode == -signal.SIGKILL

    @property
    def writing(self) -> bool:
        """Whether it was within a write at its end."""
        return self._at.count(_BEGUN) > self._at.count(_ENDED)

    @property
    def said(self) -> str:
        """The last line that it printed."""
        return last_line(self._file.read_text(encoding="utf-8", errors="replace"))

    def end(self) -> _Program:
        """Wait until it has ended by itself."""
        self._hear(None)
        self._process.join()
        return self

    def kill(self, random: Random) -> None:
        """Kill it within some writes after its first one."""
        self._hear(random.randint(1, 9))
        # Most writes take some milliseconds: most kills fall into one.
        time.sleep(random.choice((0.0, random.uniform(0, 0.02), random.uniform(0, 0.5))))
        self._process.kill()
        self._process.join()
        self._hear(None)

    def _hear(self, writes: int | None) -> None:
        """Listen until so many writes were begun, or until it has ended."""
        with suppress(EOFError):
            while writes is None or self._at.count(_BEGUN) < writes:
                self._at.append(self._heard.recv_bytes())


def _run(words: Sequence[str], said: Connection, printed: str) -> None:
    """Be the program."""
    from cucumbervision.cli.app import main
    from cucumbervision_greenhouse.store.images import ImageStore
    from cucumbervision_greenhouse.store.repository import Store

    file = os.open(printed, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for number in (1, 2):
        os.dup2(file, number)
    for owner, name in ((ImageStore, "put_color"), (ImageStore, "put_depth"), (Store, "save_stop")):
        setattr(owner, name, _saying(getattr(owner, name), said))
    sys.argv = ["cucumbervision", *words]
    main()


def _saying(write: Callable[..., Any], said: Connection) -> Callable[..., Any]:
    @wraps(write)
    def wrapped(*given: Any, **named: Any) -> Any:
        said.send_bytes(_BEGUN)
        written = write(*given, **named)
        said.send_bytes(_ENDED)
        return written

    return wrapped
