from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cucumbervision.fruit.crops import END_PX, PLANES, EndCrop, EndLook
from cucumbervision.fruit.mask_codes import Rle
from cucumbervision.methods.intervals import LOOKED, PERCEIVED, look_features
from cucumbervision_lab.train.end_crops import END_CROP, MeasuredFruit
from cucumbervision_lab.train.end_look import SMALLEST_GROUP, fit_look_intervals, looked_fruit
from cucumbervision_lab.train.fruit_crops import crops_of

TRUE = EndLook(0.98, 0.01, 0.01, (-0.01, -0.004, 0.0, 0.004, 0.01), 0.5)
COVERED = EndLook(0.1, 0.89, 0.01, (0.0, 0.1, 0.2, 0.3, 0.5), 0.5)
M6 = "M6" + PERCEIVED + LOOKED


def fruit(number: int, share: float, *, given: bool = False, **features: float) -> MeasuredFruit:
    """A fruit of 20 cm of which a share was measured."""
    known = {"perceived": 1.0, "closed": 0.9, "distance_m": 0.5}
    return MeasuredFruit(
        picture=f"{number // 3}.jpg",
        given=given,
        mask=Rle.of(np.ones((2, 2), bool)),
        axis_m=((0.0, 0.0, 0.5), (share * 0.2, 0.0, 0.5)),
        diameter_m=0.04,
        lengths_m=(0.2 * share, 0.2 * share, 0.19 * share),
        true_m=(0.2, 0.2, 0.19),
        missing_m=(0.0, 0.0),
        stem_first=True,
        features={**known, **features},
    )


@pytest.fixture(scope="module")
def learnt() -> tuple[list[MeasuredFruit], list[tuple[EndLook, EndLook]]]:
    """Twelve hundred fruit: two thirds within 1 %, the others short by 0 to 50 % and told so."""
    rng = np.random.default_rng(0)
    short = np.arange(1200) % 3 == 0
    share = np.where(short, rng.uniform(0.5, 1.0, 1200), np.exp(rng.normal(0, 0.01, 1200)))
    looks = [(TRUE, COVERED) if one else (TRUE, TRUE) for one in short]
    return [fruit(k, float(one)) for k, one in enumerate(share)], looks


def test_fruit_are_grouped_by_the_look_and_each_group_holds(
    learnt: tuple[list[MeasuredFruit], list[tuple[EndLook, EndLook]]],
) -> None:
    models = fit_look_intervals(*learnt)
    assert set(models) == {f"{key}{PERCEIVED}{LOOKED}" for key in ("M6", "M6 thread", "M6 chord")}
    model = models[M6]
    assert all(band.count >= SMALLEST_GROUP for band in model.bands.values())
    for pair in ((TRUE, TRUE), (TRUE, COVERED)):
        own = [one for one, look in zip(*learnt, strict=True) if look == pair]
        low, high = model.interval(1.0, look_features(pair))
        held = [low <= 0.2 / one.lengths_m[0] <= high for one in own]
        assert 0.87 <= np.mean(held) <= 0.94
        width = high - low
        # 90 % of a normal distribution of 1 %, or of 1 to 2 times the length.
        expected = 2 * 1.645 * 0.01 if pair == (TRUE, TRUE) else 1 / 0.525 - 1 / 0.975
        assert width == pytest.approx(expected, rel=0.2)


def test_fruit_far_away_have_quantiles_of_their_own(
    learnt: tuple[list[MeasuredFruit], list[tuple[EndLook, EndLook]]],
) -> None:
    rng = np.random.default_rng(1)
    far = [fruit(6000 + k, float(np.exp(rng.normal(0, 0.04))), distance_m=1.5) for k in range(600)]
    model = fit_look_intervals([*learnt[0], *far], [*learnt[1], *[(TRUE, TRUE)] * 600])[M6]
    seen = look_features((TRUE, TRUE))
    near, away = (model.interval(1.0, {**seen, "distance_m": z}) for z in (0.5, 1.5))
    assert near[1] - near[0] == pytest.approx(2 * 1.645 * 0.01, rel=0.2)
    assert away[1] - away[0] == pytest.approx(2 * 1.645 * 0.04, rel=0.2)


def test_cut_fruit_given_masks_and_wrong_depth_teach_nothing(
    learnt: tuple[list[MeasuredFruit], list[tuple[EndLook, EndLook]]],
) -> None:
    wrong = [
        fruit(5000, 0.01, given=True),
        fruit(5001, 0.01, cut=1.0),
        fruit(5002, 0.01, no_depth=1.0),
    ] * 300
    looks = [(TRUE, TRUE)] * len(wrong)
    plain = fit_look_intervals(*learnt)
    assert fit_look_intervals([*learnt[0], *wrong], [*learnt[1], *looks]) == plain


def test_only_held_out_fruit_on_networks_masks_are_looked_at() -> None:
    fruits = [fruit(0, 1.0), fruit(1, 1.0, given=True), fruit(2, 1.0), fruit(3, 1.0)]
    rows = [
        (
            np.full((END_PX, END_PX, PLANES), k, np.uint8),
            (0, 0),
            np.nan,
            np.nan,
            k // 2,
            False,
            k // 2 != 2,
        )
        for k in range(8)
    ]
    crops = crops_of(rows, END_CROP)

    def look(some: list[EndCrop]) -> list[EndLook]:
        return [replace(TRUE, stem=float(one.planes[0, 0, 0])) for one in some]

    chosen, looks = looked_fruit(fruits, crops, look)  # type: ignore[arg-type]
    assert [one.picture for one in chosen] == [fruits[0].picture, fruits[3].picture]
    assert [(a.stem, b.stem) for a, b in looks] == [(0.0, 1.0), (6.0, 7.0)]
