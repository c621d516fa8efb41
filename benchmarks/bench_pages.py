"""What each page of the dashboard computes for a round of many stops.

    python benchmarks/bench_pages.py [--stops 500]

The page's script as Streamlit runs it for a viewer, without a browser: the time and processor time
of the first run, which reads the round, and of the next, which finds it in the cache. Each page is
the first that its server shows; what all pages load once, such as the chart library, is loaded
before.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import streamlit as st
from made_stops import made_round, made_stop
from streamlit.testing.v1 import AppTest

from cucumbervision.capture.source import bundled_captures
from cucumbervision.store.repository import open_store

PAGES = ("today", "results", "row_map", "forecast", "accuracy", "capture", "upload", "settings")


def run_s(page: AppTest) -> tuple[float, float]:
    """Return the time and the processor time of one run of a page."""
    begun = time.perf_counter(), time.process_time()
    page.run()
    assert not page.exception, page.exception
    return time.perf_counter() - begun[0], time.process_time() - begun[1]


def run_page(name: str) -> None:
    """Run a page twice with empty caches, and print what it took."""
    st.cache_resource.clear()
    st.cache_data.clear()
    script = f"from cucumbervision.dashboard.views import {name}\n{name}.page()\n"
    page = AppTest.from_string(script, default_timeout=3600)
    page.session_state["source"] = "replay"
    (first, first_cpu), (second, second_cpu) = run_s(page), run_s(page)
    print(
        f"{name:10} first {first:5.2f} s ({first_cpu:.2f} s of a processor), "
        f"then {second:5.2f} s ({second_cpu:.2f} s)"
    )


def main() -> None:
    """Save a round and run every page."""
    parser = argparse.ArgumentParser(description="Computing time of the pages.")
    parser.add_argument("--stops", type=int, default=500)
    stops = parser.parse_args().stops
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "house.db"
        with open_store(path) as store:
            walk = replace(made_round("bench"), started_s=time.time() - 10.0 * stops)
            store.save_round(walk)
            for number in range(stops):
                store.save_stop(made_stop(walk, number, store.images))
        os.environ["CUCUMBERVISION_STORE"] = str(path)
        os.environ["CUCUMBERVISION_REPLAY"] = str(bundled_captures())
        with contextlib.redirect_stdout(io.StringIO()):
            for name in PAGES:
                run_page(name)
        for name in PAGES:
            run_page(name)


if __name__ == "__main__":
    main()
