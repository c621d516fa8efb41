from __future__ import annotations

import errno
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.errors import CaptureError, DataSetError
from cucumbervision.fruit.instance import KEYPOINT_NAMES
from cucumbervision.fruit.mask_codes import fill_polygon
from cucumbervision_lab.data.coco import write_coco
from cucumbervision_lab.data.labels import (
    DataSet,
    flat_names,
    keypoints_of_mask,
    list_pictures,
    one_polygon,
    picture_size,
    place_file,
)
from cucumbervision_lab.scenes.bodies import random_fruit, rotation
from cucumbervision_lab.scenes.scene import Scene, truth_of


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif"])
def test_size_of_every_kind(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"a{suffix}"
    cv2.imwrite(str(file), np.zeros((37, 91, 3), np.uint8))
    assert picture_size(file) == (91, 37)
    assert list_pictures(tmp_path) == [file]


def test_a_head_that_promises_too_many_pixels_is_not_believed(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 4, 3), np.uint8))
    data = (tmp_path / "a.png").read_bytes()
    large = (100_000).to_bytes(4, "big")
    (tmp_path / "a.png").write_bytes(data[:16] + large + large + data[24:])
    with pytest.raises(CaptureError, match=r"a\.png: is truncated or damaged"):
        picture_size(tmp_path / "a.png")


def test_what_is_no_picture(tmp_path: Path) -> None:
    for data in (b"", b"text", b"\xff\xd8\xff"):
        (tmp_path / "a.jpg").write_bytes(data)
        with pytest.raises(CaptureError):
            picture_size(tmp_path / "a.jpg")


FILES = [
    f"{place}{n}" for place in ("", "train/", "images/", "x/") for n in ("a.jpg", "A.png", "b.png")
]


@given(st.lists(st.sampled_from(FILES), unique=True))
def test_flat_names_differ_even_without_ending_and_case(files: list[str]) -> None:
    names = flat_names(files)
    assert list(names) == files
    assert len({Path(n).stem.lower() for n in names.values()}) == len(files)
    assert all("/" not in n and Path(n).suffix == Path(f).suffix for f, n in names.items())


def test_placing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "a"
    source.write_bytes(b"1")
    target = tmp_path / "b/c"
    place_file(source, target)
    place_file(source, target)
    assert target.samefile(source)
    place_file(source, source)
    assert source.read_bytes() == b"1"
    with pytest.raises(DataSetError, match="the file is missing"):
        place_file(tmp_path / "none", tmp_path / "d")
    with pytest.raises(DataSetError, match="cannot be written"):
        place_file(source, source / "below")

    def refuse(*_: object) -> None:
        raise OSError(errno.EXDEV, "Invalid cross-device link")

    monkeypatch.setattr("os.link", refuse)
    other = tmp_path / "other"
    place_file(source, other)
    assert not other.samefile(source)
    assert other.read_bytes() == b"1"


PAGE = Path(__file__).parents[3] / "docs" / "datasets.md"
COCO_KEYS = {"id", "image_id", "file_name", "width", "height", "category_id", "bbox", "area",
             "iscrowd", "segmentation", "keypoints", "num_keypoints"}  # fmt: skip


def test_every_key_is_described(make_set: Callable[..., DataSet]) -> None:
    page = PAGE.read_text(encoding="utf-8")
    dataset = make_set("train")
    label = replace(dataset.pictures[0].labels[0], pseudo=True)
    picture = replace(dataset.pictures[0], labels=(label,))
    write_coco(replace(dataset, pictures=(picture,)), dataset.folder)
    data = json.loads((dataset.folder / "annotations.json").read_text())
    for item in (*data["images"], *data["annotations"]):
        for key in set(item) - COCO_KEYS:
            assert f"`{key}`" in page, key
    assert all(f"`{name}`" in page for name in KEYPOINT_NAMES)


masks = hnp.arrays(bool, hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=24))


def without_holes(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """What cannot be reached from outside in four directions, by flooding the background."""
    padded = np.pad(mask, 1).astype(np.uint8)
    _, labels = cv2.connectedComponents(1 - padded, connectivity=4)
    return np.asarray(labels[1:-1, 1:-1] != labels[0, 0])


def drawn(mask: NDArray[np.bool_], polygon: NDArray[np.float64], digits: int) -> NDArray[np.bool_]:
    size = np.array(mask.shape[::-1])
    shares = np.round(polygon / size, digits)
    return fill_polygon(shares * size, *mask.shape)


@settings(deadline=None, max_examples=200)
@given(masks)
def test_one_polygon_of_all_parts_gives_the_mask_back(mask: NDArray[np.bool_]) -> None:
    assume(mask.any())
    polygon = one_polygon(mask, min_part_px=0)
    assert polygon is not None
    assert (drawn(mask, polygon, 6) == without_holes(mask)).all()


def test_specks_are_left_out_but_never_the_only_part() -> None:
    mask = np.zeros((40, 60), bool)
    mask[5:15, 5:25] = True
    mask[5:15, 30:50] = True
    whole = mask.copy()
    mask[30:32, 30:33] = True
    polygon = one_polygon(mask)
    assert polygon is not None
    assert (fill_polygon(polygon, 40, 60) == whole).all()
    small = np.zeros((40, 60), bool)
    small[3, 3] = True
    polygon = one_polygon(small)
    assert polygon is not None
    assert (fill_polygon(polygon, 40, 60) == small).all()


CAMERA = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)


@pytest.mark.parametrize("seed", range(10))
def test_they_come_near_the_exact_ones_of_a_fruit_seen_from_the_side(seed: int) -> None:
    rng = np.random.default_rng(seed)
    body = random_fruit(rng, 0.25).moved(rotation(-90 + rng.normal(0, 10)), (0.0, 0.0, 0.6))
    (truth,) = truth_of(Scene((body,)), CAMERA)
    points = keypoints_of_mask(truth.visible, "up")
    assert points is not None
    off = np.linalg.norm(points[:, :2] - truth.keypoints_px, axis=1)
    # 25 cm are 250 px here.
    assert off.max() < 0.04 * 250
    assert (points[:, 2] == 2).all()


def test_the_word_says_which_end_is_last() -> None:
    mask = np.zeros((60, 60), bool)
    mask[5:55, 25:35] = True
    up, down = keypoints_of_mask(mask, "up"), keypoints_of_mask(mask, "down-right")
    assert up is not None
    assert down is not None
    np.testing.assert_allclose(up, down[::-1])
    assert up[4, 1] < up[0, 1]


def test_round_small_and_hollow_outlines_have_none() -> None:
    v, u = np.mgrid[:80, :80]
    assert keypoints_of_mask((u - 40) ** 2 + (v - 40) ** 2 < 900, "up") is None
    small = np.zeros((20, 20), bool)
    small[5:10, 2:17] = True
    assert keypoints_of_mask(small, "left") is None
    ring = np.hypot((u - 40) / 35, (v - 40) / 15)
    assert keypoints_of_mask((ring < 1) & (ring > 0.6), "left") is None


def test_an_unknown_word_is_refused() -> None:
    with pytest.raises(ValueError, match="sideways"):
        keypoints_of_mask(np.ones((20, 20), bool), "sideways")
