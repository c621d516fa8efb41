"""The tables of a round, against what is in the store."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from tests.greenhouse.exports.conftest import CONFIG, MODEL, SITE, WALK

from cucumbervision.crop.profiles import load_profile
from cucumbervision.errors import CucumberVisionError
from cucumbervision.run.fields import FIELDS
from cucumbervision_greenhouse.exports.build import COLUMNS, RoundTables, round_tables
from cucumbervision_greenhouse.store.records import FruitRow, key_of
from cucumbervision_greenhouse.store.repository import Store


def test_the_tables_say_what_is_in_the_store(tables: RoundTables) -> None:
    summary = tables.summary
    assert (summary["stops"], summary["captures"], summary["detections"]) == (8, 8, 15)
    assert (summary["fruit"], summary["measured"], summary["picked"]) == (15, 14, 1)
    assert (summary["failures"], summary["rows"]) == (1, 2)
    records = tables["fruit"]
    # The second row in numbers, not in letters: 3 before 10.
    assert [line["row"] for line in records] == ["3"] * 9 + ["10"] * 6
    first = records[0]
    assert first["length_cm"] == 18.0
    assert first["chord_cm"] == 16.2
    assert (first["m1_cm"], first["m6_cm"], first["m2_cm"]) == (20.0, 18.0, None)
    assert first["volume_ml"] == 330.0
    assert first["mass_g"] == 316.8  # 330 ml at 960 kg per cubic metre
    assert (first["grade"], first["grade_words"]) == ("too short", "too short")
    assert records[1]["length_cm"] is None
    assert (records[1]["grade"], records[1]["grade_verdict"]) == ("not measured", "missing")
    assert (first["config_sha256"], first["models_sha256"]) == (CONFIG, MODEL)
    assert first["calibration_sha256"] is None
    assert records[2]["calibration_sha256"] == SITE


def test_the_summary_is_the_fruits(tables: RoundTables) -> None:
    hanging = [
        float(str(line["length_cm"]))
        for line in tables["fruit"]
        if line["length_cm"] is not None and line["picked_utc"] is None
    ]
    assert tables.summary["mean_length_cm"] == pytest.approx(np.mean(hanging), abs=1e-3)
    assert tables.summary["sd_length_cm"] == pytest.approx(np.std(hanging, ddof=1), abs=1e-3)
    assert sum(count for *_, count in tables.bins) == len(hanging)


def test_the_forecast_adds_up(tables: RoundTables) -> None:
    lines = tables["forecast"]
    assert len(lines) == 3 * 8 * 4  # house and two rows, today and seven days, four outcomes
    for day in range(8):
        of_day = [line for line in lines if line["day"] == day]
        house = sum(float(str(x["expected"])) for x in of_day if x["scope"] == "house")
        rows = sum(float(str(x["expected"])) for x in of_day if x["scope"] == "row")
        # 14 hang, 13 of them measured.
        assert house == pytest.approx(14, abs=0.01)
        assert rows == pytest.approx(house, abs=0.02)
    # Of 13 one has 0.95 * 26 cm, give or take 3 %.
    hanging = [x for x in tables["fruit"] if x["picked_utc"] is None]
    grades = Counter(x["grade"] for x in hanging)
    assert (grades["undecided"], grades["not measured"]) == (1, 1)
    ready = sum(float(str(x["ready_today"])) for x in hanging)
    assert grades["I"] - 1 < ready < grades["I"] + 2
    [first] = [x for x in lines if (x["day"], x["scope"], x["class"]) == (0, "house", "I")]
    assert first["expected"] == pytest.approx(ready, abs=0.01)
    picks = [line for line in tables["picks"] if line["kind"] == "ready"]
    assert len(picks) == grades["I"]
    assert tables.summary["ready_today"] == tables["work"][0]["fruit"]
    assert tables.summary["ready_today"] == pytest.approx(ready, abs=0.01)
    assert tables.summary["surely_ready"] == len(picks)
    assert [line["order"] for line in tables["picks"]] == list(range(1, len(tables["picks"]) + 1))
    numbers = {line["number"] for line in tables["fruit"] if line["picked_utc"] is None}
    assert {line["number"] for line in tables["picks"]} <= numbers


def test_a_round_that_is_not_there_is_named(store: Store) -> None:
    with pytest.raises(CucumberVisionError, match="no round has the key"):
        round_tables(store, key_of("nothing"))


def test_every_field_that_the_store_keeps_of_a_fruit_is_exported(tables: RoundTables) -> None:
    kept = {"inner_arc_mm", "diameter_mean_mm", "box_x1_px", "mask_source", "raw_length_cm", "fill"}
    columns = {column.name: column for column in COLUMNS["fruit"]}
    for one in FIELDS:
        if hasattr(FruitRow, one.si_name) or one.name in kept:
            assert (columns[one.name].unit, columns[one.name].says) == (one.unit, one.says)
    first = tables["fruit"][0]
    assert (first["inner_arc_mm"], first["diameter_max_mm"], first["score"]) == (4.0, 45.0, 0.9)


def test_the_fruit_begin_with_what_people_read(tables: RoundTables) -> None:
    read = COLUMNS["fruit"][:10]
    assert [column.title for column in read] == [
        *("number", "row", "along [m]", "length [cm]", "at least", "interval low [cm]"),
        *("interval high [cm]", "grade", "remarks", "taken utc"),
    ]
    # 18 cm, give or take 3 %, at 0 m and 10 cm to the right of it; its only flag is 'uncertain'.
    assert [tables["fruit"][0][column.name] for column in read] == [
        *(1, "3", 0.1, 18.0, False, 17.46, 18.54, "too short", "the length is uncertain"),
        "2024-10-04T00:00:00Z",
    ]
    picked = [row["remarks"] for row in tables["fruit"] if row["picked_utc"]]
    assert [str(remark).split(";")[0] for remark in picked] == ["picked"]


def test_days_are_counted_from_the_day_of_the_round(tables: RoundTables) -> None:
    house = [line for line in tables["forecast"] if line["scope"] == "house"]
    assert [line["date_utc"] for line in house[:5:4]] == ["2024-10-04", "2024-10-05"]
    assert tables["work"][0]["date_utc"] == "2024-10-04"


@pytest.mark.parametrize(
    ("zone", "date"), [("Pacific/Auckland", "2024-10-04"), ("America/Bogota", "2024-10-03")]
)
def test_days_have_the_date_of_the_house(
    store: Store, in_zone: Callable[[str], None], zone: str, date: str
) -> None:
    in_zone(zone)
    tables = round_tables(store, WALK.key, load_profile("long-cucumber"))
    assert [tables[name][0]["date"] for name in ("forecast", "work")] == [date, date]
