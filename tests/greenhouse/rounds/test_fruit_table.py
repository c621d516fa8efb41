from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from cucumbervision.crop.profiles import load_profile
from cucumbervision.methods.result import Length
from cucumbervision_greenhouse.rounds.forecasting import fruit_states
from cucumbervision_greenhouse.rounds.fruit_table import (
    fruit_table,
    least_sure_first,
    read_round,
    round_doubts,
    round_figures,
)
from cucumbervision_greenhouse.rounds.merge_and_link import DAY_S
from cucumbervision_greenhouse.store.records import (
    CaptureRecord,
    FruitRow,
    Round,
    StopRecord,
    Verdict,
    key_of,
)
from cucumbervision_greenhouse.store.repository import Store, open_store

MONDAY = Round(key_of("monday"), "monday", "north", 1_700_000_000.0)
TUESDAY = replace(MONDAY, key=key_of("tuesday"), name="tuesday", started_s=1_700_000_000.0 + DAY_S)


def stop(round_key: str, number: int, offsets: tuple[float, ...]) -> StopRecord:
    fruit = tuple(
        FruitRow(
            n,
            score=0.3 + 0.1 * n,
            length=Length(0.2),
            centre_x_m=x,
            centre_y_m=0.0,
            centre_z_m=0.7,
            offset_m=x,
            view_score=0.5,
        )
        for n, x in enumerate(offsets, 1)
    )
    return StopRecord(
        "3",
        "right",
        0.4 * number,
        number,
        key_of(round_key, number),
        round_key,
        taken_s=float(number),
        captures=(CaptureRecord("a", fruit=fruit),),
    )


@pytest.fixture
def store(tmp_path: Path) -> Store:
    opened = open_store(tmp_path / "house.db")
    for one in (MONDAY, TUESDAY):
        opened.save_round(one)
        opened.save_stop(stop(one.key, 0, (0.0, 0.3)))
        opened.save_stop(stop(one.key, 1, (-0.1, 0.9)))
    return opened


def test_the_least_sure_are_looked_at_first_until_somebody_judged_them(store: Store) -> None:
    views = store.detections(MONDAY.key)
    assert [round(v.score, 1) for v in least_sure_first(views)] == [0.4, 0.4, 0.5, 0.5]
    store.set_verdict([views[0].key], Verdict.ACCEPTED)
    assert len(least_sure_first(store.detections(MONDAY.key))) == 3


def test_unknown_lengths_count_in_no_figure_of_a_round_nor_its_forecast(tmp_path: Path) -> None:
    """Of 0.30, 0.32, 0.60 (outline and depth apart) and 0.10 m (in part), the first two count."""
    flagged = {0.30: "", 0.32: "", 0.60: "depth-unaligned", 0.10: "end-hidden"}
    fruit = tuple(
        FruitRow(n, score=0.9, length=Length(length_m), centreline_m=length_m, flags=flags)
        for n, (length_m, flags) in enumerate(flagged.items(), 1)
    )
    with open_store(tmp_path / "figures.db") as opened:
        opened.save_round(MONDAY)
        captures = (CaptureRecord("a", fruit=fruit),)
        opened.save_stop(
            StopRecord("1", key=key_of("stop"), round_key=MONDAY.key, captures=captures)
        )
        content = read_round(opened, MONDAY.key)
    table = fruit_table(content)
    figures = round_figures(content, table)
    assert (figures["fruit"], figures["measured"]) == (4, 4)
    assert (figures["shortest_m"], figures["longest_m"]) == (0.30, 0.32)
    assert figures["mean_m"] == pytest.approx(0.31)
    states = fruit_states(table, 0.0, load_profile("long-cucumber"))
    lengths = [(state.length_m, state.at_least) for state in states]
    assert sorted(lengths) == [(0.0, True), (0.10, True), (0.30, False), (0.32, False)]


MORNING = key_of("rounds", "morning")


def walked(store: Store, *fruit: FruitRow) -> list[str]:
    """Save a stop with these fruit, and return what is doubtful in its round."""
    numbered = tuple(one.with_(fruit=number) for number, one in enumerate(fruit, 1))
    capture = CaptureRecord("a", width_px=64, height_px=48, fruit=numbered)
    store.save_round(Round(MORNING))
    store.save_stop(StopRecord(key=key_of("stop"), round_key=MORNING, captures=(capture,)))
    return round_doubts(store.detections(MORNING))


SOUND = FruitRow(1, method="M6", reason="ok", length=Length(0.2), m6_m=0.2)


def test_a_round_says_once_what_its_data_makes_doubtful(store: Store) -> None:
    hollow = SOUND.with_(flags="ends-unsure depth-hollow")
    (line,) = walked(store, SOUND, hollow, hollow)
    assert line.startswith("2 of 3 fruit: the depth of their middle lies behind that of their")
    assert "check that" in line
    keys = [view.key for view in store.detections(MORNING)]
    store.set_verdict(keys[1:2], Verdict.REJECTED)
    (line,) = round_doubts(store.detections(MORNING))
    assert line.startswith("1 of 2 fruit")
    store.set_verdict(keys[2:], Verdict.REJECTED)
    assert round_doubts(store.detections(MORNING)) == []


def test_fruit_of_impossible_sizes_name_the_unit_that_would_explain_them(store: Store) -> None:
    refused = SOUND.with_(length=None, method=None, reason="implausible-length", m6_m=None)
    lines = walked(store, refused.with_(m3_m=1.3, m6_m=1.6), refused)
    assert lines == [
        "no fruit has a possible size (median 160 cm): is one step of depth really 1 mm? "
        "--depth-unit 0.0001, 0.0002 or 0.00025 would explain it"
    ]
