"""What is promised, what checks it, and what came of it: writes docs/proof.md.

    python benchmarks/proof.py --runs FOLDER [--only KEY,...] [--full] [--page docs/proof.md]
    python benchmarks/proof.py --runs FOLDER --take KEY=FILE@COMMIT --page docs/proof.md

The promises are in promises.toml. Each check's command runs in the repository's root; what it
printed is kept as FOLDER/KEY.FORM.json, so that a long run can be made in parts, and the page is
made of all that the folder holds, a full run before a quick one; of what it does not hold, the
page keeps what it had. --take keeps what a full command printed to a file earlier. A promise is
kept if the command ended well, printed what it should, and its figure reaches the aim. With --page
and without --only nothing is run. Exit code 1 if a check that ran did not reach its aim.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent
PROMISES = Path(__file__).with_name("promises.toml")
MOST_LINES = 24


@dataclass(frozen=True)
class Promise:
    """A promise and its check, as promises.toml has them."""

    key: str
    says: str
    quick: str = ""
    full: str = ""
    needs: str = ""
    shown: str = ""
    aim: str = ""
    not_checked: str = ""

    def command(self, *, full: bool) -> str:
        """Return the command of a form; the one that there is, if there is but one."""
        return (self.full or self.quick) if full else (self.quick or self.full)

    def missing(self) -> str:
        """Return what is not here that the check needs."""
        here = not self.needs or os.environ.get(self.needs) or shutil.which(self.needs)
        return "" if here else self.needs

    def answer(self, printed: str) -> re.Match[str] | None:
        """Return where the answer stands in what was printed."""
        found = list(re.finditer(self.shown, printed))
        return found[-1] if found else None

    def reached(self, printed: str) -> bool:
        """Return whether what was printed keeps the promise."""
        found = self.answer(printed)
        if found is None or not self.aim:
            return found is not None
        sign, limit = self.aim.split()
        value = float(found[1].replace(",", ""))
        return value <= float(limit) if sign == "<=" else value >= float(limit)


@dataclass(frozen=True)
class Run:
    """What a check printed, and where and when."""

    key: str
    form: str
    command: str
    printed: str
    code: int | None
    seconds: float | None
    when: str
    machine: str
    commit: str

    def keep(self, folder: Path) -> None:
        """Write it into a folder of runs."""
        folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps(asdict(self), indent=1, ensure_ascii=False) + "\n"
        (folder / f"{self.key}.{self.form}.json").write_text(text, encoding="utf-8")


def promises() -> list[Promise]:
    """Read all promises."""
    return [Promise(**one) for one in tomllib.loads(PROMISES.read_text("utf-8"))["promise"]]


def machine() -> str:
    """Return what this runs on, and how busy it is."""
    names = re.findall(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    cores = len(os.sched_getaffinity(0))
    return f"{cores} cores of {names[0]}, load {os.getloadavg()[0]:.0f}"


def stamp(at_s: float) -> str:
    """Return a moment as text."""
    return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(at_s))


def commit() -> str:
    """Return which code is checked."""
    words = ["git", "rev-parse", "--short", "HEAD"]
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout[:7]


def check(promise: Promise, *, full: bool) -> Run:
    """Run a check to its end, whatever comes of it."""
    command, begun, where = promise.command(full=full), time.time(), machine()
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    with tempfile.TemporaryDirectory() as tmp:
        done = subprocess.run(
            command.replace("{tmp}", tmp),
            shell=True,
            cwd=ROOT,
            env={**os.environ, "PATH": path, "COLUMNS": "160"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        printed = without_places(done.stdout.replace(tmp, "OUT"))
    form = "full" if command == promise.command(full=True) else "quick"
    seconds = round(time.time() - begun, 1)
    code = done.returncode
    return Run(promise.key, form, command, printed, code, seconds, stamp(begun), where, commit())


def without_places(printed: str) -> str:
    """Return what was printed without where this repository lies."""
    return printed.replace(f"{ROOT.resolve()}/", "")


def take(words: str, known: dict[str, Promise]) -> Run:
    """Keep what a full command printed to a file earlier, on this machine."""
    key, _, rest = words.partition("=")
    file, _, at = rest.partition("@")
    path, where = Path(file), machine().split(", load")[0]
    when, printed = stamp(path.stat().st_mtime), without_places(path.read_text(encoding="utf-8"))
    return Run(key, "full", known[key].full, printed, None, None, when, where, at or "an older one")


def runs_in(folder: Path) -> dict[str, Run]:
    """Return the runs of a folder by promise; a full run goes before a quick one."""
    found: dict[str, Run] = {}
    for form in ("quick", "full"):
        for path in sorted(folder.glob(f"*.{form}.json")):
            run = Run(**json.loads(path.read_text(encoding="utf-8")))
            found[run.key] = run
    return found


def verdict(promise: Promise, run: Run | None) -> str:
    """Return in a few words what became of a promise."""
    if run is None:
        return f"not checked: {promise.not_checked or 'no run'}"
    if promise.reached(run.printed) and not run.code:
        return "kept"
    whole = run.form == "full" or promise.command(full=True) == run.command
    if promise.answer(run.printed) is None:
        return "NOT KEPT" if whole else "not shown by the quick form"
    return "NOT REACHED" if whole else "not reached by the quick form"


def quoted(promise: Promise, run: Run) -> str:
    """Return the end of what was printed, without the progress of downloads and tests."""
    lines = [line.rstrip() for line in run.printed.splitlines()]
    kept = [line for line in lines if line and not set(line) <= set("─━═┏┳┓┗┻┛┡╇┩└┴┘┌┬┐├┼┤ ")]
    found = promise.answer(run.printed)
    if len(kept) > MOST_LINES and found is not None:
        answer = run.printed[: found.end()].splitlines()[-1].rstrip()
        tail = kept[-MOST_LINES + 1 :]
        kept = tail if any(answer in line for line in tail) else [answer, "…", *tail]
    return "\n".join(kept[-MOST_LINES - 1 :])


def earlier_of(text: str) -> dict[str, tuple[str, str, str]]:
    """Return a page's line, part and verdict of each promise, by its key."""
    parts = {part.split("\n", 1)[0]: f"## {part}" for part in f"\n{text}".split("\n## ")[1:]}
    rows = re.finditer(r"^\| \[.*\]\(#([\w-]+)\) \| (.*?) \| .*\|$", text, re.MULTILINE)
    return {row[1]: (row[0], parts[row[1]], row[2]) for row in rows if row[1] in parts}


