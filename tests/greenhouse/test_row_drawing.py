from __future__ import annotations

import re
from xml.etree import ElementTree

from cucumbervision.crop.grades import Grade, GradeStatus
from cucumbervision.methods.result import Length
from cucumbervision_greenhouse.row_drawing import draw_rows, sheet
from cucumbervision_greenhouse.settings import Units
from cucumbervision_greenhouse.store.records import FruitRow, StopRecord

STOPS = [StopRecord("1", "left", at, key=str(at)) for at in (0.5, 1.0, 3.0)]


def drawn(*fruit: FruitRow, **names: str) -> str:
    names = {view.key: names.get(view.key, "I") for view in fruit}
    grades = {
        key: Grade(GradeStatus.IN_CLASS, name.split()[0], (), {}, possible=tuple(name.split()[1:]))
        for key, name in names.items()
    }
    [svg] = draw_rows(fruit, STOPS, grades, Units("cm")).values()
    ElementTree.fromstring(svg)
    return svg


def fruit(key: str, along_m: float, length_m: float | None, **how: object) -> FruitRow:
    length = None if length_m is None else Length(length_m, low_m=length_m, high_m=length_m)
    place = {"row": "1", "side": "left", "along_m": along_m, "centre_y_m": -0.2}
    return FruitRow(1, key=key, length=length, diameter_max_m=0.04, **{**place, **how})


def spans_mm(svg: str) -> list[tuple[int, int, int, int]]:
    """From where to where each fruit reaches along the row and downwards."""
    spans = []
    for path in re.findall(r'class="body"[^>]* d="m([-\d ]+)Z"', svg):
        steps = [int(x) for x in path.split()]
        x, y = ([sum(steps[k : n + 1 : 2]) for n in range(k, len(steps), 2)] for k in (0, 1))
        spans.append((min(x), max(x), min(y), max(y)))
    return spans


def test_a_fruit_has_its_length_and_width_where_it_hangs() -> None:
    svg = drawn(fruit("a", 1.2, 0.3))
    [(x0, x1, y0, y1)] = spans_mm(svg)
    assert (x0 + x1) / 2 == 1200
    assert abs((x1 - x0) - 40) <= 2
    assert (y0, y1) == (-350, -50)
    assert svg.count("not walked") == 1  # between 1.5 and 2.5 m


def test_a_bent_fruit_is_as_bent_as_its_path_and_mirrored_on_the_other_side() -> None:
    path = [(0.05, -0.1, 0.7), (0.0, 0.0, 0.7), (0.05, 0.1, 0.7)]
    bent = fruit("a", 1.0, 0.22, path_m=path, diameter_m=(0.0, 0.03, 0.0), centre_y_m=0.0)
    [(x0, x1, _, _)] = spans_mm(drawn(bent))
    assert 1000 - x0 < 20 < 50 <= x1 - 1000
    [(x0, x1, _, _)] = spans_mm(drawn(bent.with_(side="right")))
    assert 1000 - x0 >= 50 > 20 > x1 - 1000


def test_fruit_at_one_place_hang_beside_each_other_and_each_class_has_its_form() -> None:
    same = [fruit(key, 1.2, 0.3) for key in "abcd"]
    assert len({span[:2] for span in spans_mm(drawn(*same))}) == 4
    svg = drawn(
        fruit("a", 0.2, 0.235),
        fruit("b", 0.4, 0.245),
        fruit("c", 0.6, 0.3, picked_s=1.0),
        fruit("d", 0.8, None),
        fruit("e", 1.0, 0.3, flags="end-hidden"),
        a="II",
        b="undecided II I",
    )
    assert svg.count('class="line"') >= 2  # class II, and its sample
    assert 'fill="url(#may-5AAE61-1B7837)"' in svg
    assert svg.count("stroke-dasharray") >= 2
    for label in ("23.5<", "30.0 ✓<", ">?<", "≥ 30.0<"):
        assert label in svg
    ElementTree.fromstring(sheet({"Row 1 <left>": svg, "Row 2": svg}))
