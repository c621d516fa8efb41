from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("streamlit")

from cucumbervision.crop.grades import grade
from cucumbervision.crop.profiles import load_profile
from cucumbervision.methods.result import Length
from cucumbervision_greenhouse.pages.row_map import map_picture
from cucumbervision_greenhouse.store.records import FruitRow

pytestmark = pytest.mark.usefixtures("fresh_caches")


def test_a_map_has_a_layer_a_class_and_its_marks_where_the_fruit_hang(house: Path) -> None:
    profile = load_profile("long-cucumber")
    fruit = [
        FruitRow(
            1,
            key=str(k),
            length=None if length_m is None else Length(length_m, low_m=length_m, high_m=length_m),
            along_m=1.0 * k,
            centre_y_m=-0.2 * k,
            views=k,
        )
        for k, length_m in enumerate([0.12, 0.27, None])
    ]
    grades = {view.key: grade(view, profile) for view in fruit}
    layers, grid = map_picture(fruit[:2], fruit, grades, by_length=False)
    drawn = {layer["name"]: layer["marks"][0] for layer in layers}
    # Scales are those of all rows: the second fruit hangs in the middle of what is shown.
    assert drawn["too short"] == (50.0, 510.0, "0", "0.00 m: 12.0 cm, too short", "seen", False)
    assert drawn["undecided"][:3] == (500.0, 280.0, "1")
    assert drawn["undecided"][4:] == ("seen", True)
    assert (500.0, "1 m") in grid["across"]
    assert (280.0, "0.2 m") in grid["up"]
    layers, _ = map_picture(fruit, fruit, grades, by_length=True)
    assert [one["name"] for one in layers] == ["not measured", "10 to 15 cm", "25 to 30 cm"]
