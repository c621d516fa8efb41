"""Every number of a camera file, drawn by Hypothesis: it is read, or refused by a named error."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.robustness import seeds

from cucumbervision.capture.camera_file import read_camera_file
from cucumbervision.capture.intrinsics import check_intrinsics
from cucumbervision.capture.readers import ReadOptions, open_source
from cucumbervision.errors import CucumberVisionError

Place = tuple[str | int, ...]

EXTREMES = (
    *(0, -0.0, -1, 5e-324, 1e-300, 1e-30, 1e30, 1e300, -1e300, math.nan, math.inf, -math.inf),
    *(2**31, 2**63, 10**30, 10**399, -(10**399)),
)
NUMBERS = st.one_of(
    st.sampled_from(EXTREMES),
    st.floats(),
    st.integers(-(10**400), 10**400),
    st.floats(1e-3, 1e4),
)


def places_of(node: Any, at: Place = ()) -> Iterator[Place]:
    """Yield where a JSON tree holds numbers."""
    if isinstance(node, dict | list):
        for key, value in node.items() if isinstance(node, dict) else enumerate(node):
            yield from places_of(value, (*at, key))
    elif isinstance(node, int | float) and not isinstance(node, bool):
        yield at


def with_numbers(tree: Any, changes: dict[Place, float]) -> Any:
    """Return a copy of a JSON tree with other numbers at some places."""
    changed = deepcopy(tree)
    for place, number in changes.items():
        node = changed
        for key in place[:-1]:
            node = node[key]
        node[place[-1]] = number
    return changed


def changes_of(tree: Any) -> st.SearchStrategy[dict[Place, float]]:
    """Draw one to four places of a tree with a number for each."""
    places = st.sampled_from(list(places_of(tree)))
    return st.dictionaries(places, NUMBERS, min_size=1, max_size=4)


def read_as_camera(path: Path) -> None:
    check_intrinsics(read_camera_file(path).intrinsics, 64, 48, source=path)


def read_as_capture(folder: Path, path: Path) -> None:
    assert path.is_relative_to(folder)
    for ref in open_source(folder, ReadOptions()):
        ref.load()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("cameras")
    for name, seed in (("camera", seeds.camera_file), ("bop", seeds.bop), ("native", seeds.native)):
        (made / name).mkdir()
        seed(made / name)
    return made


FILES = (
    *("camera/camera.json", "camera/matrix.json", "camera/bop.json"),
    *("bop/scene_camera.json", "native/one/capture.json"),
)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of numbers that overflow when multiplied
@pytest.mark.parametrize("name", FILES)
@settings(
    max_examples=150,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(data=st.data())
def test_any_number_is_read_or_refused_by_name(
    name: str, folder: Path, data: st.DataObject
) -> None:
    path = folder / name
    valid = path.read_text(encoding="utf-8")
    tree = json.loads(valid)
    read = read_as_camera if name.startswith("camera") else partial(read_as_capture, path.parent)
    changes = data.draw(changes_of(tree))
    path.write_text(json.dumps(with_numbers(tree, changes)), encoding="utf-8")
    try:
        with contextlib.suppress(CucumberVisionError):
            read(path)
    finally:
        path.write_text(valid, encoding="utf-8")


def test_numbers_are_found_and_changed() -> None:
    tree = {"a": [1, {"b": 2.5}], "c": True, "d": "1"}
    assert list(places_of(tree)) == [("a", 0), ("a", 1, "b")]
    changed = with_numbers(tree, {("a", 1, "b"): 7})
    assert changed == {"a": [1, {"b": 7}], "c": True, "d": "1"}
    assert tree["a"] == [1, {"b": 2.5}]
