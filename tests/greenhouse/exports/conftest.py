"""A round of eight stops in a store, and its tables."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.crop.profiles import load_profile
from cucumbervision.methods.result import Length, LengthDefinition
from cucumbervision_greenhouse.exports.build import RoundTables, round_tables
from cucumbervision_greenhouse.store import records
from cucumbervision_greenhouse.store.repository import Store, open_store

EVIL = '=HYPERLINK("https://x")<script>alert(1)</script>'


WALK = records.Round(
    records.key_of("export"), "morning", "house 1", 86400.0 * 20000, "long-cucumber"
)


CONFIG, MODEL, SITE = "c" * 64, "a" * 64, "b" * 64


THREAD = LengthDefinition.THREAD


def fruit(number: int, length_m: float | None) -> records.FruitRow:
    record = records.FruitRow(
        number,
        score=0.9,
        method="M6",
        reason="best",
        flags="uncertain" if number == 1 else "",
        centre_x_m=0.1 * number,
        centre_y_m=0.0,
        centre_z_m=0.5,
        offset_m=0.1 * number,
        offset_sd_m=0.01,
        m1_m=0.2,
        m6_m=length_m,
    )
    if length_m is None:
        return record.with_(method=None, reason="no-tube", flags="")
    return record.with_(
        length=Length(length_m, THREAD, 0.97 * length_m, 1.03 * length_m, THREAD),
        thread_m=length_m,
        chord_m=0.9 * length_m,
        centreline_m=0.95 * length_m,
        inner_arc_m=0.004,
        diameter_max_m=0.045,
        volume_m3=330e-6,
    )


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("house") / "house.db"


@pytest.fixture(scope="module")
def store(house: Path) -> Iterator[Store]:
    """A round of eight stops; one fruit is not measured, one picked, one rejected."""
    with open_store(house) as opened:
        opened.save_round(WALK)
        for step in range(8):
            thumbnail = opened.images.put_thumbnail(np.full((48, 64, 3), 20 * step, np.uint8))
            lengths = [0.18 + 0.02 * step, 0.31 if step else None]
            found = tuple(fruit(k, length) for k, length in enumerate(lengths, 1))
            opened.save_stop(
                records.StopRecord(
                    key=records.key_of("export", step),
                    round_key=WALK.key,
                    row="3" if step < 5 else "10",
                    side="left",
                    position_m=2.0 * step,
                    position_sd_m=0.03,
                    step=step,
                    taken_s=WALK.started_s + step,
                    note=EVIL if step == 0 else "",
                    captures=(records.CaptureRecord(f"c{step}", thumbnail=thumbnail, fruit=found),),
                    artifacts=(
                        records.ArtifactRecord("config", "measure", CONFIG),
                        records.ArtifactRecord("model", "yolo", MODEL),
                        *([records.ArtifactRecord("calibration", "house", SITE)] if step else []),
                    ),
                    failures=({"input": "x", "error": "CaptureError"},) if step == 3 else (),
                )
            )
        keys = [view.key for view in opened.detections(WALK.key)]
        opened.pick([keys[4]], at_s=WALK.started_s + 60)
        opened.set_verdict([keys[6]], records.Verdict.REJECTED)
        yield opened


@pytest.fixture(scope="module")
def tables(store: Store) -> RoundTables:
    return round_tables(
        store, WALK.key, load_profile("long-cucumber"), profile_name="long-cucumber"
    )
