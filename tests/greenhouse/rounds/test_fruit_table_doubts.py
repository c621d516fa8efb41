from __future__ import annotations

from cucumbervision.methods.result import Length
from cucumbervision_greenhouse.rounds.fruit_table import round_doubts
from cucumbervision_greenhouse.store.records import (
    CaptureRecord,
    FruitRow,
    StopRecord,
    Verdict,
    key_of,
)
from cucumbervision_greenhouse.store.repository import Store

MORNING = key_of("rounds", "morning")


def walked(store: Store, *fruit: FruitRow) -> list[str]:
    """Save a stop with these fruit, and return what is doubtful in its round."""
    numbered = tuple(one.with_(fruit=number) for number, one in enumerate(fruit, 1))
    capture = CaptureRecord("a", width_px=64, height_px=48, fruit=numbered)
    store.save_stop(StopRecord(key_of("stop"), MORNING, captures=(capture,)))
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
