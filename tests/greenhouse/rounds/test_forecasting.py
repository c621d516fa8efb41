from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta

import pytest

from cucumbervision_greenhouse.rounds.forecasting import age_of, date_after, day_0_s, midnight_s
from cucumbervision_greenhouse.store.records import Round


@pytest.fixture
def in_amsterdam(in_zone: Callable[[str], None]) -> None:
    in_zone("Europe/Amsterdam")


@pytest.mark.usefixtures("in_amsterdam")
@pytest.mark.parametrize("day", [datetime(2026, 3, 29), datetime(2026, 10, 25)])
def test_the_day_on_which_the_clocks_change_begins_at_its_midnight(day: datetime) -> None:
    for hour in (1, 4, 12, 23):
        now_s = day.replace(hour=hour).timestamp()
        assert midnight_s(now_s) == day.timestamp()
        assert age_of(day.replace(day=day.day - 1, hour=23).timestamp(), now_s)[0] == 1


@pytest.mark.usefixtures("in_amsterdam")
@pytest.mark.parametrize("hour", [0, 2, 12, 23])
@pytest.mark.parametrize("changes", [datetime(2026, 3, 29), datetime(2026, 10, 25)])
def test_each_day_of_a_forecast_has_its_date_when_the_clocks_change(
    changes: datetime, hour: int
) -> None:
    walked = (changes - timedelta(1)).replace(hour=hour, minute=20)
    walk = Round("a", started_s=walked.timestamp())
    for later in range(3):
        now_s = (walked + timedelta(later)).timestamp()
        day_0 = day_0_s(walk, now_s)
        dates = [date_after(day_0, day) for day in range(3)]
        assert dates == [walked.date() + timedelta(later + day) for day in range(3)]


@pytest.mark.parametrize("digit", range(10))
def test_day_0_is_never_before_the_last_stop(digit: int) -> None:
    """Clocks count finer than microseconds; a fruit measured after day 0 has no forecast."""
    walked_s = 1_700_000_000.0 + 2.4e-7 * digit
    walk = Round("a", started_s=walked_s)
    assert day_0_s(walk, walked_s + 60.0) == walked_s
