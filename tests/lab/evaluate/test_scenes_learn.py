"""Fruit of a drawn set, measured as they are and as somebody finds them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from cucumbervision.capture.frames import Capture
from cucumbervision.cli.app import app
from cucumbervision.fruit.instance import Instance, MaskSource
from cucumbervision_lab.evaluate import scenes as run
from cucumbervision_lab.evaluate.measure_case import Masks, Row
from cucumbervision_lab.evaluate.pictures import frame_of
from cucumbervision_lab.evaluate.scenes import set_records
from cucumbervision_lab.scenes.generate import FrameOptions, SynthOptions, generate


class TruthFinder:
    """Finds every fruit that is to be found, as SAM would draw it."""

    def __init__(self, folder: Path) -> None:
        self.data = generate(
            SynthOptions(frames=3, seed=3, frame=FrameOptions(width=640, height=360)), folder
        )

    def find(self, capture: Capture) -> SimpleNamespace:
        (picture,) = (p for p in self.data.pictures if Path(p.file).stem == capture.name)
        found = []
        for label, fruit in zip(
            picture.labels, frame_of(picture, self.data, None).true, strict=True
        ):
            if fruit.required and label.mask is not None:
                found.append(Instance(label.box, 0.8, mask=label.mask, mask_source=MaskSource.SAM))
        return SimpleNamespace(instances=tuple(found))


@pytest.fixture(scope="module")
def finder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TruthFinder]:
    finder = TruthFinder(tmp_path_factory.mktemp("drawn") / "set")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "package_finder", lambda: finder)
        yield finder


@pytest.fixture(scope="module")
def rows(finder: TruthFinder, tmp_path_factory: pytest.TempPathFactory) -> list[Row]:
    return set_records(finder.data.folder, "all", tmp_path_factory.mktemp("kept") / "rows.jsonl")


def test_the_same_mask_reads_the_same_whoever_drew_it(rows: list[Row]) -> None:
    given, perceived = (
        [row for row in rows if row["masks"] == kind] for kind in (Masks.EXACT, Masks.PERCEIVED)
    )
    assert len(given) == len(perceived) > 2
    for one, other in zip(given, perceived, strict=True):
        assert one["fruit"] == other["fruit"]
        thread_m = one["lengths_m"]["M6 thread"]
        assert thread_m == pytest.approx(other["lengths_m"]["M6 thread"], rel=1e-6)
        assert one["mask_features"]["perceived"] == 0.0
        assert other["mask_features"]["perceived"] == 1.0
    whole = [row for row in given if not row["cut_off"] and row["hidden_share"] < 0.05]
    errors = [(row["lengths_m"]["M6"] or np.nan) / row["centreline_m"] - 1 for row in whole]
    assert abs(np.median(errors)) < 0.05


def test_learning_asks_for_a_drawn_set(tmp_path: Path) -> None:
    told = CliRunner().invoke(app, ["benchmark", "--learn-intervals", str(tmp_path / "a.json")])
    assert told.exit_code == 2
    assert "--learn-set" in told.output
