"""A week that is ended early goes on in its folder, and another's folder is refused."""

from __future__ import annotations

import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tests.robustness import week
from tests.robustness.trial import Ran


def test_a_week_that_was_ended_goes_on_after_the_command_that_ran(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def begin(*words: object, **_: Any) -> Any:
        asked.append(" ".join(map(str, words[:2] if words[0] == "round" else words[:1])))
        return SimpleNamespace(kill=lambda: None)

    monkeypatch.setattr(week, "begin", begin)
    monkeypatch.setattr(week, "ended", lambda _: Ran(0, ""))
    stop = threading.Event()
    stop.set()
    for done in (["stream"], ["stream", "measure"]):
        faults, counts = week.live(tmp_path, 2, 1, 1, stop)
        assert asked == done
        assert (faults, counts["inputs"]) == ([], 0)
    stop.clear()
    faults, counts = week.live(tmp_path, 2, 1, 1, stop)
    assert asked[:5] == ["stream", "measure", "round new", "round add", "export"]
    assert len(asked) == 5 + 5 + 4 * week.KILLS + 2  # both weeks, the kills, a check of each
    assert (faults, counts["inputs"]) == ([], 2)
    with pytest.raises(SystemExit, match="holds another week"):
        week.live(tmp_path, 3, 1, 1, stop)


def test_what_the_weeks_do_not_have_in_common_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(week, "begin", lambda *_: None)
    monkeypatch.setattr(week, "ended", lambda _: Ran(0, ""))
    weeks = [week.Week(tmp_path / name) for name in ("calm", "disturbed")]
    for one, length in zip(weeks, ("20.1", "20.2"), strict=True):
        (one.folder / "a.csv").write_text(f"source,length_cm\n{one.folder},{length}\n")
    (weeks[1].folder / "stream-0.jsonl").write_text('{"capture": "a", "latency_s": 1.0}\n')
    first, second = week.differences(*weeks)
    assert first == "stream-0.jsonl is in one week only"
    assert 'first difference [{"length_cm": "20.1"}, {"length_cm": "20.2"}]' in second
