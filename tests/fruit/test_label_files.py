from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cucumbervision.errors import InstancesError
from cucumbervision.fruit.instance import MaskSource
from cucumbervision.fruit.label_files import LabelledInstance, parse_yolo_line, read_instances
from cucumbervision.fruit.mask_codes import encode_rle


@pytest.mark.parametrize(
    ("name", "content", "fault"),
    [
        ("a.json", "{", "is not JSON"),
        ("a.json", "{}", "no annotations"),
        ("a.json", '[{"bbox": [0, 0, 1, 1]}]', "names no picture"),
        ("a.csv", "1,2", "unknown kind"),
        ("a.txt", None, "no such file"),
        ("folder", None, "no such file"),
    ],
)
def test_other_files_are_refused(
    tmp_path: Path, name: str, content: str | None, fault: str
) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_text(content, encoding="utf-8")
    with pytest.raises(InstancesError, match=fault):
        read_instances(path)


WIDTH, HEIGHT = 20, 10


def coco(path: Path, *annotations: dict[str, Any], **image: Any) -> Path:
    data = {
        "images": [{"id": 7, "file_name": "row1/a.png", **image}],
        "categories": [{"id": 3, "name": "cucumber"}],
        "annotations": [
            {"id": i, "image_id": 7, "category_id": 3, **a} for i, a in enumerate(annotations)
        ],
    }
    path.write_text(json.dumps(data), encoding="utf-8")
    return path


def get(path: Path, name: str = "a") -> Any:
    instances, refused = read_instances(path).for_capture([name], WIDTH, HEIGHT)
    return SimpleNamespace(instances=instances, refused=refused)


def test_coco_box_moves_to_pixel_centres(tmp_path: Path) -> None:
    # Some tools write sizes as text.
    found = get(coco(tmp_path / "c.json", {"bbox": [2, 1, 5, 4]}, width="20", height="10.0"))
    (fruit,) = found.instances
    assert fruit.box.tolist() == [1.5, 0.5, 6.5, 4.5]
    assert (fruit.class_name, fruit.confidence, fruit.mask) == ("cucumber", 1.0, None)
    assert (fruit.is_clipped, found.refused) == (False, ())


def test_coco_polygons_join_to_one_mask(tmp_path: Path) -> None:
    parts = [[2, 1, 5, 1, 5, 3, 2, 3], [8, 1, 9, 1, 9, 2, 8, 2]]
    (fruit,) = get(coco(tmp_path / "c.json", {"segmentation": parts})).instances
    expected = np.zeros((HEIGHT, WIDTH), bool)
    expected[1:3, 2:5] = expected[1, 8] = True
    assert fruit.mask is not None
    assert np.array_equal(fruit.mask, expected)
    assert fruit.mask_source is MaskSource.DATASET
    assert fruit.box.tolist() == [1.5, 0.5, 8.5, 2.5]


@pytest.mark.parametrize("packed", [False, True])
def test_coco_run_lengths(tmp_path: Path, packed: bool) -> None:
    # Down the columns of ten: pixels 25 to 27 are column 2, rows 5 to 7; 35 to 37 column 3.
    expected = np.zeros((HEIGHT, WIDTH), bool)
    expected[5:8, 2:4] = True
    counts = encode_rle(expected) if packed else [25, 3, 7, 3, 162]
    rle = {"size": [HEIGHT, WIDTH], "counts": counts}
    (fruit,) = get(coco(tmp_path / "c.json", {"segmentation": rle})).instances
    assert fruit.mask is not None
    assert np.array_equal(fruit.mask, expected)


def test_coco_keypoints(tmp_path: Path) -> None:
    points = [v for i in range(5) for v in (i + 1, 2, i % 3)]
    (fruit,) = get(coco(tmp_path / "c.json", {"bbox": [0, 0, 9, 9], "keypoints": points})).instances
    assert fruit.keypoints is not None
    assert fruit.keypoints[1].tolist() == [1.5, 1.5, 0.5]
    assert fruit.keypoints[:, 2].tolist() == [0, 0.5, 1, 0, 0.5]


