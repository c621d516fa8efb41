"""Command, round, dashboard, Python and evaluation give one capture the same lengths."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
from tests.greenhouse.conftest import add_one

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.methods.selector import measure_fruit
from cucumbervision.run.finders import Finder
from cucumbervision.run.options import MeasureOptions
from cucumbervision.run.whole_run import measure_inputs
from cucumbervision_greenhouse.rounds.adding import add_captures
from cucumbervision_greenhouse.settings import Settings
from cucumbervision_greenhouse.store.records import FruitRow, Round
from cucumbervision_greenhouse.store.repository import open_store
from cucumbervision_lab.evaluate.measure_case import fruit_lengths


def said(record: FruitRow) -> dict[str, Any]:
    """What a record says of the length, in the columns of the tables."""
    assert record.length is not None
    metres = {
        "length": record.length.value_m,
        "interval_low": record.length.low_m,
        "interval_high": record.length.high_m,
        **{name: getattr(record, f"{name}_m") for name in ("thread", "centreline", "chord")},
    }
    cells: dict[str, Any] = {
        f"{name}_cm": None if value is None else round(100 * value, 3)
        for name, value in metres.items()
    }
    cells["length_kind"] = record.length.kind
    names = ("method", "mask_source", "flags", "reason")
    return cells | {name: getattr(record, name) for name in names}


@pytest.mark.parametrize("with_masks", [True, False])
def test_every_surface_gives_the_same_lengths(tmp_path: Path, with_masks: bool) -> None:
    folder = tmp_path / "bench"
    shutil.copytree(example_captures() / "simulated-bench", folder)
    if not with_masks:  # the package's own networks find the fruit
        shutil.rmtree(folder / "mask_visib")
    rows = measure_inputs([folder], tmp_path / "out", MeasureOptions()).rows
    assert len(rows) >= 2
    assert {row["mask_source"] for row in rows} == {"dataset" if with_masks else "detector"}
    added, taken = Round(name="added"), Round(name="taken")
    capture = next(iter(open_source(folder))).load()
    with open_store(tmp_path / "house.db") as store:
        store.save_round(added)
        store.save_round(taken)
        add_captures(store, added.key, [folder], MeasureOptions())
        options = Settings().options
        add_one(store, taken.key, capture, options)
        for one in (added, taken):
            records = list(store.detections(one.key))
            found = {record.fruit: said(record) for record in records}
            assert [found[n] for n in sorted(found)] == [
                {name: row[name] for name in found[1]} for row in rows
            ]
    instances = Finder(MeasureOptions()).find(capture).instances
    for row, instance in zip(rows, instances, strict=True):
        fruit = measure_fruit(capture, instance)
        assert fruit.length is not None
        assert round(100 * fruit.length.value_m, 3) == row["length_cm"]
        lengths = fruit_lengths(fruit, capture)
        for name in ("M3", "M5", "M6"):
            length = lengths[name]
            assert (length and round(100 * length, 3)) == row[f"{name.lower()}_cm"]
