from __future__ import annotations

import pytest

from cucumbervision.errors import CucumberVisionError
from cucumbervision.measurement.result import Method
from cucumbervision.pipeline.options import MeasureOptions, parse_methods


def test_methods_keep_their_own_order() -> None:
    assert parse_methods("M5, m1") == (Method.M1, Method.M5)
    assert parse_methods("ALL")[:2] == (Method.M1, Method.M2)


@pytest.mark.parametrize("text", ["m9", "", " , ", "m1;m2"])
def test_a_wrong_method_is_named_with_the_remedy(text: str) -> None:
    with pytest.raises(CucumberVisionError, match=r"--methods: no method is called .*; give all"):
        parse_methods(text)


def test_the_hash_tells_configurations_apart() -> None:
    assert MeasureOptions().sha256 == MeasureOptions().sha256
    assert MeasureOptions().sha256 != MeasureOptions(methods=(Method.M1,)).sha256
    assert len(MeasureOptions().sha256) == 64


def test_options_are_json(tmp_path: object) -> None:
    values = MeasureOptions().as_json()
    assert values["selector"] == "best"
    assert values["reading"]["burst"] == 5
