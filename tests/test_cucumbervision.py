from __future__ import annotations

import subprocess
import sys

import pytest

import cucumbervision


def test_every_public_name_is_there() -> None:
    for name in {*dir(cucumbervision)} - {"FruitMeasurement"}:
        assert getattr(cucumbervision, name) is not None
    assert {"Measurer", "MeasureOptions", "open_source", "__version__"} <= set(dir(cucumbervision))


def test_the_old_name_of_fruit_warns() -> None:
    with pytest.warns(DeprecationWarning, match="called Fruit"):
        assert cucumbervision.FruitMeasurement is cucumbervision.Fruit


def test_a_name_that_is_not_there_is_an_attribute_error() -> None:
    assert not hasattr(cucumbervision, "length_of_everything")


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = (
        "import sys, cucumbervision\n"
        "heavy = {'numpy', 'scipy', 'cv2', 'onnxruntime', 'openvino', 'torch', 'pydantic'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
