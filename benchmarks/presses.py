"""How near to its press each burst is taken, and what a kill leaves of what was pressed.

    OMP_NUM_THREADS=1 python benchmarks/presses.py RECORDING --seconds 30 --kills 100

A process that keeps captures without a pause is killed with -9 at random moments: each capture that
it had acknowledged must be there and whole. Then a RealSense recording plays at a camera's speed:
one press tells how long its result takes, then the button is pressed once a second while what was
taken before is measured beside it.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.realsense import CameraConfig
from cucumbervision.dashboard.camera_feed import PREVIEW_FPS, CameraBurst, CameraFeed
from cucumbervision.dashboard.jobs import Worker
from cucumbervision.dashboard.measuring import SharedMeasurer, measure_waiting
from cucumbervision.dashboard.shutter import Press, Shutter
from cucumbervision.perception.registry import load_registry
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision.store.records import RoundRecord, key_of
from cucumbervision.store.repository import Store, open_store
from cucumbervision.store.waiting import WaitingCaptures

WITHIN_S = 0.15
LONGEST_S = 0.25  # until a kill


class Watched(CameraFeed):
    """A camera whose bursts are kept to be looked at."""

    def __init__(self, recording: Path) -> None:
        config = CameraConfig(playback=recording, warm_up=0, fps=PREVIEW_FPS)
        super().__init__(config, paced=True)
        self.bursts: list[CameraBurst] = []

    def grab(self, burst: int, pressed_s: float) -> CameraBurst:
        """Remember a burst beside giving it."""
        grabbed = super().grab(burst, pressed_s)
        self.bursts.append(grabbed)
        return grabbed


def press_once_a_second(recording: Path, seconds: int, folder: Path) -> None:
    """Press, measure beside it, and print how far bursts were from their presses."""
    feed, waiting = Watched(recording), WaitingCaptures(folder / "house.waiting")
    measurer, options = SharedMeasurer(load_registry()), MeasureOptions()
    with open_store(folder / "house.db") as store, Worker() as worker:
        # The networks are loaded where they are used, as the dashboard does when it starts.
        worker.submit("loading", lambda _: measurer.warm_up(options)).wait()
        walk = RoundRecord(name="walk")
        store.save_round(walk)

        def wake() -> None:
            if not worker.unfinished():
                parts = waiting, measurer, store, options, lambda _: ""
                worker.submit("measuring", lambda job: measure_waiting(*parts, job))

        shutter, stopping = Shutter(store, waiting, wake), threading.Event()
        watcher = threading.Thread(target=_watch, args=(feed, stopping))
        watcher.start()
        while feed.preview().state != "playing":
            time.sleep(0.05)
        time.sleep(1.0)
        first_result(feed, shutter, store, walk.key, options)
        feed.bursts.clear()
        for number in range(seconds):
            press = Press(str(number), time.time())
            shutter.press(feed, options.reading.burst, walk.key, Stop("1", "left", 0.4), press)
            time.sleep(1.0)
        shutter.close()
        measured, left = len(store.stops(walk.key)), len(waiting.captures())
        stopping.set()
        watcher.join()
        feed.close()
    nearest = np.array([min(abs(f.at_s - b.pressed_s) for f in b.frames) for b in feed.bursts])
    last = np.array([b.farthest_s for b in feed.bursts])
    print(
        f"{seconds} presses, 1 s apart, after the first: {measured - 1 + left} kept, "
        f"{measured - 1} of them measured by then"
    )
    print(
        f"nearest frame {1000 * np.median(nearest):.0f} ms from its press (median), "
        f"{1000 * nearest.max():.0f} ms at most; farthest frame {1000 * np.median(last):.0f} ms "
        f"(median), {1000 * last.max():.0f} ms at most"
    )
    near = int((last <= WITHIN_S).sum())
    frames = np.array([len(b.frames) for b in feed.bursts])
    print(
        f"bursts wholly within {WITHIN_S:g} s of their press: {near} of {seconds}, "
        f"{frames.min()} to {frames.max()} frames each"
    )


def first_result(
    feed: Watched, shutter: Shutter, store: Store, round_key: str, options: MeasureOptions
) -> None:
    """Press once, and print how long it takes until the result is in the store."""
    pressed_s = time.time()
    stop = Stop("1", "left", 0.0)
    shutter.press(feed, options.reading.burst, round_key, stop, Press("first", pressed_s))
    while not store.stops(round_key):
        time.sleep(0.02)
    fruit = len(store.detections(round_key))
    print(f"first result {time.time() - pressed_s:.2f} s after its press, {fruit} fruit")


def _watch(feed: CameraFeed, stopping: threading.Event) -> None:
    while not stopping.wait(0.2):
        feed.preview()


def keep_for_ever(folder: Path, said: int) -> None:
    """Keep captures without a pause, and say the key of each once it is safe."""
    queue = WaitingCaptures(folder)
    depth = np.random.default_rng(1).uniform(0.4, 0.8, (480, 848)).astype(np.float32).round(3)
    color = np.zeros((480, 848, 3), np.uint8)
    camera = Intrinsics(848, 480, 616.0, 616.0, 423.5, 239.5)
    for number in range(10**6):
        one = Capture(color, depth, camera, f"c{number}")
        kept = queue.put(one, key_of("stop", number), key_of("round"), 1e9 + number)
        os.write(said, f"{kept.key}\n".encode())


def told_by_killed(folder: Path, delay_s: float) -> list[str]:
    """Kill a process so long after its first capture was safe; return what it said was safe."""
    heard, said = os.pipe()
    pid = os.fork()  # what is loaded is there at once
    if pid == 0:
        try:
            keep_for_ever(folder, said)
        finally:
            os._exit(1)
    os.close(said)
    text = os.read(heard, 37)
    time.sleep(delay_s)
    os.kill(pid, signal.SIGKILL)
    while piece := os.read(heard, 65536):
        text += piece
    os.close(heard)
    os.waitpid(pid, 0)
    return text.decode().split()


def kill(times: int, folder: Path) -> None:
    """Kill a process that keeps captures, and count what is lost of what it acknowledged."""
    lost = acknowledged = broken = 0
    draw = random.Random(7)
    for number in range(times):
        own = folder / f"{number}"
        told = told_by_killed(own, draw.uniform(0.0, LONGEST_S))
        there = {one.key: one for one in WaitingCaptures(own).captures()}
        acknowledged += len(told)
        lost += sum(key not in there for key in told)
        broken += sum(one.load().fill < 1.0 for one in there.values())
        shutil.rmtree(own)
    print(f"{times} kills -9: {acknowledged} captures acknowledged, {lost} lost, {broken} damaged")


def main() -> None:
    """Kill, then press."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path, nargs="?", help=".bag or .db3; none: only kills")
    parser.add_argument("--seconds", type=int, default=30)
    parser.add_argument("--kills", type=int, default=100)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        kill(chosen.kills, Path(folder) / "kills")  # before any thread runs: it forks
        if chosen.recording is not None:
            press_once_a_second(chosen.recording, chosen.seconds, Path(folder))


if __name__ == "__main__":
    main()
