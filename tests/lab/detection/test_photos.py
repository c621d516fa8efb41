from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pycocotools")

from cucumbervision_lab.detection.photos import PhotoResult, audited_photos, score_photos
from cucumbervision_lab.detection.pictures import Frame, SeenFruit, TrueFruit
from cucumbervision_lab.detection.tables import false_table, photo_table

SPOTS = [np.array([0.0, 30 * k, 90, 30 * k + 20]) for k in range(8)]


def photo(name: str, scene: str, true: list[TrueFruit], *found: int) -> Frame:
    seen = tuple(SeenFruit(SPOTS[k], 0.9 - 0.1 * k) for k in found)
    return Frame(name, scene, 300, 300, tuple(true), kept=seen)


def scored() -> PhotoResult:
    cucumber, courgette = TrueFruit(SPOTS[0]), TrueFruit(SPOTS[1], optional=True)
    crate = TrueFruit(np.array([0.0, 60, 300, 115]), ignore=True)
    return score_photos(
        [
            photo("a.jpg", "one", [cucumber, courgette, crate], 0, 1, 2, 3),
            photo("b.jpg", "one", [cucumber, TrueFruit(SPOTS[5])], 0),
            photo("c.jpg", "two", [cucumber], 0, 4),
            photo("d.jpg", "three", [], 6),
        ],
        ["crate", "board", "board", "none"],
        0.25,
        missing=2,
    )


def test_recall_and_precision_of_photos() -> None:
    found = scored()
    scores = dict(found.scores)
    whole = scores["all"]
    # Four cucumbers, one missed; five judged detections, two of them on nothing.
    assert (whole.recall.value, whole.recall.count, whole.recall.scenes) == (0.75, 4, 2)
    assert whole.precision is not None
    assert (whole.precision.value, whole.precision.count) == (0.6, 5)
    assert (found.photos, found.scenes, found.missing) == (4, 3, 2)
    board, empty = scores["board"].precision, scores["none"].precision
    assert board is not None
    assert empty is not None
    assert (board.value, empty.value) == pytest.approx((2 / 3, 0.0))


def test_false_ones_are_listed_by_file_and_box() -> None:
    table = false_table(scored())
    assert [row[0] for row in table.rows] == ["c.jpg", "d.jpg"]
    assert table.rows[0][3] == "0, 120 to 90, 140"
    assert "2 of the audit's photos are missing" in photo_table(scored()).comment


@pytest.mark.realdata
def test_audited_photos(shared_data: Path) -> None:
    photos, missing = audited_photos(shared_data)
    assert missing == 0
    boxes = [one for photo in photos for one in photo.truth.true]
    assert sum(one.required for one in boxes) > 40
    assert any(one.optional for one in boxes)
    assert any(one.ignore for one in boxes)
    train, _ = audited_photos(shared_data, "train")
    assert not {p.truth.scene for p in photos} & {p.truth.scene for p in train}
