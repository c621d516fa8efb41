from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

if TYPE_CHECKING:
    from numpy.typing import NDArray

pytest.importorskip("pycocotools")

from cucumbervision.capture.pictures import write_png
from cucumbervision.fruit.instance import Instance
from cucumbervision_lab.data.labels import DataSet, Label, LabelledPicture
from cucumbervision_lab.evaluate.outcomes import Evaluation, end_rows
from cucumbervision_lab.evaluate.pictures import Frame, Networks
from cucumbervision_lab.evaluate.report import photo_tables
from cucumbervision_lab.evaluate.scenes import audited_photos, evaluate_photos, photo_truth

ENDS = ("blossom end", "stem end")
SPOTS = [np.array([0.0, 30 * k, 90, 30 * k + 20]) for k in range(8)]


def photo(name: str, scene: str, true: list[Label], *found: int) -> Frame:
    seen = tuple(Label(SPOTS[k], score=0.9 - 0.1 * k) for k in found)
    return Frame(name, scene, 300, 300, tuple(true), kept=seen)


def photo_set(*photos: tuple[str, str, str], folder: Path = Path(), **fields: Any) -> DataSet:
    """Give photos of a name, a setting and a test."""
    pictures = (
        LabelledPicture(name, 80, 60, extras={"setting": setting, "test": test}, **fields)
        for name, setting, test in photos
    )
    return DataSet(folder, tuple(pictures))


def scored() -> Evaluation:
    cucumber, courgette = Label(SPOTS[0]), Label(SPOTS[1], optional=True)
    crate = Label(np.array([0.0, 60, 300, 115]), ignore=True)
    frames = (
        photo("a.jpg", "one", [cucumber, courgette, crate], 0, 1, 2, 3),
        photo("b.jpg", "one", [cucumber, Label(SPOTS[5])], 0),
        photo("c.jpg", "two", [cucumber], 0, 4),
        photo("d.jpg", "three", [], 6),
    )
    settings = ("crate", "board", "board", "none")
    names = [frame.name for frame in frames]
    photos = photo_set(*zip(names, settings, ["loose fruit"] * 4, strict=True))
    return Evaluation(photos, Networks(None, None, None, 0.25), frames, missing=2)


def test_recall_and_precision_of_photos() -> None:
    found = scored()
    whole = found.score()
    # Four cucumbers, one missed; five judged detections, two of them on nothing.
    assert (whole.recall.value, whole.recall.count, whole.recall.groups) == (0.75, 4, 2)
    assert whole.precision is not None
    assert (whole.precision.value, whole.precision.count) == (0.6, 5)
    assert "4 photos of 3 scenes; 2 of the audit's" in photo_tables(found)[0].comment
    board, empty = (found.score(setting=name).precision for name in ("board", "none"))
    assert board is not None
    assert empty is not None
    assert (board.value, empty.value) == pytest.approx((2 / 3, 0.0))


class Reader:
    """A detector that boxes what is not grey."""

    task = "detect"
    looks = 1

    def detect(self, color_rgb: NDArray[np.uint8]) -> tuple[Instance, ...]:
        rows, columns = np.nonzero((color_rgb != 114).any(axis=2))
        edges = [columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5]
        return (Instance(np.array(edges), 0.9),)


def test_small_fruit_are_the_same_photos_at_half_size(tmp_path: Path) -> None:
    color = np.full((60, 80, 3), 114, np.uint8)
    color[20:30, 10:50] = 30
    write_png(tmp_path / "a.png", color)
    fruit = Label(np.array([9.5, 19.5, 49.5, 29.5]))
    data = photo_set(
        ("a.png", "plant", "on the plant"), ("a.png", "none", "negatives"), folder=tmp_path
    )
    data = replace(data, pictures=(replace(data.pictures[0], labels=(fruit,)), data.pictures[1]))
    found = evaluate_photos(data, Networks(Reader(), None, None, 0.3))  # type: ignore[arg-type]
    for small in (False, True):
        assert found.score(small=small, test="on the plant").recall.value == 1.0
        negatives = found.score(small=small, test="negatives").precision
        assert negatives is not None
        assert negatives.value == 0.0
    rows = [row[0] for row in photo_tables(found)[0].rows]
    assert rows == [
        "all",
        *("test: negatives", "test: on the plant"),
        *("half size: all", "half size: negatives", "half size: on the plant"),
        *("where: none", "where: plant"),
    ]


def test_ends_on_photos_are_judged_by_the_straight_line_between_them() -> None:
    line = np.linspace([10.0, 10.0], [110.0, 10.0], 5)
    true = Label(SPOTS[0], keypoints=np.column_stack([line, [2.0, 0, 0, 0, 2]]))
    points = np.column_stack([line + np.array([0.0, 3.0]), np.ones(5)])
    fruit = Label(SPOTS[0], score=0.9, keypoints=points)
    frame = Frame("a.jpg", "one", 300, 300, (true,), posed=(fruit,), kept=(fruit,))
    photos = photo_set(("a.jpg", "trial", "first audit"))
    found = Evaluation(photos, Networks(None, None, None, 0.25), (frame,))
    (row,) = end_rows(found.frames, 0.25).itertuples()
    assert (row.length_px, row.blossom_percent, row.stem_percent, row.swapped) == (
        100.0,
        3.0,
        3.0,
        False,
    )
    assert [r[0] for r in photo_tables(found)[1].rows] == ["all", "in sight", *ENDS]


@pytest.mark.realdata
def test_audited_photos(shared_data: Path) -> None:
    photos, missing = audited_photos(shared_data)
    assert missing == 0
    boxes = [label for picture in photos.pictures for label in photo_truth(picture, photos).true]
    assert sum(box.required for box in boxes) > 40
    assert any(box.optional for box in boxes)
    assert any(box.ignore for box in boxes)
    for split in ("train", "val"):
        others, _ = audited_photos(shared_data, split)
        assert not {p.scene for p in photos.pictures} & {p.scene for p in others.pictures}
