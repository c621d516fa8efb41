from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("streamlit")

from tests.greenhouse.conftest import copy_house, wait_until
from tests.greenhouse.pages.app_pages import WALK, app, said, tap

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.fruit.mask_codes import decode_rle, encode_rle
from cucumbervision.fruit.masks import mask_iou
from cucumbervision_greenhouse.pages.fruit import point_cloud
from cucumbervision_greenhouse.rounds.fruit_table import fruit_table, read_round
from cucumbervision_greenhouse.rounds.merge_and_link import move_stop
from cucumbervision_greenhouse.settings import Units
from cucumbervision_greenhouse.store.records import (
    DetectionDetail,
    FruitRow,
    LinkKind,
    LinkRecord,
    Verdict,
)
from cucumbervision_greenhouse.store.repository import Store, open_store
from cucumbervision_greenhouse.words import length_words

pytestmark = pytest.mark.usefixtures("fresh_caches")


def test_undo_on_a_fruit_s_page_takes_a_deleted_stop_back_and_merges(house: Path) -> None:
    with open_store(house) as store:
        stop = store.stops(WALK)[0]
        fruit = next(one for one in store.detections(WALK) if one.stop_key != stop.key)
        store.delete_stop(stop.key)
        for page in ("results", "row_map"):
            test = app(page, round=WALK, fruit=fruit.key)
            tap(test, "Undo")
            put_back = store.stops(WALK)[0]
            assert put_back.key == stop.key
            assert put_back.fitted_m is not None
            store.place_stop(replace(stop, position_m=9.0, step=1))


def test_fruit_turn_with_the_side_of_their_stop(store: Store) -> None:
    first = store.stops(WALK)[0]
    at_m = first.position_m or 0.0

    def offsets() -> list[float]:
        views = [view for view in store.detections(WALK) if view.stop_key == first.key]
        return [round((view.along_m or 0.0) - at_m, 6) for view in views]

    before = offsets()
    other = "left" if first.side == "right" else "right"
    move_stop(store, first, Stop(first.row, other, first.position_m, first.step))
    assert offsets() == [-x for x in before]
    turned = store.stops(WALK)[0]
    move_stop(store, turned, Stop(first.row, first.side, first.position_m, first.step))
    assert offsets() == before


CAMERA = Intrinsics(80, 60, 100.0, 100.0, 39.5, 29.5)


@pytest.fixture
def plane() -> tuple[Capture, FruitRow]:
    """A fruit of 10 by 20 pixels, half a metre away, before a wall a metre away."""
    color = np.full((60, 80, 3), (10, 120, 30), np.uint8)
    depth_m = np.full((60, 80), 1.0, np.float32)
    mask = np.zeros((60, 80), bool)
    mask[20:40, 30:40] = True
    depth_m[mask] = 0.5
    depth_m[25, 35] = 0.0  # no reading
    record = FruitRow(1, mask=encode_rle(mask), stem_x_m=0.0, stem_y_m=-0.05, stem_z_m=0.5)
    return Capture(color, depth_m, CAMERA, name="a"), record


def test_one_reading_far_behind_does_not_make_the_fruit_small(
    plane: tuple[Capture, FruitRow],
) -> None:
    capture, record = plane
    near = point_cloud(capture, record)
    depth_m = capture.depth_m.copy()
    depth_m[30, 35] = 4.0
    far = point_cloud(replace(capture, depth_m=depth_m), record)
    assert near is not None
    assert far is not None
    zoom = [deck.initial_view_state.zoom for deck in (near, far)]
    assert zoom[0] == pytest.approx(zoom[1], abs=0.1)
    marks = near.layers[1].data
    assert [mark["color"] for mark in marks] == [(240, 228, 66)]  # the stem end alone is known


def test_without_mask_or_depth_there_is_nothing(plane: tuple[Capture, FruitRow]) -> None:
    capture, record = plane
    assert point_cloud(capture, record.with_(mask=None)) is None
    assert point_cloud(replace(capture, depth_m=np.zeros_like(capture.depth_m)), record) is None


TOKEN = "a-token-of-this-test-only"


def axis_px(detail: DetectionDetail) -> Any:
    """The measured axis in the capture's pixels."""
    record = detail.view
    path = record.path_m
    return CameraModel.model_validate(detail.capture.camera).intrinsics.project(np.array(path))


def mask_of(detail: DetectionDetail) -> Any:
    return decode_rle(detail.view.mask or "", detail.capture.height_px, detail.capture.width_px)


def wait_for_action(page: Any, path: Path, kind: str) -> None:
    """Wait until the newest line of the log is of a kind."""
    with open_store(path) as store:
        wait_until(page, lambda: store.log(WALK)[0].kind == kind)


