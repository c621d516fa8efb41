"""A week's work with kills in between, compared with a week that nothing disturbed.

    python -m tests.robustness.week [--captures 2000] [--days 7] [--seed 1]

On each day captures are added to a house, measured into one folder by `measure`, added to the
day's round by `round add`, and exported. In one of two weeks every command is killed with signal 9
at random moments of the time that it took in the other, a few times each, and started again; its
clock is also an hour off in every third start. After each day the two weeks must have the same
tables, byte for byte but for what names a run: keys, times and folders. Exit code 1 if they differ.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import shutil
import sys
import tempfile
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from random import Random

from tests.robustness.kill_batch import draw_house
from tests.robustness.trial import begin, ended

from cucumbervision.capture.frames import Stop
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.readers.native import write_native

KILLS = 3
MASKS = ("--instances", "dataset", "--segmenter", "none", "--methods", "M1,M6")
_CLOCK = "import time\nnow = time.time\ntime.time = lambda: now() + 3600"
_RUN_OF = re.compile(r"(round|key|created|exported|started|source|place|store|time)", re.IGNORECASE)
"""Columns that name a run, not what was measured."""


@dataclass
class Week:
    """One week: its folder, how often its commands were killed, and how long each took."""

    folder: Path
    random: Random | None = None
    calm: Week | None = None
    killed: int = 0
    took_s: list[float] = field(default_factory=list)

    @property
    def store(self) -> Path:
        """The store of the rounds."""
        return self.folder / "house.db"

    def command(self, *words: object) -> None:
        """Run a command to its end, through kills where this week has them."""
        if self.random is not None and self.calm is not None:
            whole_s = self.calm.took_s[len(self.took_s)]
            for _ in range(KILLS):
                before = _CLOCK if self.random.random() < 1 / 3 else ""
                process = begin(*words, before=before)
                time.sleep(self.random.uniform(0.1, 1) * whole_s)
                process.kill()
                self.killed += ended(process).code < 0
        start_s = time.monotonic()
        self.once(*words)
        self.took_s.append(time.monotonic() - start_s)

    def day(self, number: int, captures: Path) -> None:
        """Measure and keep the captures of a day, and export its round."""
        name = f"day {number}"
        self.command("measure", captures.parent, "--out", self.folder / "measured", *MASKS)
        self.once("round", "new", name, "--store", self.store)
        store = ("--store", self.store)
        self.command("round", "add", captures, *store, "--round", name, *MASKS)
        out = self.folder / f"export-{number}"
        self.command("export", name, *store, "--out", out, "--format", "csv")

    def once(self, *words: object) -> None:
        """Run a command to its end, without a kill."""
        run = ended(begin(*words))
        if run.code:
            raise SystemExit(f"{' '.join(map(str, words))}: {run.said}")


def draw_week(folder: Path, captures: int, days: int) -> list[Path]:
    """Write the captures of every day, at stops along two rows."""
    draw_house(folder / "all", captures)
    places = []
    for number, source in enumerate(sorted((folder / "all").iterdir())):
        day, place = number % days, number // days
        capture = next(iter(open_source(source))).load()
        stop = Stop(row=str(1 + place % 2), side="left", position_m=0.4 * (place // 2), step=place)
        dated = replace(capture, stop=stop, timestamp_s=1_790_000_000.0 + 86400 * day + place)
        target = folder / "house" / f"day-{day}"
        write_native(dated, target / source.name)
        places.append(target)
    shutil.rmtree(folder / "all")
    return sorted(set(places))


def tables(week: Week) -> dict[str, list[dict[str, str]]]:
    """Return the rows of every table of a week, without what names a run."""
    texts = {}
    for path in sorted(week.folder.rglob("*.csv")):
        with path.open(newline="", encoding="utf-8-sig") as stream:
            texts[str(path.relative_to(week.folder))] = [
                {name: cell for name, cell in row.items() if not _RUN_OF.search(name)}
                for row in csv.DictReader(stream)
            ]
    return texts


def differences(calm: Week, disturbed: Week) -> list[str]:
    """Return what the two weeks do not have in common."""
    before, after = tables(calm), tables(disturbed)
    faults = [f"{name} is in one week only" for name in sorted(set(before) ^ set(after))]
    for name in sorted(set(before) & set(after)):
        if before[name] != after[name]:
            pairs = zip(before[name], after[name], strict=False)
            first = next((pair for pair in pairs if pair[0] != pair[1]), None)
            count = f"{len(before[name])} and {len(after[name])} rows"
            faults.append(f"{name}: {count}, first difference {json.dumps(first)}")
    for week in (calm, disturbed):
        check = ended(begin("round", "check", "--store", week.store))
        if check.code:
            faults.append(f"round check: {check.said}")
    return faults


def live(folder: Path, captures: int, days: int, seed: int) -> list[str]:
    """Live through both weeks day by day, say each day's counts, and return what differs."""
    places = draw_week(folder, captures, days)
    calm = Week(folder / "calm")
    disturbed = Week(folder / "disturbed", Random(seed), calm)
    for week in (calm, disturbed):
        week.folder.mkdir()
    for later in places:
        later.rename(folder / later.name)
    start_s, count = time.monotonic(), 0
    for number, place in enumerate(places):
        (folder / place.name).rename(place)
        for week in (calm, disturbed):
            week.day(number, place)
        if faults := differences(calm, disturbed):
            return faults
        count += len(list(place.iterdir()))
        rows = sum(map(len, tables(calm).values()))
        sys.stdout.write(
            f"day {number + 1}: {count} captures, {disturbed.killed} kills, {rows} rows in "
            f"{time.monotonic() - start_s:.0f} s: the same\n"
        )
        sys.stdout.flush()
    return []


def main() -> int:
    """Run both weeks and say in what they differ."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--captures", type=int, default=2000)
    parser.add_argument("--days", type=int, default=7)
    parser.add_argument("--seed", type=int, default=1)
    numbers = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="week-") as place:
        faults = live(Path(place), numbers.captures, numbers.days, numbers.seed)
    for fault in faults:
        sys.stdout.write(f"DIFFERENT {fault}\n")
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
