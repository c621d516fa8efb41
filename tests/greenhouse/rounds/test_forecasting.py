from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import datetime

import pytest

from cucumbervision_greenhouse.rounds.forecasting import age_of, midnight_s


@pytest.fixture
def in_amsterdam(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    if not hasattr(time, "tzset"):
        pytest.skip("the time zone cannot be set here")
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "Europe/Amsterdam")
        time.tzset()
        yield
    time.tzset()


@pytest.mark.usefixtures("in_amsterdam")
@pytest.mark.parametrize("day", [datetime(2026, 3, 29), datetime(2026, 10, 25)])
def test_the_day_on_which_the_clocks_change_begins_at_its_midnight(day: datetime) -> None:
    for hour in (1, 4, 12, 23):
        now_s = day.replace(hour=hour).timestamp()
        assert midnight_s(now_s) == day.timestamp()
        assert age_of(day.replace(day=day.day - 1, hour=23).timestamp(), now_s)[0] == 1
