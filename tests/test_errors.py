from __future__ import annotations

import pytest

from cucumbervision.errors import InternalError, OutOfMemoryError, named_error


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
