"""What each page of the dashboard computes for a round of many stops.

    python benchmarks/bench_pages.py [--stops 500]

The page's script as Streamlit runs it for a viewer, without a browser: processor time of the first
run, which reads the round, and of the next, which finds it in the cache.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

from made_stops import made_round, made_stop
from streamlit.testing.v1 import AppTest

from cucumbervision.capture.source import bundled_captures
from cucumbervision.store.repository import open_store

PAGES = ("results", "row_map", "forecast", "accuracy", "capture", "upload", "settings")


def run_s(page: AppTest) -> float:
    """Return the processor time of one run of a page."""
    begun = time.process_time()
    page.run()
    assert not page.exception, page.exception
    return time.process_time() - begun


def main() -> None:
    """Save a round and run every page."""
    parser = argparse.ArgumentParser(description="Computing time of the pages.")
    parser.add_argument("--stops", type=int, default=500)
    stops = parser.parse_args().stops
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "house.db"
        with open_store(path) as store:
            walk = made_round("bench")
            store.save_round(walk)
            for number in range(stops):
                store.save_stop(made_stop(walk, number))
        os.environ["CUCUMBERVISION_STORE"] = str(path)
        os.environ["CUCUMBERVISION_REPLAY"] = str(bundled_captures())
        for name in PAGES:
            script = f"from cucumbervision.dashboard.views import {name}\n{name}.page()\n"
            page = AppTest.from_string(script, default_timeout=3600)
            page.session_state["source"] = "replay"
            first, second = run_s(page), run_s(page)
            print(f"{name:10} first {first:5.2f} s, then {second:5.2f} s")


if __name__ == "__main__":
    main()
