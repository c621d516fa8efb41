"""A round measured again: a new version of it, and what people decided that stays."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cucumbervision.capture.source import example_captures
from cucumbervision.methods.result import LengthDefinition, MethodName
from cucumbervision.run.measurer import CaptureResult, Measurer
from cucumbervision.run.options import MeasureOptions
from cucumbervision_greenhouse.rounds.adding import add_captures, measure_round_again
from cucumbervision_greenhouse.rounds.fruit_table import find_round
from cucumbervision_greenhouse.store.check import check_store
from cucumbervision_greenhouse.store.records import FruitRow, Verdict, key_of
from cucumbervision_greenhouse.store.repository import Store

MORNING = key_of("rounds", "morning")
OPTIONS = MeasureOptions(instances="dataset", methods=(MethodName.M3, MethodName.M6))
CHORD = replace(OPTIONS, length=LengthDefinition.CHORD)


def measured_again(store: Store, options: MeasureOptions) -> list[FruitRow]:
    key, failures = measure_round_again(store, find_round(store, MORNING), options)
    assert failures == []
    return store.detections(key)


def test_a_round_is_measured_into_a_new_version_and_the_old_stays_readable(store: Store) -> None:
    add_captures(store, MORNING, [example_captures() / "simulated-row-a"], OPTIONS)
    before = store.detections(MORNING)
    after = measured_again(store, CHORD)
    assert [view.length and str(view.length.kind) for view in after] == ["chord"] * 3
    assert [view.chord_m for view in after] == pytest.approx(
        [view.chord_m for view in before], abs=1e-4
    )
    assert [view.along_m for view in after] == pytest.approx(
        [view.along_m for view in before], abs=1e-3
    )
    [old] = [walk for walk in store.rounds(deleted=True) if walk.key == MORNING]
    [new] = [walk for walk in store.rounds() if walk.key == after[0].round_key]
    assert (new.name, new.walked_s) == (old.name, old.walked_s)
    assert check_store(store).sound
    store.restore_round(MORNING)
    assert store.detections(MORNING) == before


def test_decisions_by_hand_go_with_their_fruit(store: Store) -> None:
    add_captures(store, MORNING, [example_captures() / "simulated-row-a"], OPTIONS)
    accepted, rejected, picked = (view.key for view in store.detections(MORNING))
    store.set_verdict([accepted], Verdict.ACCEPTED)
    store.set_verdict([rejected], Verdict.REJECTED)
    store.pick([picked], at_s=5.0)
    found = [(view.verdict, view.picked_s) for view in measured_again(store, CHORD)]
    assert found == [(Verdict.ACCEPTED, None), (Verdict.REJECTED, None), (None, 5.0)]


def test_a_fruit_that_is_not_found_again_is_measured_in_its_outline(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    add_captures(store, MORNING, [example_captures() / "simulated-row-a"], OPTIONS)
    before = {round(view.box_x1_px): view for view in store.detections(MORNING)}
    [left, *_] = (before[x] for x in sorted(before))
    store.set_verdict([left.key], Verdict.ACCEPTED)
    find = Measurer.measure_detected

    def without_the_left(measurer: Measurer, *detected: Any) -> CaptureResult:
        result = find(measurer, *detected)
        edges = np.array([fruit.instance.box[0] for fruit in result.fruit])
        kept = [fruit for fruit, x in zip(result.fruit, edges, strict=True) if x > edges.min()]
        return replace(result, fruit=tuple(kept))

    monkeypatch.setattr(Measurer, "measure_detected", without_the_left)
    after = measured_again(store, OPTIONS)
    [again] = [view for view in after if view.verdict is Verdict.ACCEPTED]
    assert (len(after), again.fruit) == (3, 3)
    assert again.length_m == pytest.approx(left.length_m, abs=1e-4)


def test_nothing_changes_where_a_picture_is_missing(store: Store) -> None:
    add_captures(store, MORNING, [example_captures() / "simulated-row-a"], OPTIONS)
    [stop] = store.stops(MORNING)
    depth = store.stop(stop.key).captures[0].depth
    assert depth is not None
    store.images.path(depth).unlink()
    key, [failure] = measure_round_again(store, find_round(store, MORNING), CHORD)
    assert (key, failure.error) == (MORNING, "StoredImageError")
    assert [walk.key for walk in store.rounds() if walk.fruit] == [MORNING]