@pytest.mark.parametrize(
    "name",
    [
        *("C:\\Users\\ana\\row1\\a.png", "\\\\server\\share\\a.png", "..\\a.png", "row1\\./a.png"),
        "\\\\?\\C:\\" + "x" * 200 + "\\" + "y" * 200 + "\\a.png",
    ],
)
def test_names_as_windows_writes_them(name: str, tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    path.write_text(json.dumps([{"file_name": name, "category_id": 0, "bbox": [1, 1, 2, 2]}]))
    assert len(get(path, "a.png").instances) == 1
    assert get(path, "b.png").instances == ()


def test_pictures_are_found_by_name_stem_or_number(tmp_path: Path) -> None:
    file = read_instances(coco(tmp_path / "c.json", {"bbox": [2, 1, 5, 4]}))
    for name in ("row1/a.png", "a.png", "row1/a.jpg", "a"):
        assert len(file.for_capture([name], WIDTH, HEIGHT)[0]) == 1
    # Another row's picture of the same name is not the one that was labelled.
    assert file.for_capture(["other/a.png"], WIDTH, HEIGHT)[0] == ()
    assert file.for_capture(["a", "walk/other/a.png"], WIDTH, HEIGHT)[0] == ()
    # Its image id is no running number: the seventh capture of a folder is another picture.
    assert file.for_capture(["b"], WIDTH, HEIGHT, frame=7)[0] == ()


def test_ids_count_only_where_a_file_has_no_names(tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    path.write_text(json.dumps([{"image_id": 7, "category_id": 0, "bbox": [1, 1, 2, 2]}]))
    file = read_instances(path)
    assert len(file.for_capture(["b"], WIDTH, HEIGHT, frame=7)[0]) == 1
    assert file.for_capture(["b"], WIDTH, HEIGHT, frame=8)[0] == ()


def test_the_folder_in_a_name_tells_two_captures_of_one_name_apart(tmp_path: Path) -> None:
    box = {"bbox": [1, 1, 5, 5]}
    file = read_instances(coco(tmp_path / "c.json", box, file_name="a/rgb_1.png"))
    assert file.find(("rgb_1", "a/rgb_1.png"), 0) is file.pictures[0]
    assert file.find(("rgb_1-2", "b/rgb_1.png"), 1) is None


def test_another_size_is_refused(tmp_path: Path) -> None:
    path = coco(tmp_path / "c.json", {"bbox": [2, 1, 5, 4]}, width=40, height=20)
    with pytest.raises(InstancesError, match="the size 40x20, the picture is 20x10"):
        get(path)


def test_more_masks_than_memory_holds_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outlines = [{"segmentation": [[k, 1, k + 3, 1, k + 4, 3, k, 4]]} for k in (1, 6, 11)]
    path = coco(tmp_path / "c.json", *outlines, {"bbox": [2, 1, 5, 4]})
    monkeypatch.setattr("cucumbervision.fruit.label_files._MOST_MASK_BYTES", 600)
    assert len(get(path).instances) == 4
    monkeypatch.setattr("cucumbervision.fruit.label_files._MOST_MASK_BYTES", 599)
    with pytest.raises(InstancesError, match=r"has 3 masks of 20x10 pixels in .*at most 2 are"):
        get(path)


def test_bad_annotations_are_named_and_the_rest_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    found = get(
        coco(
            path,
            {"bbox": [15, 1, 10, 4]},
            {"bbox": [30, 1, 5, 4]},
            {"bbox": [float("nan"), 1, 5, 4]},
            {"bbox": [1, 1, 0, 4]},
            {"bbox": [1, 1, 2]},
            {"segmentation": {"size": [5, 5], "counts": [25]}},
            {"segmentation": {"size": [10, 20], "counts": [2**62] * 4 + [200]}},
            {"segmentation": {"size": [10, 20], "counts": "ooooooooooooooooo0"}},
            {"bbox": [1, 1, 10**400, 4]},
            {"segmentation": [[1, 1, 2, 2]]},
            {"segmentation": [[30, 30, 40, 30, 40, 40]]},
            {"iscrowd": 1, "bbox": [1, 1, 5, 5]},
            {"bbox": [1, 1, 5, 5], "score": 7},
            {},
        )
    )
    assert [f.box.tolist() for f in found.instances] == [[14.5, 0.5, 19.5, 4.5]]
    assert [f.is_clipped for f in found.instances] == [True]
    assert read_instances(path).crowds == 1  # passed over
    faults = [
        "no area inside the picture",
        "not finite",
        "no area",
        "unpack",
        "mask of 5x5",
        "the run lengths do not fill 20x10 pixels",
        "a run length has more digits",
        "too large",
        "fewer than three",
        "covers no pixel",
        "the confidence is 7",
        "neither box nor mask",
    ]
    assert len(found.refused) == len(faults)
    told = "\n".join(sorted(str(r) for r in found.refused))
    for fault in faults:
        assert fault in told
    assert "annotation 1: " in told


def yolo(folder: Path, name: str, *lines: str) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / name).write_text("\n".join(lines), encoding="utf-8")
    return folder


def test_yolo_folder(tmp_path: Path) -> None:
    folder = yolo(tmp_path / "l", "a.txt", "1 0.5 0.5 0.2 0.4", "", "0 0.5 0.5 0.2 0.4 0.75")
    yolo(folder, "empty.txt")
    yolo(folder, "classes.txt", "leaf", "cucumber")
    first, second = get(folder, "a.png").instances
    # 20x10: centre (10, 5), 4 by 4, so 8 to 12 and 3 to 7 from the corner.
    assert first.box.tolist() == pytest.approx([7.5, 2.5, 11.5, 6.5])
    assert (first.class_name, first.confidence) == ("cucumber", 1.0)
    assert (second.class_name, second.confidence) == ("leaf", 0.75)
    assert get(folder, "empty").instances == ()
    assert get(folder, "b").instances == ()


def test_yolo_labels_folder_and_single_file(tmp_path: Path) -> None:
    yolo(tmp_path / "labels", "a.txt", "0 0.5 0.5 0.2 0.4")
    assert len(get(tmp_path).instances) == 1
    assert len(get(tmp_path / "labels" / "a.txt").instances) == 1


def test_yolo_polygon_and_pose(tmp_path: Path) -> None:
    points = " ".join(f"{0.1 * i:.1f} 0.5 {i % 3}" for i in range(5))
    folder = yolo(
        tmp_path / "l",
        "a.v1.txt",
        "0 0.1 0.1 0.2 0.1 0.3 0.1 0.3 0.3 0.1 0.3",
        f"0 .5 .5 .2 .4 {points}",
    )
    outline, pose = get(folder, "a.v1").instances
    expected = np.zeros((HEIGHT, WIDTH), bool)
    expected[1:3, 2:6] = True
    assert outline.mask is not None
    assert np.array_equal(outline.mask, expected)
    assert pose.keypoints is not None
    assert np.allclose(pose.keypoints[1], [1.5, 4.5, 0.5])


def test_yolo_boxes_beyond_the_edge_are_cut_and_bad_lines_named(tmp_path: Path) -> None:
    lines = ["0 0.05 0.5 0.2 0.4", "0 1.2 0.5 0.2 0.4", "0 320 200 40 60", "0 0.5 0.5 nan 0.4"]
    found = get(yolo(tmp_path / "l", "a.txt", *lines, "0 0.5 0.5", "x 0 0 1 1", "-1 0 0 1 1"))
    (fruit,) = found.instances
    assert fruit.box.tolist() == pytest.approx([-0.5, 2.5, 2.5, 6.5])
    assert [f.is_clipped for f in found.instances] == [True]
    told = [str(r) for r in found.refused]
    assert ["line 2: " in told[0], "line 3: " in told[1], "line 4: " in told[2]] == [True] * 3
    assert "outside 0 to 1" in told[0]
    assert "not finite" in told[2]
    assert len(told) == 6


def test_same_name_twice_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    items = [{"file_name": f"{d}/a.png", "bbox": [1, 1, 2, 2]} for d in "xy"]
    path.write_text(json.dumps(items), encoding="utf-8")
    file = read_instances(path)
    assert len(file.for_capture(["x/a.png"], WIDTH, HEIGHT)[0]) == 1
    with pytest.raises(InstancesError, match=r"names a\.png 2 times"):
        file.for_capture(["a.png"], WIDTH, HEIGHT)


@pytest.mark.parametrize(
    "label",
    [
        "1f3a9c02-color_1.png",  # Label Studio
        "images/1f3a9c02-color_1.png",
        "/data/upload/3/1f3a9c02-color_1.png",
        "color_1_png.rf.0f1e2d3c4b5a69788796a5b4c3d2e1f0.jpg",  # Roboflow
        "train/images/color_1_jpg.rf.0f1e2d3c4b5a69788796a5b4c3d2e1f0.jpg",
        "color%5F1.png",
    ],
)
def test_what_label_tools_add_to_names_is_left_out(tmp_path: Path, label: str) -> None:
    file = read_instances(coco(tmp_path / "c.json", {"bbox": [2, 1, 5, 4]}, file_name=label))
    names = ["color_1", "/home/ana/walk/color_1.png"]
    assert len(file.for_capture(names, WIDTH, HEIGHT)[0]) == 1
    assert file.for_capture(["color_11", "walk/color_11.png"], WIDTH, HEIGHT)[0] == ()


@pytest.mark.parametrize(
    "corners",
    [
        [2, 1, 12, 1, 12, 4, 2, 4],
        [2, 1, 12, 1, 12, 4, 2, 4, 2, 1],  # closed
        [4, 1, 10, 3, 9, 6, 3, 4],  # turned
    ],
)
def test_four_corners_of_a_rectangle_are_a_box(tmp_path: Path, corners: list[float]) -> None:
    (fruit,) = get(coco(tmp_path / "c.json", {"segmentation": [corners]})).instances
    assert fruit.mask is None
    xs, ys = corners[::2], corners[1::2]
    assert fruit.box.tolist() == [min(xs) - 0.5, min(ys) - 0.5, max(xs) - 0.5, max(ys) - 0.5]


def test_names_of_a_mac_are_those_of_others(tmp_path: Path) -> None:
    # A Mac writes u and a combining diaeresis, others the single letter.
    mac, other = "su\u0308d/su\u0308d_1", "s\u00fcd/s\u00fcd_1"
    for label, name in ((mac, other), (other, mac)):
        path = coco(tmp_path / "c.json", {"bbox": [2, 1, 5, 4]}, file_name=f"{label}.png")
        assert len(get(path, name).instances) == 1


FORMS = [(count, visibility) for count in (2, 3, 5, 8) for visibility in ("", " 2")]


@pytest.mark.parametrize("confidence", ["", " 0.9"])
@pytest.mark.parametrize(("count", "visibility"), [*FORMS, (5, " 0.97")])  # of a prediction
def test_yolo_keypoints_of_any_form_are_no_outline(
    tmp_path: Path, visibility: str, count: int, confidence: str
) -> None:
    # A box of 4 by 4 pixels about the middle, and points from its upper left to its lower right.
    shares = np.linspace([0.42, 0.35], [0.58, 0.65], count)
    points = " ".join(f"{x:.4f} {y:.4f}{visibility}" for x, y in shares)
    folder = yolo(tmp_path / "l", "a.txt", f"0 0.5 0.5 0.2 0.4 {points}{confidence}")
    (fruit,) = get(folder).instances
    assert fruit.mask is None
    assert fruit.box.tolist() == pytest.approx([7.5, 2.5, 11.5, 6.5])
    seen = None if fruit.keypoints is None else fruit.keypoints[0, 2]
    assert seen == ({" 0.97": 0.97}.get(visibility, 1.0) if count == 5 else None)
    assert fruit.confidence == (0.9 if confidence else 1.0)


def test_outlines_are_not_taken_for_keypoints(tmp_path: Path) -> None:
    rng, lines = np.random.default_rng(1), []
    for _ in range(2000):  # ellipses of any size, place, turn and beginning
        turn, start = rng.uniform(0, 2 * np.pi, 2)
        angle = start + np.linspace(0, 2 * np.pi, int(rng.integers(4, 40)), endpoint=False)
        along, across = rng.uniform(0.01, 0.25, 2)
        x, y = along * np.cos(angle), across * np.sin(angle)
        turned = np.stack(
            [x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn)], axis=1
        )
        shares = turned + rng.uniform(0.26, 0.74, 2)
        lines.append("0 " + " ".join(f"{share:.6f}" for share in shares.ravel()))
    alone = [parse_yolo_line(line, "line 1", []) for line in lines]
    assert sum(record.box is not None for record in alone) < 0.003 * len(lines)
    (picture,) = read_instances(yolo(tmp_path / "l", "a.txt", *lines)).pictures
    assert all(isinstance(r, LabelledInstance) and r.polygons for r in picture.records)


