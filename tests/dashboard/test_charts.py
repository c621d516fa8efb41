from __future__ import annotations

import pytest

pytest.importorskip("streamlit")

from cucumbervision.dashboard import charts
from cucumbervision.dashboard.settings import Units

COLORS = {
    "domain": ["class I", "class II", "no class", "class unsure"],
    "range": ["#1B7837", "#5AAE61", "#E69F00", "#999999"],
}


def test_every_class_of_the_lines_has_its_colour() -> None:
    named = ("class unsure", "class II", "no class", "class I", "class II")
    lines = [
        {"length": 20.0 + k, "class": name, "along": 0.1 * k, "height": 0.0, "mark": "seen"}
        for k, name in enumerate(named)
    ]
    bars = charts.histogram(lines, Units("cm")).to_dict()["layer"][1]
    assert bars["encoding"]["color"]["scale"] == COLORS
    # The scale is that of all rows, also where one row has fewer classes.
    marks = charts.map_chart(lines[:1], lines, Units("cm"), by_length=False).to_dict()
    assert marks["encoding"]["fill"]["scale"] == marks["encoding"]["stroke"]["scale"] == COLORS
