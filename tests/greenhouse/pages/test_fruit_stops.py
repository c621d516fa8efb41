from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from streamlit.testing.v1 import AppTest
from tests.greenhouse.rounds.test_adding import CAMERA, OPTIONS, draw

from cucumbervision.instances.mask_codes import decode_rle
from cucumbervision_greenhouse.fruit_pictures import drawn_on, joint_tube, tube_outline
from cucumbervision_greenhouse.rounds.adding import add_captures
from cucumbervision_greenhouse.rounds.from_store import read_round
from cucumbervision_greenhouse.rounds.fruit_table import fruit_table
from cucumbervision_greenhouse.rounds.joint_lengths import measure_jointly
from cucumbervision_greenhouse.rounds.merge_and_link import merge_round
from cucumbervision_greenhouse.settings import Units
from cucumbervision_greenhouse.store.records import Round, key_of
from cucumbervision_greenhouse.store.repository import open_store
from cucumbervision_greenhouse.words import length_words

pytestmark = pytest.mark.usefixtures("fresh_caches")

WALK = key_of("walk")


def lines_of(fruit_key: str) -> list[str]:
    script = (
        "from cucumbervision_greenhouse.pages.app import keep_inputs\n"
        "from cucumbervision_greenhouse.pages import results\n"
        "keep_inputs()\nresults.page()\n"
    )
    test = AppTest.from_string(script, default_timeout=600)
    test.session_state["round"], test.query_params["fruit"] = WALK, fruit_key
    test.run()
    assert not test.exception
    return [str(one.value).replace("\\", "") for one in (*test.caption, *test.markdown)]


def test_a_fruit_shows_its_views_and_the_length_of_all_together(house: Path) -> None:
    with open_store(house) as store:
        first, second, alone, *_ = store.detections(WALK)
        store.merge(first.key, second.key)
        seen = [view for view in store.detections(WALK) if view.views == 2]
        best = next(view for view in seen if view.best)
        (line,) = (x for x in fruit_table(read_round(store, WALK)) if x.view.key == best.key)
    lines = lines_of(best.key)
    assert "**Seen 2 times**" in lines
    for view in seen:
        words = f"Stop {view.step}: {length_words(view.record, Units('cm'))}"
        assert any(one.startswith(words) for one in lines), (words, lines)
    together = length_words(line.view.record, Units("cm"))
    assert any(one.startswith(f"All that show it whole, together: {together}") for one in lines)
    assert not any(one.startswith("All that show it whole") for one in lines_of(alone.key))


def test_a_fruit_shows_the_tube_in_all_its_views(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(3):
        draw("left", number, tmp_path / "walk")
    path = tmp_path / "row.db"
    with open_store(path) as store:
        store.save_round(Round(WALK, "walk"))
        add_captures(store, WALK, [tmp_path / "walk"], OPTIONS)
        merge_round(store, WALK)
        measure_jointly(store, WALK)
        content = read_round(store, WALK)
        line = next(one for one in fruit_table(content) if one.joint is not None)
        assert line.joint is not None
        joint = store.joint_drawing(WALK, line.joint.key)
        for key in joint.poses:
            detail = store.detection(key)
            color = store.images.read_color(detail.capture.color or pytest.fail("no picture"))
            tube = joint_tube(joint, key)
            assert tube is not None
            drawn = drawn_on(color, tube, CAMERA)
            # The outline that is drawn runs along the mask's own.
            inside = cv2.fillPoly(
                np.zeros(color.shape[:2], np.uint8),
                [np.rint(tube_outline(tube, CAMERA)).astype(np.int32)],
                1,
            ).astype(bool)
            mask = decode_rle(detail.view.record.mask or "", CAMERA.height, CAMERA.width)
            assert (inside & mask).sum() > 0.85 * (inside | mask).sum()
            assert (drawn != color).any(axis=2).sum() > 100
        assert joint_tube(joint, "of no view") is None
    monkeypatch.setenv("CUCUMBERVISION_STORE", str(path))
    lines = lines_of(line.view.key)
    together = length_words(line.view.record, Units("cm"))
    assert any(one.startswith("One tube fitted to") and together in one for one in lines), lines
