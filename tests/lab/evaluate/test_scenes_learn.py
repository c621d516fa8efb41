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
from cucumbervision_lab.evaluate.measure_case import Masks, read_records
from cucumbervision_lab.evaluate.pictures import frame_of
from cucumbervision_lab.evaluate.scenes import set_records
from cucumbervision_lab.scenes.generate import FrameOptions, SynthOptions, generate


class TruthFinder:
    """Finds every fruit that is to be found, as SAM would draw it, and counts the pictures."""

    def __init__(self, folder: Path) -> None:
        self.data = generate(
            SynthOptions(frames=3, seed=3, frame=FrameOptions(width=640, height=360)), folder
        )
        self.seen: list[str] = []

    def find(self, capture: Capture) -> SimpleNamespace:
        self.seen.append(capture.name)
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
def kept(finder: TruthFinder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The records of the whole set, in a file."""
    file = tmp_path_factory.mktemp("kept") / "records.jsonl"
    set_records(finder.data.folder, "all", file)
    return file


def test_the_same_mask_reads_the_same_whoever_drew_it(kept: Path) -> None:
    records = read_records([kept])
    by_masks = {kind: [r for r in records if r.masks is kind] for kind in Masks}
    given, perceived = by_masks[Masks.EXACT], by_masks[Masks.PERCEIVED]
    assert len(given) == len(perceived) > 2
    for one, other in zip(given, perceived, strict=True):
        assert one.fruit == other.fruit
        assert one.lengths_m["M6 thread"] == pytest.approx(other.lengths_m["M6 thread"], rel=1e-6)
        assert one.details["mask_features"]["perceived"] == 0.0
        assert other.details["mask_features"]["perceived"] == 1.0
    whole = [r for r in given if not r.details["cut_off"] and r.hidden_share < 0.05]
    errors = [(r.lengths_m["M6"] or np.nan) / (r.centreline_m or np.nan) - 1 for r in whole]
    assert abs(np.median(errors)) < 0.05


def test_a_second_run_measures_what_is_missing(
    kept: Path, finder: TruthFinder, tmp_path: Path
) -> None:
    file = tmp_path / "records.jsonl"
    every = read_records([kept])
    lines = kept.read_text().splitlines(keepends=True)
    last = [r.case.partition("#")[0] for r in every][-1]
    left = [s for s, r in zip(lines, every, strict=True) if not r.case.startswith(last)]
    file.write_text("".join(left))
    finder.seen.clear()
    again = set_records(finder.data.folder, "all", file)
    assert Path(last).stem in finder.seen
    assert len(finder.seen) < 3
    read = [[(r.fruit, r.masks, r.lengths_m) for r in some] for some in (again, every)]
    assert read[0] == read[1]


def test_learning_asks_for_a_drawn_set(tmp_path: Path) -> None:
    told = CliRunner().invoke(app, ["benchmark", "--learn-intervals", str(tmp_path / "a.json")])
    assert told.exit_code == 2
    assert "--learn-set" in told.output
