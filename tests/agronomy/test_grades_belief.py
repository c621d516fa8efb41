from __future__ import annotations

import numpy as np
import pytest

from cucumbervision.agronomy.grades import LengthBelief
from cucumbervision.errors import ForecastError


def test_ends_and_median_are_the_intervals_quantiles() -> None:
    belief = LengthBelief.from_interval(0.25, 0.24, 0.28)
    np.testing.assert_allclose(belief.below([0.24, 0.25, 0.28]), [0.05, 0.5, 0.95], atol=1e-12)
    other = LengthBelief.from_interval(0.25, 0.24, 0.28, level=0.8)
    np.testing.assert_allclose(other.below([0.24, 0.25, 0.28]), [0.1, 0.5, 0.9], atol=1e-12)


def test_length_outside_its_interval_gives_the_geometric_middle() -> None:
    belief = LengthBelief.from_interval(0.20, 0.225, 0.256)
    assert belief.median_m == pytest.approx(0.24)
    assert belief.low_sd == pytest.approx(belief.high_sd)


def test_standard_deviation_of_a_symmetric_interval() -> None:
    belief = LengthBelief.from_interval(0.25, 0.25 / 1.02, 0.25 * 1.02)
    assert belief.sd_m == pytest.approx(0.25 * np.log(1.02) / 1.6449, rel=1e-4)


def test_side_without_width_is_a_step() -> None:
    belief = LengthBelief.from_interval(0.25, 0.25, 0.26)
    np.testing.assert_allclose(belief.below([0.2499, 0.25, 0.26]), [0.0, 0.5, 0.95], atol=1e-12)
    exact = LengthBelief.from_interval(0.25, 0.25, 0.25)
    assert exact.below([0.2499, 0.25, 0.2501]).tolist() == [0.0, 0.0, 1.0]


@pytest.mark.parametrize("interval", [(0.26, 0.24), (-0.1, 0.2), (0.1, float("nan"))])
def test_no_interval_is_refused(interval: tuple[float, float]) -> None:
    with pytest.raises(ForecastError, match="the lower end first"):
        LengthBelief.from_interval(0.25, *interval)
