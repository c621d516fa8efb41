from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from cucumbervision.methods.result import FruitPose
from cucumbervision_lab.evaluate.measure_case import Masks
from cucumbervision_lab.evaluate.report import pose_table
from cucumbervision_lab.evaluate.scenes import pose_errors

TRUE = np.stack([np.zeros(41), np.linspace(0.1, -0.1, 41), np.full(41, 0.5)], axis=1)  # stem up


def pose(stem: tuple[float, float, float], blossom: tuple[float, float, float]) -> FruitPose:
    axis = np.linspace(stem, blossom, 33)
    out = (axis[0] - axis[-1]) / np.linalg.norm(axis[0] - axis[-1])
    cut = axis[0] + 0.02 * out
    return FruitPose(
        frame="camera",
        stem_m=axis[0],
        blossom_m=axis[-1],
        stem_confidence=0.9,
        centre_m=axis[16],
        axis_m=axis,
        radius_m=np.full(33, 0.02),
        direction=out,
        cut_m=cut,
        cut_covariance_m2=0.004**2 * np.eye(3),
        covered=(),
    )


def test_errors_of_a_pose_that_is_off_by_known_amounts() -> None:
    # 3 mm along and 4 mm to the side: 5 mm. The place to cut is 5 mm off too: 1.6 in units of
    # its variance, of which 6.25 hold 90 %.
    found = pose_errors(pose((0.004, -0.103, 0.5), (0.004, 0.1, 0.5)), TRUE)
    assert found["stem_mm"] == pytest.approx(5.0)
    assert found["stem_deg"] == pytest.approx(0.0, abs=1e-4)
    assert found["cut_in_90"]
    leans = pose((0.0, -0.1, 0.5), (0.02, 0.1, 0.5))
    assert pose_errors(leans, TRUE)["stem_deg"] == pytest.approx(np.degrees(np.arctan(0.1)))
    far = pose_errors(pose((0.0, -0.115, 0.5), (0.0, 0.1, 0.5)), TRUE)
    assert not far["cut_in_90"]


def test_swapped_ends_have_no_distance_and_are_counted() -> None:
    swapped = pose_errors(pose((0.0, 0.1, 0.5), (0.0, -0.1, 0.5)), TRUE)
    assert swapped["swapped"]
    assert swapped["whole"]
    assert "stem_mm" not in swapped
    right = pose_errors(pose((0.0, -0.103, 0.5), (0.0, 0.1, 0.5)), TRUE)
    rows = [
        {"case": str(k), "masks": Masks.PERCEIVED, "distance_m": 0.5, **one}
        for k, one in enumerate([swapped, right, right, right])
    ]
    table = pose_table(pd.DataFrame(rows))
    line = dict(zip(table.heads, table.rows[0], strict=True))
    assert (line["fruit"], line["n"], line["swapped (%)"]) == ("perceived", 4, 25.0)
    assert line["stem end median (mm)"] == pytest.approx(3.0)


def test_rows_of_gravity_count_fruit_whose_captures_know_it() -> None:
    right = pose_errors(pose((0.0, -0.103, 0.5), (0.0, 0.1, 0.5)), TRUE)
    swapped = pose_errors(pose((0.0, 0.1, 0.5), (0.0, -0.1, 0.5)), TRUE)
    hangs = {"hangs": True, "swapped_by_gravity": False}
    lies = {"hangs": False, "swapped_by_gravity": True}
    seen = [
        {**swapped, **hangs, "distance_m": 0.5},  # which gravity puts right
        {**right, **hangs, "distance_m": 0.9},
        {**swapped, **lies, "distance_m": 0.5},  # of which it says nothing
        {**right, "distance_m": 0.5},  # gravity is not known
    ]
    rows = [{"case": str(k), "masks": Masks.PERCEIVED, **one} for k, one in enumerate(seen)]
    table = pose_table(pd.DataFrame(rows))
    assert [(fruit, n, round(float(str(swaps)), 1)) for fruit, n, swaps, *_ in table.rows[-2:]] == [
        ("perceived, hanging, any distance", 2, 50.0),
        ("the same, gravity known", 2, 0.0),
    ]
