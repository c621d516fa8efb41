from __future__ import annotations

import pytest

pytest.importorskip("streamlit")

from cucumbervision_greenhouse.pages.row_map import map_picture
from cucumbervision_greenhouse.settings import Units


def test_a_map_has_a_layer_a_class_and_its_marks_where_the_fruit_hang() -> None:
    shown = [
        {
            "key": str(k),
            "along": 1.0 * k,
            "height": 0.2 * k,
            "length": length,
            "class": name,
            "mark": "seen",
            "views": k,
            "says": "",
        }
        for k, (length, name) in enumerate([(12.0, "too short"), (27.0, "class I"), (None, "?")])
    ]
    layers, grid = map_picture(shown[:2], shown, Units("cm"), by_length=False)
    drawn = {layer["name"]: layer["marks"][0] for layer in layers}
    # Scales are those of all rows: the second fruit hangs in the middle of what is shown.
    assert drawn["too short"] == (50.0, 510.0, "0", "", "seen", False)
    assert drawn["class I"] == (500.0, 280.0, "1", "", "seen", True)
    assert (500.0, "1 m") in grid["across"]
    assert (280.0, "0.2 m") in grid["up"]
    layers, _ = map_picture(shown, shown, Units("cm"), by_length=True)
    assert [one["name"] for one in layers] == ["not measured", "10 to 15 cm", "25 to 30 cm"]