def on_screen(page: Any, at_px: Any) -> tuple[float, float]:
    """Where a pixel of the capture is on the screen."""
    picture = page.locator("svg.view")
    picture.scroll_into_view_if_needed()
    place = (
        "(svg, at) => { const p = new DOMPoint(...at).matrixTransform(svg.getScreenCTM());"
        " return [p.x, p.y]; }"
    )
    x, y = picture.evaluate(place, [float(value) for value in at_px])
    return x, y


def test_a_fruit_is_outlined_by_a_tap_one_is_added_and_one_deleted(
    made: Path, tmp_path: Path, start_server: Callable[..., str], new_page: Callable[..., Any]
) -> None:
    path = copy_house(made, tmp_path)
    with open_store(path) as store:
        found = {view.key for view in store.detections(WALK)}
        # As if the detector had missed one fruit of each picture.
        last = {view.capture: view for view in store.detections(WALK)}
        missed = {name: store.detection(view.key) for name, view in last.items()}
        store.signed("nobody").set_verdict([view.key for view in last.values()], Verdict.REJECTED)
    variables = {"CUCUMBERVISION_TOKEN": TOKEN, "HOME": str(tmp_path)}
    address = start_server(tmp_path, "--login", "--store", str(path), **variables)
    begun_s, page = time.time(), new_page()
    page.goto(f"{address}/results?token={TOKEN}")
    page.get_by_text("tap one to open it").wait_for()
    page.locator(".fruit button").first.click()
    picture = page.locator("svg.view")
    picture.wait_for()
    named = re.fullmatch(r"Fruit (\d+) of (.+)", picture.get_attribute("aria-label"))
    assert named is not None
    number, capture = named.groups()

    def opened() -> DetectionDetail:
        with open_store(path) as store:
            views = store.detections(WALK)
            one = next(x for x in views if (str(x.fruit), x.capture) == (number, capture))
            return store.detection(one.key)

    axis = axis_px(opened())

    # Its outline is drawn anew by a tap, and what became of it is said with the new length.
    page.get_by_role("button", name="Redraw by tap").click()
    page.mouse.click(*on_screen(page, axis[len(axis) // 2]))
    wait_until(page, lambda: opened().view.mask_source == "sam")
    assert opened().view.corrected
    page.get_by_text("Saved: measured with this outline").wait_for()
    page.get_by_role("button", name="Redraw by tap").click()  # it is put away

    # A fruit that was missed is added by a tap on its middle.
    page.get_by_text("Tap or draw a box to add a missed fruit").click()
    page.get_by_role("button", name="Whole").click()
    page.get_by_role("button", name="Add by tap").click()
    lost = missed[capture]
    middle = axis_px(lost)[len(axis_px(lost)) // 2]
    page.mouse.click(*on_screen(page, middle))
    wait_for_action(page, path, "add")
    with open_store(path) as store:
        [new] = {view.key for view in store.detections(WALK)} - found
        added = store.detection(new)
    assert added.view.verdict is Verdict.ACCEPTED
    assert mask_iou(mask_of(added), mask_of(lost)) > 0.7

    # A wrong one is deleted.
    page.locator("[class*='st-key-rejected_'] button").click()
    wait_for_action(page, path, "reject")
    assert opened().view.verdict is Verdict.REJECTED
    with open_store(path) as store:
        log = [one for one in store.log(WALK) if one.by != "nobody"]
    assert [(one.kind, one.by) for one in log[::-1]] == [
        *(("correct", "dashboard"), ("add", "dashboard"), ("reject", "dashboard"))
    ]
    assert all(begun_s <= one.at_s <= time.time() for one in log)


def lines_of(fruit_key: str) -> list[str]:
    return said(app("results", round=WALK, fruit=fruit_key)).splitlines()


def test_a_fruit_shows_its_views_and_the_length_of_all_together(house: Path) -> None:
    with open_store(house) as store:
        first, second, alone, *_ = store.detections(WALK)
        store.save_merging(WALK, [LinkRecord(LinkKind.SAME, first.key, second.key, 1.0)])
        seen = [view for view in store.detections(WALK) if view.views == 2]
        best = next(view for view in seen if view.best)
        (line,) = (x for x in fruit_table(read_round(store, WALK)) if x.key == best.key)
    lines = lines_of(best.key)
    assert "**Seen 2 times**" in lines
    for view in seen:
        words = f"Stop {view.step}: {length_words(view, Units('cm'))}"
        assert any(one.startswith(words) for one in lines), (words, lines)
    together = length_words(line, Units("cm"))
    assert any(one.startswith(f"All that show it whole, together: {together}") for one in lines)
    assert not any(one.startswith("All that show it whole") for one in lines_of(alone.key))
