"""A week's work with kills in between, compared with a week that nothing disturbed.

    python -m tests.robustness.week [--captures 2000] [--days 7] [--seed 1]

On each day captures are added to a house, measured into one folder by `measure`, added to the
day's round by `round add`, and exported. In one of two weeks every command is killed with signal 9
at random moments, a few times each, and started again; its clock is also an hour off in every
third start. The two weeks must end with the same tables, byte for byte but for what names a run:
keys, times and folders. Exit code 1 if they differ.
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
from dataclasses import dataclass, replace
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
    """One week: its folder, and how often its commands were killed."""

    folder: Path
    random: Random | None = None
    killed: int = 0

    @property
    def store(self) -> Path:
        """The store of the rounds."""
        return self.folder / "house.db"

    def command(self, *words: object) -> None:
        """Run a command to its end, through kills where this week has them."""
        for _ in range(KILLS if self.random else 0):
            assert self.random is not None
            before = _CLOCK if self.random.random() < 1 / 3 else ""
            process = begin(*words, before=before)
            # Half of the kills while it starts and lists, the others while it works.
            time.sleep(self.random.uniform(0.5, 3) * self.random.choice((1, 3)))
            process.kill()
            self.killed += ended(process).code < 0
        self.once(*words)

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


def main() -> None:
    """Run both weeks and say in what they differ."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--captures", type=int, default=2000)
    parser.add_argument("--days", type=int, default=7)
    parser.add_argument("--seed", type=int, default=1)
    numbers = parser.parse_args()
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        days = draw_week(folder, numbers.captures, numbers.days)
        weeks = [Week(folder / "calm"), Week(folder / "disturbed", Random(numbers.seed))]
        for week in weeks:
            week.folder.mkdir()
            for number, captures in enumerate(days):
                hidden = [later for later in days[number + 1 :] if later.exists()]
                for later in hidden:
                    later.rename(folder / later.name)
                week.day(number, captures)
                for later in hidden:
                    (folder / later.name).rename(later)
        faults = differences(*weeks)
        rows = sum(map(len, tables(weeks[0]).values()))
    for fault in faults:
        sys.stdout.write(f"{fault}\n")
    sys.stdout.write(
        f"{numbers.captures} captures on {numbers.days} days, {weeks[1].killed} kills, {rows} rows "
        f"in {time.monotonic() - start:.0f} s: " + ("DIFFERENT" if faults else "the same") + "\n"
    )
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
