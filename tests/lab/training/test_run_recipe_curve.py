"""The curve of a training: a table and a drawing that grow."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from cucumbervision_lab.detection.pictures import Frame, TrueFruit
from cucumbervision_lab.training.checkpoint import read_rows, write_rows
from cucumbervision_lab.training.run_recipe import Curve, draw_curve


def test_rows_keep_all_columns_and_are_drawn(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    table = tmp_path / "curve.csv"
    write_rows(table, [{"pictures": 400, "drawn_map50": 0.5}])
    write_rows(table, [*read_rows(table), {"pictures": 800, "drawn_map50": 0.6, "map": 0.4}])
    assert read_rows(table) == [
        {"pictures": "400", "drawn_map50": "0.5", "map": ""},
        {"pictures": "800", "drawn_map50": "0.6", "map": "0.4"},
    ]
    assert not list(tmp_path.glob("*.part"))
    draw_curve(table, tmp_path / "curve.png")
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert read_rows(tmp_path / "none.csv") == []


@pytest.mark.train
@pytest.mark.skipif(
    importlib.util.find_spec("ultralytics") is None or importlib.util.find_spec("onnx") is None,
    reason="needs the extra 'train'",
)
def test_a_network_is_judged_as_it_would_be_shipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pycocotools")
    import cv2

    from cucumbervision_lab.detection.photos import Photo
    from cucumbervision_lab.synthesis.generate import generate, parse_options
    from cucumbervision_lab.training.checkpoint import import_ultralytics

    options = parse_options(
        frames=2, seed=3, size="96x64", shares="0,1,0", split="test", depth=False
    )
    generate(options, tmp_path / "drawn")
    cv2.imwrite(str(tmp_path / "a.png"), np.full((64, 96, 3), 90, np.uint8))
    truth = Frame("a.png", "s", 96, 64, (TrueFruit(np.array([9.5, 9.5, 50.5, 20.5])),))
    curve = Curve("seg", tmp_path, tmp_path / "drawn", tmp_path)
    photo = Photo(truth, tmp_path / "a.png", "board", "first audit")
    monkeypatch.setattr(Curve, "_audited", [photo])
    ultralytics = import_ultralytics()
    ultralytics.YOLO("yolo26n-seg.yaml").save(tmp_path / "new.pt")
    # A point that is there already is judged anew, and stands in its order.
    write_rows(tmp_path / "curve.csv", [{"pictures": 800}, {"pictures": 400}])
    point = curve.judge(tmp_path / "new.pt", 800)
    # A network with random weights is never sure.
    assert point["photos all: recall"] == point["half first audit: recall"] == 0.0
    assert 0.0 <= point["drawn_map50_95"] <= point["drawn_map50"] < 0.2
    rows = read_rows(tmp_path / "curve.csv")
    assert [(row["pictures"], row["photos all: recall"]) for row in rows] == [
        ("400", ""),
        ("800", "0.0000"),
    ]
