"""For the tests and for the docstrings' examples."""

from __future__ import annotations

import os
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

# The pages import Streamlit as they load, so that without it there is nothing to collect.
collect_ignore_glob = [] if find_spec("streamlit") else ["src/cucumbervision_greenhouse/pages/*"]
# Tests and files that were skipped here: `.ci/run` runs them again where nothing is missing.
_SKIPPED: set[str] = set()


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Note a skipped test, without its parameters."""
    if report.skipped:
        _SKIPPED.add(report.nodeid.partition("[")[0])


def pytest_collectreport(report: pytest.CollectReport) -> None:
    """Note a file that is skipped as it loads."""
    if report.skipped:
        _SKIPPED.add(report.nodeid)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Write what was noted, one a line, into the file that the environment names."""
    place = os.environ.get("CUCUMBERVISION_SKIPPED")
    if place and not hasattr(session.config, "workerinput"):
        Path(place).write_text("\n".join(sorted(_SKIPPED)), encoding="utf-8")


@pytest.fixture(autouse=True)
def _plain_numbers() -> Iterator[None]:
    """Print arrays as NumPy does, whatever a library that was imported has set."""
    with np.printoptions(formatter=None, linewidth=75, precision=8, suppress=False):
        yield
