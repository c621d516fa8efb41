"""A fruit's picture: cut out, with its outline, its axis and a bar of true length."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.intrinsics import Intrinsics, Stream
from cucumbervision.fruit.mask_codes import encode_rle
from cucumbervision.methods.result import Length
from cucumbervision_greenhouse.exports.build import round_tables
from cucumbervision_greenhouse.exports.fruit_pictures import draw_fruit
from cucumbervision_greenhouse.store.records import (
    CaptureRecord,
    FruitRow,
    Round,
    StopRecord,
    new_key,
)
from cucumbervision_greenhouse.store.repository import open_store

CAMERA = Intrinsics(640, 480, 600.0, 600.0, 319.5, 239.5, Stream.COLOR)
ORANGE, GREY = (230, 159, 0), 60


def hanging() -> tuple[FruitRow, CaptureRecord]:
    """A fruit 40 by 200 pixels, 0.6 m away: a pixel is a millimetre."""
    mask = np.zeros((480, 640), bool)
    mask[100:300, 300:340] = True
    # Its axis: straight down the middle, from y = 100 to y = 299.
    path = tuple((0.0, (v - 239.5) * 0.001, 0.6) for v in (100.0, 199.5, 299.0))
    record = FruitRow(
        1,
        box_x1_px=299.5,
        box_y1_px=99.5,
        box_x2_px=339.5,
        box_y2_px=299.5,
        method="M6",
        length=Length(0.2),
        distance_m=0.6,
        mask=encode_rle(mask),
        path_m=path,
    )
    camera = CameraModel.of(CAMERA).model_dump(mode="json")
    return record, CaptureRecord("a", width_px=640, height_px=480, camera=camera)


def test_outline_axis_and_bar_are_where_the_fruit_is() -> None:
    color = np.full((480, 640, 3), GREY, np.uint8)
    picture = draw_fruit(color, *hanging())
    # The box is 200 long: 24 around it, and the other side at least 120 and 24 on both sides.
    zoom = 480 / 248
    assert picture.shape == (480, round(zoom * 168), 3)
    middle = round((319.5 - 236 + 0.5) * zoom - 0.5)
    left, right = ((edge - 236 + 0.5) * zoom - 0.5 for edge in (300, 339))
    row = picture[round((220 - 76) * zoom)].astype(int)
    orange = np.flatnonzero(np.abs(row - ORANGE).sum(axis=1) < 60)
    assert orange.min() == pytest.approx(left, abs=2)
    assert orange.max() == pytest.approx(right, abs=2)
    assert tuple(row[middle]) == (255, 255, 255)
    # 0.6 m away a metre is 1000 pixels: half of the picture's width has room for 5 cm.
    bar = picture[480 - 15].astype(int).min(axis=1)
    white = np.flatnonzero(bar > 200)
    assert white.max() - white.min() == pytest.approx(50 * zoom, abs=6)
    assert (picture[:, -4:] == GREY).all()


def test_a_small_picture_shows_the_same_place() -> None:
    color = np.zeros((480, 640, 3), np.uint8)
    color[:, 320:] = 200
    record, capture = hanging()
    small = color[::2, ::2]
    whole, half = (draw_fruit(one, record, capture) for one in (color, small))
    assert whole.shape == half.shape
    assert np.abs(whole.astype(int) - half).mean() < 3


def test_every_fruit_of_an_export_gets_its_own_picture(tmp_path: Path) -> None:
    record, capture = hanging()
    color = np.full((480, 640, 3), GREY, np.uint8)
    walk = Round(name="morning")
    with open_store(tmp_path / "house.db") as store:
        kept = {"color": store.images.put_color(color), "thumbnail": None}
        stop = StopRecord(
            new_key(),
            walk.key,
            row="3",
            position_m=1.0,
            captures=(
                CaptureRecord(**{**vars(capture), **kept, "fruit": (record,)}),
                CaptureRecord("b", fruit=(FruitRow(1),)),  # nothing of it was kept
            ),
        )
        store.save_round(walk)
        store.save_stop(stop)
        tables = round_tables(store, walk.key)
    named = {line["capture"]: line["picture"] for line in tables["fruit"].rows}
    assert named["b"] is None
    assert [named["a"]] == list(tables.pictures)
    [make] = tables.pictures.values()
    read = np.asarray(cv2.imdecode(np.frombuffer(make(), np.uint8), cv2.IMREAD_COLOR))
    assert np.abs(read[..., ::-1].astype(int) - draw_fruit(color, record, capture)).mean() < 3
