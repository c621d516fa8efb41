from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import pytest
from tests.simulated_rows import Walk

from cucumbervision.methods.result import Length, LengthDefinition
from cucumbervision_greenhouse.store import records
from cucumbervision_greenhouse.store.repository import Store, open_store

CENTRELINE = LengthDefinition.CENTRELINE
MORNING = records.Round(
    records.key_of("rounds", "morning"), "morning", "house 1", 86400.0, "long-cucumber"
)


class SaveWalk(Protocol):
    def __call__(self, walk: Walk, record: records.Round = ..., row: str = ...) -> None: ...


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    """An open store with a round."""
    with open_store(tmp_path / "house.db") as opened:
        opened.save_round(MORNING)
        yield opened


@pytest.fixture
def save_walk(store: Store) -> SaveWalk:
    """Return what saves a simulated walk as the stops of a round."""

    def save(walk: Walk, record: records.Round = MORNING, row: str = "3") -> None:
        for number in range(len(walk.stops)):
            store.save_stop(_stop(walk, number, record, row))

    return save


def _stop(walk: Walk, number: int, record: records.Round, row: str) -> records.StopRecord:
    views, sign = walk.views, 1.0 - 2.0 * float(walk.stops.side[number])
    fruit: list[records.FruitRow] = []
    for k in (views.stop == number).nonzero()[0].tolist():
        x, up, depth = views.offset_m[k].tolist()
        length, sd = float(views.length_m[k]), float(views.length_sd[k])
        one = records.FruitRow(
            len(fruit) + 1,
            flags="end-hidden" if views.partial[k] else "",
            length=Length(
                length, CENTRELINE, length * (1 - 1.645 * sd), length * (1 + 1.645 * sd), CENTRELINE
            ),
            centreline_m=length,
            diameter_max_m=float(views.diameter_m[k]),
            centre_x_m=sign * x,
            centre_y_m=-up,
            centre_z_m=sign * depth,
            offset_m=x,
            offset_sd_m=0.006,
            view_score=float(views.view_score[k]),
        )
        fruit.append(one)
    camera = {"width": 1374, "height": 768, "fx": 1000.0, "fy": 1000.0}
    side = "left" if walk.stops.side[number] == 0 else "right"
    return records.StopRecord(
        key=records.key_of(record.key, row, number),
        round_key=record.key,
        row=row,
        side=side,
        position_m=float(walk.stops.at_m[number, 0]),
        position_sd_m=0.03,
        step=number,
        taken_s=record.started_s + number,
        captures=(replace(records.CaptureRecord(f"c{number}", camera=camera), fruit=tuple(fruit)),),
    )
