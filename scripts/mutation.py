"""Mutation score of geometry and measurement: how many small faults in the code the tests notice.

pip install mutmut
python scripts/mutation.py --mutants 300 --seed 1

mutmut changes one operator, number or argument at a time and runs the tests that reach the changed
function ([tool.mutmut] in pyproject.toml says which). All mutants of the two rooms would take
hours, so a random sample is run. Survivors are listed; `mutmut show NAME` prints one.
"""

from __future__ import annotations

import argparse
import json
import random
import subprocess
import sys
from collections import Counter
from pathlib import Path

ROOMS = ("geometry", "measurement")
SURVIVED, UNTESTED = 0, 33  # mutmut's exit codes; every other one is a mutant that was noticed


def mutmut(*names: str) -> None:
    """Generate the mutants and run those of these names."""
    command = [sys.executable, "-m", "mutmut", "run", "--max-children", "1", *names]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def outcomes() -> dict[str, int | None]:
    """Return each mutant's exit code by name; None where it was not run."""
    exit_codes: dict[str, int | None] = {}
    for room in ROOMS:
        for file in Path("mutants/src/cucumbervision", room).glob("*.meta"):
            exit_codes |= json.loads(file.read_text(encoding="utf-8"))["exit_code_by_key"]
    return exit_codes


def main() -> None:
    """Run a sample and print the score of each module and the survivors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mutants", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    mutmut("cucumbervision.geometry.pixels.x_depth_across__mutmut_1")  # makes all, runs one
    names = sorted(outcomes())
    chosen = random.Random(options.seed).sample(names, min(options.mutants, len(names)))
    mutmut(*chosen)
    codes = outcomes()
    missed = [name for name in chosen if codes[name] in (SURVIVED, UNTESTED, None)]
    total = Counter(name.rsplit(".", 1)[0] for name in chosen)
    alive = Counter(name.rsplit(".", 1)[0] for name in missed)
    for module, count in sorted(total.items()):
        print(f"{module:42s} {count - alive[module]:4d} of {count:4d} noticed")
    share = 1 - len(missed) / len(chosen)
    print(f"{'all':42s} {len(chosen) - len(missed):4d} of {len(chosen):4d} noticed: {share:.0%}")
    print("\nnot noticed:", *sorted(missed), sep="\n")


if __name__ == "__main__":
    main()
