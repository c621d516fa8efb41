"""Figures of a benchmark beside their aims, as a table."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Figure:
    """One line of a table: what, how much, and what it should be ('<= 8' or '>= 1.7')."""

    what: str
    value: float
    unit: str
    aim: str = ""

    @property
    def kept(self) -> bool:
        """Whether the aim, if there is one, is reached."""
        if not self.aim:
            return True
        sign, limit = self.aim.split()
        return self.value <= float(limit) if sign == "<=" else self.value >= float(limit)

    @property
    def verdict(self) -> str:
        """The aim in words."""
        return f"{self.aim}: {'kept' if self.kept else 'MISSED'}" if self.aim else ""


def machine() -> str:
    """Return what this ran on."""
    names = re.findall(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    load = os.getloadavg()[0]
    return f"{len(os.sched_getaffinity(0))} cores, {names[0]}; load {load:.1f}"


HEAD = "| what | figure | aim |\n|---|--:|---|"


def as_row(figure: Figure) -> str:
    """Return a figure as a line of a Markdown table."""
    return f"| {figure.what} | {figure.value:.3g} {figure.unit} | {figure.verdict} |"
