"""Corrections by real clicks on the picture: they end in the store, with who made them and when."""

from __future__ import annotations

import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("streamlit")

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.fruit.mask_codes import decode_rle
from cucumbervision.fruit.masks import mask_iou
from cucumbervision_greenhouse.store.records import DetectionDetail, Verdict, key_of
from cucumbervision_greenhouse.store.repository import open_store

WALK, TOKEN = key_of("walk"), "a-token-of-this-test-only"
PATIENCE_S = 300.0  # on a machine that does much else; some seconds on an idle one


def axis_px(detail: DetectionDetail) -> Any:
    """The measured axis in the capture's pixels."""
    record = detail.view
    path = record.path_m
    return CameraModel.model_validate(detail.capture.camera).intrinsics.project(np.array(path))


def mask_of(detail: DetectionDetail) -> Any:
    return decode_rle(detail.view.mask or "", detail.capture.height_px, detail.capture.width_px)


def wait_for_action(path: Path, kind: str) -> None:
    """Wait until the newest line of the log is of a kind."""
    until = time.monotonic() + PATIENCE_S
    while True:
        with open_store(path) as store:
            if store.log(WALK)[0].kind == kind:
                return
        assert time.monotonic() < until
        time.sleep(0.2)


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
    path = tmp_path / "house.db"
    shutil.copyfile(made, path)
    shutil.copytree(made.with_suffix(".images"), path.with_suffix(".images"))
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
    until = time.monotonic() + PATIENCE_S
    while opened().view.mask_source != "sam":
        assert time.monotonic() < until
        time.sleep(0.2)
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
    wait_for_action(path, "add")
    with open_store(path) as store:
        [new] = {view.key for view in store.detections(WALK)} - found
        added = store.detection(new)
    assert added.view.verdict is Verdict.ACCEPTED
    assert mask_iou(mask_of(added), mask_of(lost)) > 0.7

    # A wrong one is deleted.
    page.locator("[class*='st-key-rejected_'] button").click()
    wait_for_action(path, "reject")
    assert opened().view.verdict is Verdict.REJECTED
    with open_store(path) as store:
        log = [one for one in store.log(WALK) if one.by != "nobody"]
    assert [(one.kind, one.by) for one in log[::-1]] == [
        *(("correct", "dashboard"), ("add", "dashboard"), ("reject", "dashboard"))
    ]
    assert all(begun_s <= one.at_s <= time.time() for one in log)
