"""Where a long part of the benchmark stands, on the standard error."""

from __future__ import annotations

import sys
import time


class Steps:
    """The steps of a part: each is announced as it begins, with the time that is left.

    Parameters
    ----------
    usual_s : dict of str to float
        How long each takes on a free machine, in their order. On a busy one the time left grows
        by what the steps so far took longer.
    """

    def __init__(self, usual_s: dict[str, float]) -> None:
        self._usual_s = usual_s
        self._begun_s = time.monotonic()

    def begin(self, step: str) -> None:
        """Announce a step, and the time left with it."""
        names = list(self._usual_s)
        number = names.index(step)
        before_s = sum(self._usual_s[name] for name in names[:number])
        left_s = sum(self._usual_s[name] for name in names[number:])
        taken_s = time.monotonic() - self._begun_s
        slower = max(1.0, taken_s / before_s) if before_s else 1.0
        place = f"[{number + 1} of {len(names)}, {taken_s:.0f} s]"
        print(f"{place} {step}; about {left_s * slower:.0f} s left", file=sys.stderr, flush=True)