def test_two_labels_of_a_fruit_are_one_and_a_word(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    boxes = [{"bbox": [2, down, 12, tall]} for down, tall in ((1, 4), (1, 3.9), (5, 4))]
    path = coco(tmp_path / "c.json", *boxes)
    assert [fruit.box[1] for fruit in get(path).instances] == [0.5, 4.5]
    assert "annotation 1 labels the fruit of annotation 0 again" in caplog.text
    # Crossing fruit have like boxes, and other outlines.
    down, up = [1, 1, 3, 1, 11, 7, 11, 9, 9, 9, 1, 3], [9, 1, 11, 1, 11, 3, 3, 9, 1, 9, 1, 7]
    path = coco(tmp_path / "c.json", {"segmentation": [down]}, {"segmentation": [up]})
    assert len(get(path).instances) == 2
    assert "too" not in caplog.text
    # Halves of a fruit that share their ends are measured, with a word.
    left, right = [2, 1, 10, 1, 10, 7, 4, 7, 2, 5], [6, 1, 14, 1, 14, 5, 12, 7, 6, 7]
    path = coco(tmp_path / "c.json", {"segmentation": [left]}, {"segmentation": [right]})
    assert len(get(path).instances) == 2
    assert "annotation 1 labels part of annotation 0 too" in caplog.text
    # A part of a fruit before the whole of it is no fruit.
    part, whole = [4, 2, 6, 2, 8, 2, 8, 6, 4, 6], [2, 1, 6, 1, 14, 1, 14, 7, 2, 7]
    path = coco(tmp_path / "c.json", {"segmentation": [part]}, {"segmentation": [whole]})
    assert [fruit.box[0] for fruit in get(path).instances] == [1.5]
