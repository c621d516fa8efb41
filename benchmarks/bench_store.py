"""What a round of 500 stops costs: saving, lists, one fruit, the file.

    python benchmarks/bench_store.py [--url house.db] [--stops 500] [--rounds 3] [--images]

Every stop has one capture with six fruit, six methods each; neighbouring stops share fruit, of
which links are made as the merging makes them. Medians and the slowest of several calls, and the
processor's time, which other programs on the machine do not lengthen.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from statistics import median

from made_stops import made_round, made_stop

from cucumbervision.store.repository import Store, open_store
from cucumbervision.store.views import DetectionFilter, LinkKind, LinkRecord, Position, Verdict

REPEATS = 15


def fill(store: Store, stops: int, rounds: int, *, images: bool) -> list[str]:
    """Save rounds stop by stop; give their keys."""
    keys = []
    for day in range(rounds):
        walk = made_round("bench", day)
        store.save_round(walk)
        saving, pictures, cpu = [], [], 0.0
        for number in range(stops):
            began = time.perf_counter()
            stop = made_stop(walk, number, store.images if images else None)
            made = time.perf_counter()
            made_cpu = time.process_time()
            store.save_stop(stop)
            cpu += time.process_time() - made_cpu
            saving.append(time.perf_counter() - made)
            pictures.append(made - began)
        print(f"round {day}: stop {_ms(saving)}, processor {1e3 * cpu / stops:.1f} ms")
        if images:
            print(f"    pictures {_ms(pictures)}")
        keys.append(walk.key)
    return keys


def link_up(store: Store, key: str) -> tuple[list[LinkRecord], dict[str, Position]]:
    """Link two fruit of each stop to the next stop's, and fit every position."""
    by_stop: dict[str, list[str]] = {}
    for one in store.detections(key):
        by_stop.setdefault(one.stop_key, []).append(one.key)
    groups = list(by_stop.values())
    links = [
        LinkRecord(LinkKind.SAME, a[-1 - k], b[k], 0.9)
        for a, b in pairwise(groups)
        for k in range(2)
    ]
    return links, {stop: Position(0.4 * n, 0.01) for n, stop in enumerate(by_stop)}


def _ms(seconds: list[float]) -> str:
    return f"median {1e3 * median(seconds):.1f} ms, slowest {1e3 * max(seconds):.1f} ms"


def timed(name: str, call: Callable[[], object]) -> None:
    """Call it several times and print how long it took."""
    seconds, cpu = [], []
    for _ in range(REPEATS):
        began, began_cpu = time.perf_counter(), time.process_time()
        call()
        seconds.append(time.perf_counter() - began)
        cpu.append(time.process_time() - began_cpu)
    print(f"{name:<34} {_ms(seconds)}, processor {1e3 * median(cpu):.1f} ms")


def measure(store: Store, keys: list[str]) -> None:
    """Time what pages ask."""
    key = keys[-1]
    links, positions = link_up(store, key)
    began = time.perf_counter()
    store.save_merging(key, links, positions)
    print(f"save_merging, {len(links)} links: {1e3 * (time.perf_counter() - began):.0f} ms")
    all_keys = [one.key for one in store.detections(key)]
    for at in range(0, len(all_keys), 7):
        store.set_verdict(all_keys[at : at + 1], Verdict.ACCEPTED, by="bench")
    store.pick(all_keys[::5], by="bench")
    timed("rounds()", store.rounds)
    timed("stops(round)", lambda: store.stops(key))
    timed(f"detections(round), {len(all_keys)} detections", lambda: store.detections(key))
    timed("detections(round, best)", lambda: store.detections(key, DetectionFilter(best=True)))
    timed("detection(key)", lambda: store.detection(all_keys[1234 % len(all_keys)]))
    timed("stop(key)", lambda: store.stop(store.stops(key)[7].key))
    timed("links(round)", lambda: store.links(key))
    timed("log(round)", lambda: store.log(key))
    timed("measurements(round)", lambda: store.measurements(key))
    timed("pick one", lambda: store.pick(all_keys[3:4], by="bench"))
    timed("undo", lambda: store.undo(key, by="bench"))
    timed("merge", lambda: store.merge(all_keys[0], all_keys[9], by="bench"))


def main() -> None:
    """Fill and measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--url", default="", help="an empty database; a new SQLite file by default")
    parser.add_argument("--stops", type=int, default=500)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--images", action="store_true", help="small pictures of noise too")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "house.db"
        with open_store(arguments.url or file, images=Path(folder) / "images") as store:
            keys = fill(store, arguments.stops, arguments.rounds, images=arguments.images)
            measure(store, keys)
        if file.exists():
            print(f"file: {file.stat().st_size / 2**20:.1f} MiB for {len(keys)} rounds")


if __name__ == "__main__":
    main()
