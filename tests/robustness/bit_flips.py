"""Flip single bits in a store's file; what is then read differently must be noticed.

    python -m tests.robustness.bit_flips 3000 [--seed N] [--counts tests/robustness/counts.json]

Each flip is one bit of a page that one table fills. A flip is without effect where every table
still says the same; else the store must refuse to be read, or `check_store` must name a fault. The
exit code is 1 if one is missed.
"""

from __future__ import annotations

import argparse
import sqlite3
import sys
import tempfile
from collections import Counter
from contextlib import closing
from pathlib import Path
from random import Random
from typing import Any

from tests.robustness.counted import add_counts
from tests.robustness.made_stops import made_round, made_stop

from cucumbervision.errors import StoreError
from cucumbervision_greenhouse.store.check import check_store
from cucumbervision_greenhouse.store.engine import prepare
from cucumbervision_greenhouse.store.links import LinkKind, LinkRecord, Position
from cucumbervision_greenhouse.store.records import DetectionRecord, JointRecord, key_of
from cucumbervision_greenhouse.store.repository import Store, open_store
from cucumbervision_greenhouse.store.views import Verdict

OUTCOMES = ("without effect", "refused", "noticed", "missed")


def make_store(file: Path) -> None:
    """Make a store in one file, with lines in every table."""
    with open_store(file, images=file.parent / "pictures") as store:
        days = made_round("Monday"), made_round("Thursday", 3)
        for walk in days:
            store.save_round(walk)
            for number in range(3):
                store.save_stop(made_stop(walk, number, store.images))
        first, later = ([one.key for one in store.detections(walk.key)] for walk in days)
        same = [LinkRecord(LinkKind.SAME, first[k], first[k + 6], 0.5) for k in range(3)]
        places = {
            one.key: Position(one.position_m or 0.0, 0.01) for one in store.stops(days[0].key)
        }
        store.save_merging(days[0].key, same, places)
        growth = [
            LinkRecord(LinkKind.GROWTH, *pair, 0.75) for pair in zip(first, later, strict=True)
        ]
        store.save_growth(days[0].key, days[1].key, growth)
        store.save_joint(days[0].key, [JointRecord(key_of("joint"), first[0], 2)], ())
        store.set_verdict(first[:4], Verdict.ACCEPTED)
        store.set_verdict(first[1:3], Verdict.REJECTED)
        store.pick(first[4:6], at_s=5.0)
        stop = store.stops(days[0].key)[0].key
        store.add_fruit(stop, store.stop(stop).captures[0].name, DetectionRecord(1))
        store.unmerge(first[0])
        store.rename_round(days[0].key, "Monday morning")
    with closing(sqlite3.connect(file)) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")


def lines_in(file: Path) -> dict[str, list[Any]] | None:
    """Return all lines of all tables; None where SQLite cannot read them."""
    try:
        with closing(sqlite3.connect(f"file:{file}?mode=ro", uri=True)) as connection:
            connection.text_factory = bytes
            found = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
            names = sorted(name.decode() for (name,) in found)
            # As text: 1 and 1.0, which are equal, differ there.
            return {
                name: sorted(map(repr, connection.execute(f'SELECT * FROM "{name}"')))
                for name in names
            }
    except (sqlite3.Error, UnicodeError, OverflowError, MemoryError):
        return None


def pages_of(file: Path) -> dict[str, list[int]]:
    """Return which pages of a file each table and index fills, from 0."""
    pages: dict[str, list[int]] = {}
    with closing(sqlite3.connect(file)) as connection:
        tables = dict(connection.execute("SELECT name, tbl_name FROM sqlite_master"))
        for name, page in connection.execute("SELECT name, pageno FROM dbstat"):
            pages.setdefault(tables.get(name, "sqlite_master"), []).append(page - 1)
    return pages


def flip(data: bytes, page: int, size: int, random: Random) -> bytes:
    """Return a file with one bit of a page flipped."""
    broken = bytearray(data)
    broken[page * size + random.randrange(size)] ^= 1 << random.randrange(8)
    return bytes(broken)


def outcome_of(store: Store, file: Path, whole: dict[str, list[Any]]) -> str:
    """Return what comes of a damaged file of an open store: one of `OUTCOMES`."""
    now = lines_in(file)
    try:
        store.engine.dispose()  # a new engine would compile every query anew
        prepare(store.engine)
        for walk in store.rounds():
            for one in store.detections(walk.key):
                store.detection(one.key)
            store.links(walk.key), store.log(walk.key), store.joint(walk.key)
        sound = check_store(store).sound
    except StoreError:
        return "refused"
    finally:
        store.engine.dispose()
        for left in file.parent.glob(f"{file.name}-*"):
            left.unlink()
    if not sound:
        return "noticed"
    return "without effect" if now == whole else "missed"


def try_flips(flips: int, seed: int = 1) -> dict[str, Counter[str]]:
    """Flip bits, as many in each table; return how often each outcome came of them, by table."""
    counts: dict[str, Counter[str]] = {}
    with tempfile.TemporaryDirectory(prefix="flips-") as tmp:
        file = Path(tmp) / "house.db"
        make_store(file)
        data, whole, pages = file.read_bytes(), lines_in(file), pages_of(file)
        assert whole is not None
        size = int.from_bytes(data[16:18], "big")
        random = Random(seed)
        with open_store(file, images=file.parent / "pictures") as store:
            assert outcome_of(store, file, whole) == "without effect"
            for number in range(flips):
                table = sorted(pages)[number % len(pages)]
                file.write_bytes(flip(data, random.choice(pages[table]), size, random))
                counts.setdefault(table, Counter())[outcome_of(store, file, whole)] += 1
    return counts


def main() -> int:
    """Run from the command line, and print a line for each table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("flips", type=int)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--counts", type=Path)
    said = parser.parse_args()
    counts = try_flips(said.flips, said.seed)
    total = sum(counts.values(), Counter[str]())
    for table, found in [*sorted(counts.items()), ("all", total)]:
        words = ", ".join(f"{found[one]:,} {one}" for one in OUTCOMES)
        sys.stdout.write(f"{table:24}{found.total():7,} flips: {words}\n")
    if said.counts is not None:
        add_counts(said.counts, "bit flips", total)
    return int(total["missed"] > 0)


if __name__ == "__main__":
    sys.exit(main())
