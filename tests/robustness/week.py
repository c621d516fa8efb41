"""A week's work with kills in between, compared with a week that nothing disturbed.

    python -m tests.robustness.week [--captures 2000] [--days 7] [--seed 1] [--folder DIR]

On each day captures are added to a house, watched by `stream`, measured into one folder by
`measure`, added to the day's round by `round add`, and exported. In one of two weeks every command
is killed with signal 9 at random moments of the time that it took in the other, a few times each,
and started again; its clock is also an hour off in every third start. After each day the two weeks
must have the same tables and lines, byte for byte but for what names a run: keys, times and
folders. Exit code 1 if they differ. After each command it says how long the rest may take. Ctrl-C
or signal 15 ends it after the command that runs, and the same words with its folder go on there.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import Any

from tests.robustness.counted import read_counts, write_counts
from tests.robustness.kill_batch import draw_house
from tests.robustness.trial import ALONE, begin, ended

from cucumbervision.capture.frames import Stop
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.readers.native import write_native

KILLS = 3
MASKS = ("--instances", "dataset", "--segmenter", "none", "--methods", "M1,M6")
_COMMANDS = 5  # of a day
_MORE = 1 + 0.55 * KILLS  # times as long as an undisturbed command takes one with kills
_CLOCK = "\nimport time\nnow = time.time\ntime.time = lambda: now() + 3600"
_RUN_OF = re.compile(
    r"(round|key|created|exported|started|source|place|store|time|latency)", re.IGNORECASE
)
"""Columns that name a run, not what was measured."""


@dataclass
class Week:
    """One week; what its folder says is done is not done again.

    Parameters
    ----------
    folder : Path
        Where it keeps everything.
    seed : int
        Of the kills.
    calm : Week, optional
        The week that nothing disturbs; without it this is that week.
    """

    folder: Path
    seed: int = 0
    calm: Week | None = None

    def __post_init__(self) -> None:
        self.folder.mkdir(exist_ok=True)
        said = read_counts(self.folder / "commands.json")
        self.took_s: list[float] = said.get("took_s", [])
        self.killed: int = said.get("killed", 0)
        self._number = 0

    @property
    def store(self) -> Path:
        """The store of the rounds."""
        return self.folder / "house.db"

    def day(self, number: int, captures: Path) -> Iterator[str]:
        """Watch, measure and keep the captures of a day and export its round, one by one."""
        self._number = _COMMANDS * number
        name, store = f"day {number}", ("--store", self.store)
        yield self._command("stream", captures, "--every", "--quiet", *MASKS)
        yield self._command("measure", captures.parent, "--out", self.folder / "measured", *MASKS)
        yield self._command("round", "new", name, *store, kills=0)  # a second is refused
        yield self._command("round", "add", captures, *store, "--round", name, *MASKS)
        out = self.folder / f"export-{number}"
        yield self._command("export", name, *store, "--out", out, "--format", "csv")

    def _command(self, *words: object, kills: int = KILLS) -> str:
        """Run a command to its end, through kills where this week has them; return its name."""
        number, self._number = self._number, self._number + 1
        if number < len(self.took_s):
            return ""
        if self.calm is not None:
            random = Random(f"{self.seed} {number}")
            for _ in range(kills):
                process = begin(*words, before=ALONE + _CLOCK * (random.random() < 1 / 3))
                time.sleep(random.uniform(0.1, 1) * self.calm.took_s[number])
                process.kill()
                self.killed += ended(process).code < 0
        start_s = time.monotonic()
        run = ended(begin(*words, before=ALONE))
        if run.code:
            raise SystemExit(f"{' '.join(map(str, words))}: {run.said}")
        if words[0] == "stream":
            (self.folder / f"stream-{number}.jsonl").write_text(run.said, encoding="utf-8")
        self.took_s.append(time.monotonic() - start_s)
        write_counts(self.folder / "commands.json", "killed", self.killed)
        write_counts(self.folder / "commands.json", "took_s", self.took_s)
        return " ".join(map(str, words[:2] if words[0] == "round" else words[:1]))


def draw_week(folder: Path, captures: int, days: int) -> None:
    """Write the captures of every day, at stops along two rows, for a house that is empty yet."""
    draw_house(folder / "all", captures)
    for number, source in enumerate(sorted((folder / "all").iterdir())):
        day, place = number % days, number // days
        capture = next(iter(open_source(source))).load()
        stop = Stop(row=str(1 + place % 2), side="left", position_m=0.4 * (place // 2), step=place)
        dated = replace(capture, stop=stop, timestamp_s=1_790_000_000.0 + 86400 * day + place)
        write_native(dated, folder / "later" / f"day-{day}" / source.name)
    shutil.rmtree(folder / "all")


def tables(week: Week) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of every table and stream of a week, without what names a run."""
    texts = {}
    for path in sorted(week.folder.rglob("*.csv")):
        with path.open(newline="", encoding="utf-8-sig") as stream:
            texts[str(path.relative_to(week.folder))] = list(csv.DictReader(stream))
    for path in sorted(week.folder.glob("*.jsonl")):
        lines = path.read_text(encoding="utf-8").splitlines()
        texts[path.name] = [json.loads(line) for line in lines]
    return {
        name: [{key: cell for key, cell in row.items() if not _RUN_OF.search(key)} for row in rows]
        for name, rows in texts.items()
    }


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


