from __future__ import annotations

import ast
import pickle
import string
from pathlib import Path

import numpy as np
import pytest

from cucumbervision import errors
from cucumbervision.errors import (
    CaptureError,
    InternalError,
    Message,
    MissingExtraError,
    OutOfMemoryError,
    named_error,
)

SOURCE = Path(errors.__file__).parents[1]


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        ImportError("cv2.abi3.so: failed to map segment from shared object"),
        OSError(12, "Cannot allocate memory"),
        RuntimeError("can't start new thread"),
        RuntimeError("std::bad_alloc"),
    ],
)
def test_memory_that_is_short_is_no_defect(error: Exception) -> None:
    named = named_error(error, "house/a")
    assert isinstance(named, OutOfMemoryError)
    assert str(named).startswith("house/a: there is not enough memory; ")


def test_what_has_no_name_is_a_defect() -> None:
    assert isinstance(named_error(ImportError("cannot import name 'x'")), InternalError)


def test_an_error_keeps_its_parts_in_another_process_and_of_another_file() -> None:
    error = CaptureError(
        "has {count} of {size:.1f} MB",
        source="a",
        remedy="give {count}",
        count=2,
        size=np.float32(1),
    )
    for copy in (pickle.loads(pickle.dumps(error)), error.at("b").at("a")):
        assert str(copy) == str(error) == "a: has 2 of 1.0 MB; give 2"
        assert copy.message.template == "has {count} of {size:.1f} MB"
        assert copy.message.parts == {"count": 2, "size": 1.0}
    assert pickle.loads(pickle.dumps(MissingExtraError("a"))).message.parts["package"] == "a"


def test_braces_of_a_name_are_no_parts() -> None:
    assert str(CaptureError("no {x}", source="{y}.png")) == "{y}.png: no {x}"
    assert Message("no file {name}", name="{x}") == "no file {x}"


def test_every_template_has_its_parts() -> None:
    calls = 0
    for path in sorted(SOURCE.glob("cucumbervision*/**/*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            name = getattr(getattr(node, "func", None), "id", "")
            if not (isinstance(node, ast.Call) and name.endswith(("Error", "Message"))):
                continue
            texts = [*node.args[:1], *(k.value for k in node.keywords if k.arg == "remedy")]
            parts = {k.arg for k in node.keywords} - {"source", "remedy"}
            if parts and None not in parts and all(isinstance(x, ast.Constant) for x in texts):
                template = " ".join(str(x.value) for x in texts if isinstance(x, ast.Constant))
                fields = {field for _, field, _, _ in string.Formatter().parse(template)}
                assert fields - {None} == parts, f"{path}:{node.lineno}"
                calls += 1
    assert calls > 40