def page(folder: Path, before: str = "") -> str:
    """Write the page from what a folder holds, and from the page before what it does not."""
    all_of_them, found, earlier = promises(), runs_in(folder), earlier_of(before)
    rows, parts, counts = [], [], []
    for promise in all_of_them:
        run = found.get(promise.key)
        row, part, said = earlier.get(promise.key, ("", "", ""))
        # What is promised now may be something else than what was checked.
        if run is None and row.startswith(f"| [{promise.says}]("):
            rows.append(row)
            parts.append(f"{part.rstrip()}\n")
            counts.append(said)
            continue
        said = verdict(promise, run)
        answer = promise.answer(run.printed) if run else None
        figure = answer[1] if answer is not None and promise.aim else ""
        aim = f"{figure} (aim {promise.aim})" if figure else ""
        link = f"[{promise.says}](#{promise.key})" if run else promise.says
        rows.append(f"| {link} | {said} | {aim} |")
        counts.append(said)
        if run is None:
            continue
        took = f", {run.seconds:g} s" if run.seconds is not None else ""
        parts.append(
            f"## {promise.key}\n\n{promise.says}: **{said}**.\n\n"
            f"```console\n{run.command}\n```\n\n"
            f"{run.when}, {run.machine}, at {run.commit}{took}:\n\n"
            f"```text\n{quoted(promise, run)}\n```\n"
        )
    kept, unchecked = counts.count("kept"), sum(one.startswith("not checked") for one in counts)
    return "\n".join(
        [
            "# Proof\n",
            "Written by `python benchmarks/proof.py --runs FOLDER --page docs/proof.md`, from what",
            "the commands below printed; nothing here is written by hand. `--only KEY` runs one",
            "check, `--full` in its full form. Load: how many processes wanted a core as it began;",
            "beyond the number of cores times are too long, and ratios rough.\n",
            f"{len(counts)} promises: {kept} kept, {len(counts) - kept - unchecked} not reached "
            f"or not shown, {unchecked} not checked.\n",
            "| promise | what came of it | figure |",
            "|---|---|---|",
            *rows,
            "",
            *parts,
        ]
    )


def main() -> None:
    """Run what is asked for, keep it, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=Path, required=True, help="folder of what was printed")
    parser.add_argument("--only", default="", help="keys of promises, with commas between")
    parser.add_argument("--full", action="store_true", help="the full form: hours")
    parser.add_argument("--take", action="append", default=[], metavar="KEY=FILE@COMMIT")
    parser.add_argument("--page", type=Path, help="where to write the page")
    arguments = parser.parse_args()
    known = {one.key: one for one in promises()}
    only = [key for key in arguments.only.split(",") if key]
    if unknown := set(only) - set(known):
        parser.error(f"no promise is called {', '.join(unknown)}; take {', '.join(known)}")
    for words in arguments.take:
        take(words, known).keep(arguments.runs)
    missed = False
    run_all = not (arguments.page or arguments.take)
    for key in only or (known if run_all else ()):
        promise = known[key]
        if promise.not_checked or promise.missing():
            print(f"{key:18} left out: {promise.not_checked or f'needs {promise.missing()}'}")
            continue
        run = check(promise, full=arguments.full)
        run.keep(arguments.runs)
        missed |= verdict(promise, run) != "kept"
        print(f"{key:18} {verdict(promise, run)} ({run.seconds:g} s)", flush=True)
    if arguments.page:
        before = arguments.page.read_text("utf-8") if arguments.page.is_file() else ""
        arguments.page.write_text(page(arguments.runs, before), encoding="utf-8")
    sys.exit(missed)


if __name__ == "__main__":
    main()
