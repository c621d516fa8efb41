"""Pages of the dashboard, drawn without a browser, for tests."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any
from xml.etree import ElementTree

from streamlit.testing.v1 import AppTest

from cucumbervision_greenhouse import resources
from cucumbervision_greenhouse.store.records import key_of

WALK, LONG = key_of("walk"), key_of("long walk")
PAGES = ("today", "upload", "results", "row_map", "days", "forecast", "accuracy", "settings")


def app(page: str, draw: str = "page", **state: Any) -> AppTest:
    script = f"from cucumbervision_greenhouse.pages import {page}\n{page}.{draw}()\n"
    test = AppTest.from_string(script, default_timeout=600)
    for name, value in state.items():
        if name in ("fruit", "stop", "row"):  # the address names them
            test.query_params[name] = value
        else:
            test.session_state[name] = value
    return test.run()


def said(test: AppTest) -> str:
    notes = [*test.info, *test.warning, *test.error, *test.success, *test.toast]
    parts = [*notes, *test.markdown, *test.caption]
    return "\n".join(str(part.value) for part in parts).replace("\\", "")  # as it is drawn


def listed(test: AppTest) -> list[list[str]]:
    """What the list of fruit says of each."""
    return [line["says"] for line in _lines(test)]


def tables(test: AppTest) -> list[list[dict[str, str]]]:
    """The tables of a page: of each its lines, by the names of the columns."""
    drawn = [x.proto.body for x in test.get("html") if x.proto.body.startswith("<table")]
    return [list(_table_lines(ElementTree.fromstring(body))) for body in drawn]


def _table_lines(table: ElementTree.Element) -> Iterator[dict[str, str]]:
    names = [cell.text or "" for cell in table.iter("th")]
    for line in table.findall("tbody/tr"):
        yield dict(zip(names, [cell.text or "" for cell in line], strict=True))


def keys(test: AppTest) -> list[str]:
    """The keys of the fruit in the list."""
    return [line["key"] for line in _lines(test)]


def _lines(test: AppTest) -> list[dict[str, Any]]:
    [drawn] = [x for x in test.get("bidi_component") if "fruitlist" in x.proto.component_name]
    lines: list[dict[str, Any]] = json.loads(drawn.proto.json)["fruit"]
    return lines


def classes(test: AppTest) -> set[str]:
    return {re.split(r" \(|: ", says[1])[0] for says in listed(test)}


def wait_for_jobs() -> None:
    for job in resources.worker().unfinished():
        assert job.wait(600)


def tap(test: AppTest, label: str) -> None:
    next(button for button in test.button if button.label == label).click().run()
    assert not test.exception
    wait_for_jobs()


def field(test: AppTest, kind: str, label: str) -> Any:
    return [one for one in getattr(test, kind) if one.label == label][-1]
