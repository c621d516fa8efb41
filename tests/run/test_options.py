from __future__ import annotations

from typing import Any

import pytest

from cucumbervision.errors import CucumberVisionError
from cucumbervision.methods.result import LengthDefinition, MethodName, Selector
from cucumbervision.run.measurer import Measurer
from cucumbervision.run.options import MeasureOptions


def test_methods_are_read_from_text_and_keep_their_own_order() -> None:
    given: dict[str, Any] = {"methods": "M5, m1"}
    assert MeasureOptions(**given).methods == (MethodName.M1, MethodName.M5)
    given = {"methods": "ALL"}
    assert MeasureOptions(**given) == MeasureOptions()


def test_names_are_taken_for_what_they_name() -> None:
    given: dict[str, Any] = {"length": "chord", "selector": "paper", "methods": ("m1", "M5")}
    assert MeasureOptions(**given) == MeasureOptions(
        length=LengthDefinition.CHORD,
        selector=Selector.PAPER,
        methods=(MethodName.M1, MethodName.M5),
    )
    given = {"methods": "m6"}
    assert MeasureOptions(**given).methods == (MethodName.M6,)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (
            {"length": "chrod"},
            "length: 'chrod' is not a valid value; give thread or centreline or chord",
        ),
        ({"selector": "bset"}, "selector: 'bset' is not a valid value; give best or paper"),
        ({"methods": ""}, "methods: '' is not a valid value; give M1 or M2"),
        ({"methods": "m1;m2"}, "methods: 'm1;m2' is not a valid value"),
        ({"methods": ("m9",)}, "methods: 'm9' is not a valid value; give M1 or M2"),
        ({"confidence": 25}, "confidence: 25 is not a valid value; give a number from 0 to 1"),
        ({"confidence": float("nan")}, "nan is not a valid value"),
        ({"prompt": "boxes"}, "'boxes' is not a valid value; give box or"),
        ({"runtime": "gpu"}, "'gpu' is not a valid value; give auto or"),
        ({"camera_up": "up"}, "'up' is not a valid value; give top or left or right or bottom"),
    ],
)
def test_what_is_no_choice_is_refused_at_once(given: dict[str, Any], text: str) -> None:
    with pytest.raises(CucumberVisionError, match=text):
        MeasureOptions(**given)


def test_a_measurer_takes_captures_and_says_how_to_get_one() -> None:
    folder: Any = "captures"
    with pytest.raises(CucumberVisionError, match=r"not str; open files .* with open_source"):
        Measurer(MeasureOptions(instances="dataset")).measure(folder)
