from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from cucumbervision.measurement.result import LengthDefinition
from cucumbervision_lab.benchmark.records import readings_frame

pytest.importorskip("matplotlib")

from cucumbervision_lab.benchmark import report

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray
    from tests.lab.benchmark.conftest import MakeRecord

# Three hues that no other of these methods, nor text or grid, has.
COLOURS = {"M6": (0xD5, 0x5E, 0x00), "M5": (0x00, 0x72, 0xB2), "M1": (0xE6, 0x9F, 0x00)}


def picture(png: bytes) -> NDArray[np.uint8]:
    assert png.startswith(b"\x89PNG")
    found = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert found is not None
    return np.asarray(found[..., ::-1], np.uint8)


def pixels(png: bytes, method: str) -> NDArray[np.intp]:
    """Rows and columns of a method's hue, which blending with white leaves as it is."""
    wanted = _hue(np.array([[COLOURS[method]]], np.uint8))[0][0, 0]
    hue, saturation = _hue(picture(png))
    away = np.abs(hue - wanted)
    found = (np.minimum(away, 360 - away) < 4) & (saturation > 0.3)
    # Single pixels are edges where a marker meets a black line.
    return np.argwhere(
        cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    )


def _hue(rgb: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    hsv = cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2HSV)
    return np.asarray(hsv[..., 0]), np.asarray(hsv[..., 1])


@pytest.fixture
def readings(make_record: MakeRecord) -> pd.DataFrame:
    # M6 is right; M5 reads a tenth of the truth at tilts beyond 30 degrees; M1 refuses.
    records = [
        make_record(
            f"c{k}",
            tilt_deg=10.0 * k,
            hidden_share=0.1 * k,
            centreline_m=0.1 + 0.02 * k,
            lengths_m={
                "M1": None,
                "M5": (0.1 + 0.02 * k) * (0.1 if k > 3 else 0.999),
                "M6": 0.1 + 0.02 * k,
            },
        )
        for k in range(7)
    ]
    return readings_frame(records)


def test_each_method_has_a_panel_of_its_own(readings: pd.DataFrame) -> None:
    png = report.predicted_against_truth(readings, LengthDefinition.CENTRELINE)
    columns = {method: pixels(png, method)[:, 1] for method in COLOURS}
    assert columns["M1"].max() < columns["M5"].min()
    assert columns["M5"].max() < columns["M6"].min()


def test_what_was_refused_stands_on_the_bottom_line(readings: pd.DataFrame) -> None:
    png = report.predicted_against_truth(readings, LengthDefinition.CENTRELINE)
    m1, m6 = pixels(png, "M1"), pixels(png, "M6")
    assert np.ptp(m1[:, 0]) < 20  # one marker high
    assert m1[:, 0].min() > m6[:, 0].max()


def test_every_drawn_method_has_its_own_look() -> None:
    looks = [(colour, marker) for colour, marker, _ in report.STYLES.values()]
    assert len(set(looks)) == len(looks)
