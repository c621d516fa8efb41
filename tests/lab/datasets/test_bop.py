from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cucumbervision.capture.files import read_color, read_depth, read_mask
from cucumbervision.capture.readers import open_source
from cucumbervision.errors import DataSetError
from cucumbervision.geometry.camera import Distortion
from cucumbervision_lab.datasets.bop import write_bop
from cucumbervision_lab.datasets.labels import DataSet, Label

MakeSet = Callable[..., DataSet]


def test_our_own_reader_reads_the_captures(make_set: MakeSet, tmp_path: Path) -> None:
    dataset = make_set("train train test")
    scenes = write_bop(dataset, tmp_path / "bop")
    assert scenes == tuple(tmp_path / f"bop/{s}/000000" for s in ("train", "test"))
    source = open_source(tmp_path / "bop")
    captures = sorted((ref.load() for ref in source), key=lambda c: (c.source, c.frame))
    order = [dataset.pictures[k] for k in (2, 0, 1)]
    for capture, picture in zip(captures, order, strict=True):
        assert (capture.color == read_color(dataset.path(picture))).all()
        assert picture.depth_file is not None
        raw = read_depth(dataset.folder / picture.depth_file)
        np.testing.assert_allclose(capture.depth_m, raw * 0.001, atol=1e-6)
        assert picture.camera is not None
        assert capture.intrinsics == picture.camera
        for mask, label in zip(capture.masks, picture.labels, strict=True):
            assert (mask == label.mask).all()


def test_truth_files(make_set: MakeSet, tmp_path: Path) -> None:
    dataset = make_set("train")
    (scene,) = write_bop(dataset, tmp_path / "bop")
    info = json.loads((scene / "scene_gt_info.json").read_text())["0"][0]
    assert info == {
        "bbox_obj": [20, 40, 60, 16],
        "bbox_visib": [20, 40, 45, 16],
        "px_count_all": 960,
        "px_count_valid": 960,
        "px_count_visib": 720,
        "visib_fract": 0.75,
    }
    label = dataset.pictures[0].labels[0]
    assert (read_mask(scene / "mask/000000_000000.png", (120, 160)) == label.amodal).all()
    truth = json.loads((scene / "scene_gt.json").read_text())["0"][0]
    # From (0, 0.1, 0.5) to (0.3, 0.1, 0.5) m: along x, its middle at 150 mm.
    assert truth["obj_id"] == 1
    assert truth["cam_t_m2c"] == [150, 100, 500]
    rotation = np.array(truth["cam_R_m2c"]).reshape(3, 3)
    assert rotation[:, 0].tolist() == [1, 0, 0]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-8)
    assert np.linalg.det(rotation) == pytest.approx(1)


def test_what_is_to_be_ignored_or_has_no_axis(make_set: MakeSet, tmp_path: Path) -> None:
    dataset = make_set("-")
    picture = dataset.pictures[0]
    bare = replace(picture.labels[0], amodal_code=None, extras={})
    crate = Label(np.array([1.0, 1, 9, 9]), ignore=True)
    (scene,) = write_bop(
        replace(dataset, pictures=(replace(picture, labels=(crate, bare)),)), tmp_path / "bop"
    )
    assert scene == tmp_path / "bop/all/000000"
    assert json.loads((scene / "scene_gt.json").read_text()) == {"0": [{"obj_id": 1}]}
    info = json.loads((scene / "scene_gt_info.json").read_text())["0"]
    assert [row["visib_fract"] for row in info] == [1.0]


def test_what_bop_cannot_say_is_refused(make_set: MakeSet, tmp_path: Path) -> None:
    dataset = make_set("train")
    picture = dataset.pictures[0]
    assert picture.camera is not None
    lens = replace(
        picture.camera, distortion=Distortion.BROWN_CONRADY, coefficients=(0.1, 0, 0, 0, 0)
    )
    for changed, fault in (
        (replace(picture, depth_file=None), "have no depth, first images/000000.png"),
        (replace(picture, camera=None), "have no camera"),
        (replace(picture, camera=lens), "lens distortion"),
        (replace(picture, labels=(Label(np.array([1.0, 1, 9, 9])),)), "a fruit without mask"),
    ):
        with pytest.raises(DataSetError, match=fault):
            write_bop(replace(dataset, pictures=(changed,)), tmp_path / "bop")
    assert not (tmp_path / "bop").exists()
