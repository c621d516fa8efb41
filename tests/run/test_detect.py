from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from cucumbervision.capture.frames import Capture
from cucumbervision.capture.source import CaptureRef
from cucumbervision.errors import CucumberVisionError, ModelError
from cucumbervision.fruit.mask_codes import decode_rle
from cucumbervision.networks.registry import Registry
from cucumbervision.run.batch import Item
from cucumbervision.run.detect import DetectResult, detect_inputs, find_pictures
from cucumbervision.run.measurer import Failure
from cucumbervision.run.options import MeasureOptions


@pytest.fixture(scope="module")
def photos(row_a: Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The capture's picture twice, in two formats, beside a broken file and a text."""
    folder = tmp_path_factory.mktemp("photos")
    (folder / "more").mkdir()
    for name in ("a.png", "more/a.webp"):
        ok, data = cv2.imencode(Path(name).suffix, row_a.color[..., ::-1])
        assert ok
        (folder / name).write_bytes(data.tobytes())
    (folder / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 no more")
    (folder / "notes.txt").write_text("taken in May")
    return folder


@pytest.fixture(scope="module")
def run(
    photos: Path, own_registry: Registry, tmp_path_factory: pytest.TempPathFactory
) -> tuple[DetectResult, list[tuple[int, int]]]:
    seen: list[tuple[int, int]] = []
    out = tmp_path_factory.mktemp("out")
    result = detect_inputs(
        [photos], out, MeasureOptions(), lambda *done: seen.append(done), own_registry
    )
    return result, seen


def read(result: DetectResult, name: str) -> Any:
    return json.loads((result.out / name).read_text(encoding="utf-8"))


def test_bad_pictures_lose_nothing_of_the_rest(
    run: tuple[DetectResult, list[tuple[int, int]]],
) -> None:
    result, seen = run
    assert [picture.name for picture in result.pictures] == ["a.png", "more/a.webp"]
    assert [len(picture.fruit) for picture in result.pictures] == [3, 3]
    assert result.skipped == 1
    assert seen == [(1, 3), (2, 3), (3, 3)]
    with (result.out / "failures.csv").open(encoding="utf-8-sig") as stream:
        (failure,) = csv.DictReader(stream)
    assert failure["error"] == "CaptureError"
    assert "broken.jpg: is truncated or damaged" in failure["message"]


def test_results_are_in_the_originals_pixels(
    run: tuple[DetectResult, list[tuple[int, int]]], row_a: Capture
) -> None:
    result, _ = run
    entries = read(result, "results.json")
    assert [e["image_id"] for e in entries] == [1, 1, 1, 2, 2, 2]
    assert {e["file_name"] for e in entries} == {"a.png", "more/a.webp"}
    for entry, mask in zip(entries[:3], row_a.masks, strict=True):
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        # COCO counts from the corner: the outermost pixels' edges are whole numbers.
        box = [columns[0], rows[0], columns[-1] + 1 - columns[0], rows[-1] + 1 - rows[0]]
        assert entry["bbox"] == pytest.approx(box, abs=0.01)
        code = entry["segmentation"]
        drawn = decode_rle(code["counts"], *code["size"])
        assert np.count_nonzero(drawn & mask) / np.count_nonzero(drawn | mask) > 0.9
        assert entry["mask_source"] == "sam"
        assert len(entry["keypoints"]) == 15
        # The blossom end hangs; the axis ends there, but for the rounding of a thin tip.
        assert entry["keypoints"][1] == pytest.approx(rows[-1] + 0.5, abs=0.03 * np.ptp(rows))
        assert entry["num_keypoints"] == 5
    assert [e["score"] for e in entries[:3]] == [0.9, 0.85, 0.8]


def test_pictures_classes_and_provenance(run: tuple[DetectResult, list[tuple[int, int]]]) -> None:
    result, _ = run
    page = read(result, "images.json")
    assert page["images"][1] == {"id": 2, "file_name": "more/a.webp", "width": 848, "height": 480}
    assert [(c["id"], c["name"]) for c in page["categories"]] == [(1, "cucumber")]
    assert page["categories"][0]["keypoints"][0] == "blossom_end"
    names = [m["name"] for m in page["info"]["models"]]
    assert names == ["tiny-segment", "tiny-pose", "mobile-sam"]
    assert page["info"]["options"]["segmenter"] is None


def test_coco_tools_load_and_score_it(
    run: tuple[DetectResult, list[tuple[int, int]]], row_a: Capture, tmp_path: Path
) -> None:
    coco = pytest.importorskip("pycocotools.coco")
    coder = pytest.importorskip("pycocotools.mask")
    evaluation = pytest.importorskip("pycocotools.cocoeval")
    result, _ = run
    page = read(result, "images.json")
    for image in page["images"]:
        for mask, entry in zip(row_a.masks, read(result, "results.json"), strict=False):
            code = coder.encode(np.asfortranarray(mask.astype(np.uint8)))
            truth = {"id": len(page["annotations"]) + 1, "image_id": image["id"], "iscrowd": 0}
            truth |= {
                "category_id": 1,
                "area": int(mask.sum()),
                "bbox": coder.toBbox(code).tolist(),
            }
            truth["segmentation"] = {**code, "counts": code["counts"].decode()}
            points = np.array(entry["keypoints"]).reshape(5, 3)
            points[:, 2] = 2
            truth |= {"keypoints": points.ravel().tolist(), "num_keypoints": 5}
            page["annotations"].append(truth)
    (tmp_path / "truth.json").write_text(json.dumps(page))
    truth_set = coco.COCO(str(tmp_path / "truth.json"))
    found = truth_set.loadRes(str(result.out / "results.json"))
    for kind in ("bbox", "segm", "keypoints"):
        scored = evaluation.COCOeval(truth_set, found, kind)
        if kind == "keypoints":
            scored.params.kpt_oks_sigmas = np.full(5, 0.05)
        scored.evaluate()
        scored.accumulate()
        scored.summarize()
        assert scored.stats[1] == 1.0  # mAP50


def test_an_overlay_for_each_picture(run: tuple[DetectResult, list[tuple[int, int]]]) -> None:
    result, _ = run
    names = sorted(path.name for path in (result.out / "overlays").iterdir())
    assert names == ["a.jpg", "more_a.jpg"]
    picture = cv2.imread(str(result.out / "overlays" / "a.jpg"))
    assert picture is not None
    assert picture.shape == (480, 848, 3)


def test_the_detectors_masks(
    photos: Path, own_registry: Registry, row_a: Capture, tmp_path: Path
) -> None:
    options = MeasureOptions(segmenter="none", confidence=0.82)
    result = detect_inputs([photos / "a.png"], tmp_path, options, registry=own_registry)
    entries = read(result, "results.json")
    assert [e["mask_source"] for e in entries] == ["detector"] * 2
    assert [m["name"] for m in result.models] == ["tiny-segment", "tiny-pose"]


def test_ones_own_networks(
    photos: Path, own_networks: dict[str, Path], bare_registry: Registry, tmp_path: Path
) -> None:
    options = MeasureOptions(instances=str(own_networks["pose"]), segmenter="none")
    result = detect_inputs([photos / "a.png"], tmp_path, options, registry=bare_registry)
    entries = read(result, "results.json")
    assert len(entries) == 3
    assert all("segmentation" not in e and e["num_keypoints"] == 5 for e in entries)
    options = MeasureOptions(instances=str(own_networks["segment"]), segmenter="none")
    result = detect_inputs([photos / "a.png"], tmp_path, options, registry=bare_registry)
    assert all("keypoints" not in e for e in read(result, "results.json"))


def test_a_run_that_cannot_start_says_why(
    photos: Path, own_registry: Registry, bare_registry: Registry, tmp_path: Path
) -> None:
    with pytest.raises(ModelError, match=r"without a cucumber detector; .*--instances"):
        detect_inputs([photos], tmp_path / "out", MeasureOptions(), registry=bare_registry)
    (tmp_path / "file").write_text("")
    with pytest.raises(CucumberVisionError, match=r"file/out: cannot be written"):
        detect_inputs([photos], tmp_path / "file/out", MeasureOptions(), registry=own_registry)


def test_an_interrupted_run_leaves_what_it_found(
    photos: Path, own_registry: Registry, tmp_path: Path
) -> None:
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    options = MeasureOptions(segmenter="none")
    with pytest.raises(KeyboardInterrupt):
        detect_inputs([photos], tmp_path, options, stop, own_registry)
    assert len(json.loads((tmp_path / "results.json").read_text())) == 3
    assert len(json.loads((tmp_path / "images.json").read_text())["images"]) == 1


def names(items: list[Item]) -> list[str]:
    return [one.name for one in items if isinstance(one, CaptureRef)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in (
        "b/2.webp",
        "b/1.jpg",
        "a.JPEG",
        "c.tiff",
        "notes.txt",
        ".hidden.jpg",
        ".git/x.png",
    ):
        path = tmp_path / "photos" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")
    return tmp_path / "photos"


def test_a_folder_gives_its_pictures_by_name_and_counts_the_rest(folder: Path) -> None:
    found, skipped = find_pictures([folder])
    assert names(found) == ["a.JPEG", "b/1.jpg", "b/2.webp", "c.tiff"]
    assert skipped == 1


def test_a_named_file_is_a_picture_whatever_it_is_called(folder: Path) -> None:
    found, skipped = find_pictures([str(folder / "notes.txt")])
    assert (names(found), skipped) == (["notes.txt"], 0)


def test_a_file_is_looked_at_once_and_names_differ(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "other" / "a.JPEG"
    other.parent.mkdir()
    other.write_bytes(b"x")
    found, _ = find_pictures([folder / "a.JPEG", folder, other])
    assert names(found) == ["a.JPEG", "b/1.jpg", "b/2.webp", "c.tiff", other.as_posix()]


def test_results_of_an_earlier_run_are_no_pictures(folder: Path) -> None:
    out = folder / "b"
    assert names(find_pictures([folder], out)[0]) == ["a.JPEG", "c.tiff"]
    # Unless they are named.
    assert len(find_pictures([out / "1.jpg"], out)[0]) == 1


def test_what_is_not_there_is_told(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    found, _ = find_pictures([tmp_path / "none.jpg", tmp_path / "empty"])
    assert [one.message for one in found if isinstance(one, Failure)] == [
        f"{tmp_path}/none.jpg: does not exist; check the path",
        f"{tmp_path}/empty: there are no images; name JPEG, PNG, WebP, TIFF or BMP files, or a "
        "folder with some",
    ]
