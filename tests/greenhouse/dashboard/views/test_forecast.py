from __future__ import annotations

import time
from pathlib import Path

import pytest

pytest.importorskip("streamlit")


from tests.greenhouse.dashboard.app_pages import app, said

pytestmark = pytest.mark.usefixtures("fresh_caches")


def test_the_forecast_names_days_by_their_dates(house: Path) -> None:
    test = app("forecast")
    days = list(test.table[0].value.iloc[:, 0])
    in_two_days = time.localtime(time.time() + 2 * 86400)
    assert days[:3] == ["today", "tomorrow", time.strftime("%a %-d %b", in_two_days)]
    # Some of the eight bundled fruit are class I as they were measured.
    assert "class I today" in said(test)
