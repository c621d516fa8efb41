from __future__ import annotations

from email.message import Message

import pytest

from cucumbervision import about


@pytest.mark.parametrize(
    ("urls", "offer"),
    [
        (["Homepage, https://a", "Source, https://b/c"], "https://b/c"),
        (["Homepage, https://a"], "this installation names no address of its source"),
        ([], "this installation names no address of its source"),
    ],
)
def test_the_source_is_the_one_of_the_packages_metadata(
    urls: list[str], offer: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    message = Message()
    for url in urls:
        message["Project-URL"] = url
    monkeypatch.setattr(about, "metadata", lambda name: message)
    monkeypatch.delenv("CUCUMBERVISION_SOURCE", raising=False)
    assert about.source_offer().startswith(offer)


def test_one_line_of_the_environment_names_the_source(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUCUMBERVISION_SOURCE", " https://git.example/ours ")
    assert about.source_offer() == "https://git.example/ours"
