from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("streamlit")


from tests.greenhouse.dashboard.app_pages import (
    WALK,
    app,
    said,
    tap,
)

from cucumbervision.calibration.calibration_file import read_site_calibration
from cucumbervision.measurement.result import LengthDefinition
from cucumbervision_greenhouse.backend import resources
from cucumbervision_greenhouse.backend.hand_lengths import hand_file, write_hand_lengths
from cucumbervision_greenhouse.store.repository import open_store

pytestmark = pytest.mark.usefixtures("fresh_caches")


def test_a_calibration_is_made_used_and_put_back_on_the_page(house: Path) -> None:
    with open_store(house) as store:
        fruit = store.detections(WALK)
    lengths = {view.key: (1.1 * (view.record.length_m or 0.0), None) for view in fruit}
    write_hand_lengths(hand_file(str(house), WALK), fruit, lengths, LengthDefinition.CENTRELINE)
    test = app("accuracy", round=WALK)
    assert "too short on average" in said(test)
    tap(test, "Calibrate with these lengths")
    assert not test.exception
    assert "Lengths change by +10.0 %" in said(test)
    tap(test, "Use it now")
    chosen = resources.settings().calibration
    assert read_site_calibration(Path(chosen)).name == "my house"
    assert "In use: my house" in said(test)
    tap(app("settings"), "Use none")
    assert resources.settings().calibration == ""
