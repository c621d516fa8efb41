"""Mutation score of the tube and the methods: how many small faults in the code the tests notice.

    pip install mutmut && python scripts/mutation.py MUTANTS SEED

mutmut changes one operator, number or argument at a time and runs the tests that reach the changed
function ([tool.mutmut] in pyproject.toml says which). All mutants of the two rooms would take
hours, so a random sample is run. Survivors are listed; `mutmut show NAME` prints one.
"""

from __future__ import annotations

import json
import random
import subprocess
import sys
from pathlib import Path

SURVIVED, UNTESTED = 0, 33  # mutmut's exit codes; every other one is a mutant that was noticed


def mutmut(*names: str) -> dict[str, int | None]:
    """Generate the mutants, run those of these names, and return each mutant's exit code."""
    command = [sys.executable, "-m", "mutmut", "run", "--max-children", "1", *names]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    exit_codes: dict[str, int | None] = {}
    for file in Path("mutants/src/cucumbervision").glob("*/*.meta"):
        exit_codes |= json.loads(file.read_text(encoding="utf-8"))["exit_code_by_key"]
    return exit_codes


count, seed = map(int, sys.argv[1:3])
names = sorted(mutmut("cucumbervision.tube.evidence.x_depth_across__mutmut_1"))
sample = random.Random(seed).sample(names, min(count, len(names)))
codes = mutmut(*sample)
survivors = sorted(name for name in sample if codes[name] in (SURVIVED, UNTESTED, None))
print(
    f"{len(sample) - len(survivors)} of {len(sample)} noticed; not noticed:", *survivors, sep="\n"
)