def begin_weeks(folder: Path, captures: int, days: int, seed: int) -> dict[str, Any]:
    """Draw the captures, or find those of an earlier run; return what both weeks did so far."""
    plan, kept = {"captures": captures, "days": days, "seed": seed}, folder / "progress.json"
    if not kept.exists():
        for name in ("all", "later"):  # of a run that was ended while it drew
            shutil.rmtree(folder / name, ignore_errors=True)
        (folder / "house").mkdir(parents=True, exist_ok=True)
        draw_week(folder, captures, days)
        write_counts(kept, "plan", plan)
    elif read_counts(kept)["plan"] != plan:
        raise SystemExit(f"{folder} holds another week, {read_counts(kept)['plan']}")
    return {"inputs": 0, "came": "", **read_counts(kept).get("counts", {})}


def live(
    folder: Path, captures: int, days: int, seed: int, stop: threading.Event
) -> tuple[list[str], dict[str, Any]]:
    """Live through both weeks day by day, say each day's counts, and return what differs.

    Returns
    -------
    list of str
        What differs.
    dict
        The counts of the days that both weeks have behind them.
    """
    counts = begin_weeks(folder, captures, days, seed)
    calm = Week(folder / "calm")
    disturbed = Week(folder / "disturbed", seed, calm)
    done, start_s = 0.0, time.monotonic()
    for number in range(counts.get("days", 0), days):
        place = folder / "house" / f"day-{number}"
        if not place.exists():
            (folder / "later" / place.name).rename(place)
        for week, cost in ((calm, 1.0), (disturbed, _MORE)):
            for name in filter(None, week.day(number, place)):
                done += cost
                left = _COMMANDS * (1 + _MORE) * days - len(calm.took_s)
                left -= _MORE * len(disturbed.took_s)
                left_s = left / done * (time.monotonic() - start_s)
                what = f"day {number + 1} of {days}, {week.folder.name}: {name}"
                _say(
                    f"{what}, {week.killed} kills so far; about {max(left_s, 0) / 60:.0f} min left"
                )
                if stop.is_set():
                    return [], counts
        if faults := differences(calm, disturbed):
            return faults, counts
        rows = sum(map(len, tables(calm).values()))
        counts = {
            "days": number + 1,
            "inputs": counts["inputs"] + len(list(place.iterdir())),
            "came": f"{disturbed.killed} kills on {number + 1} days, {rows:,} rows: the same",
        }
        write_counts(folder / "progress.json", "counts", counts)
        _say(f"day {number + 1}: {counts['inputs']:,} captures, {counts['came']}")
    return [], counts


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main() -> int:
    """Run both weeks and say in what they differ."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--captures", type=int, default=2000)
    parser.add_argument("--days", type=int, default=7)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="of both weeks, where another run goes on")
    parser.add_argument("--counts", type=Path, help="file to which the counts are written")
    given = parser.parse_args()
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    with tempfile.TemporaryDirectory(prefix="week-") as tmp:
        folder = given.folder or Path(tmp)
        faults, counts = live(folder, given.captures, given.days, given.seed, stop)
    if given.counts is not None and not faults:
        write_counts(given.counts, "week", counts)
    for fault in faults:
        _say(f"DIFFERENT {fault}")
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
