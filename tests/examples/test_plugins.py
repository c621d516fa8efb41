"""The example's plug-ins, by argument and as an installed package with entry points."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.constant_network import constant_network

from cucumbervision import (
    Capture,
    MaskSource,
    MeasureOptions,
    Measurer,
    PlugIns,
    TableTrait,
    example_captures,
    measure,
    open_source,
    plugins,
)
from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.pictures import write_png
from cucumbervision.errors import PluginError
from cucumbervision.fruit.masks import box_ious
from cucumbervision.methods.flags import Flag
from cucumbervision.run.fields import FIELDS

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "plugins.py"
METADATA = "Metadata-Version: 2.1\nName: cucumber-extras\nVersion: {}\n"
ENTRY_POINTS = """
[cucumbervision.detectors]
rt-detr = cucumber_extras:RtDetr
[cucumbervision.segmenters]
grabcut = cucumber_extras:GrabCut
[cucumbervision.methods]
M6 = cucumber_extras:BOX_DIAGONAL
M7 = cucumber_extras:BOX_DIAGONAL
M8 = cucumber_extras:nothing
[cucumbervision.traits]
mean_green = cucumber_extras:MEAN_GREEN
[cucumbervision.readers]
tum = cucumber_extras:find_tum
"""


@pytest.fixture
def bench() -> Capture:
    return next(iter(open_source(example_captures() / "simulated-bench"))).load()


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(EXAMPLE.parent))
    sys.modules.pop("plugins", None)
    import plugins as example_module  # type: ignore[import-not-found]

    yield example_module
    sys.modules.pop("plugins", None)


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Install the example as the package cucumber-extras 2.1, in a folder on the path."""
    folder = tmp_path / "site"
    about = folder / "cucumber_extras-2.1.dist-info"
    about.mkdir(parents=True)
    shutil.copyfile(EXAMPLE, folder / "cucumber_extras.py")
    (about / "METADATA").write_text(METADATA.format("2.1"))
    (about / "entry_points.txt").write_text(ENTRY_POINTS)
    monkeypatch.syspath_prepend(str(folder))
    plugins.forget()
    yield folder
    sys.modules.pop("cucumber_extras", None)
    monkeypatch.undo()
    plugins.forget()


def save_rt_detr(path: Path, boxes: NDArray[np.float32], scores: list[float]) -> None:
    """Save a network in RT-DETR's layout that always finds the same boxes."""
    logits = np.full((1, len(boxes), 2), -9.0, np.float32)
    logits[0, :, 1] = np.log(np.array(scores) / (1 - np.array(scores)))
    names, shape = ("logits", "pred_boxes"), (1, 3, 640, 640)
    path.write_bytes(
        constant_network(logits, boxes[None], shape=shape, image="pixel_values", names=names)
    )


def boxes_of(capture: Capture) -> NDArray[np.float64]:
    boxes = []
    for mask in capture.masks:
        rows, columns = np.nonzero(mask)
        boxes.append([columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5])
    return np.array(boxes)


def shares(boxes: NDArray[np.float64], capture: Capture) -> NDArray[np.float32]:
    """Return boxes as centre and size, shares of the picture."""
    size = np.array([capture.width, capture.height])
    first, last = (boxes[:, :2] + 0.5) / size, (boxes[:, 2:] + 0.5) / size
    return np.hstack([(first + last) / 2, last - first]).astype(np.float32)


def test_rt_detr_finds_and_grabcut_draws(bench: Capture, example: Any, tmp_path: Path) -> None:
    boxes = boxes_of(bench)
    all_boxes = np.vstack([shares(boxes, bench), np.full((1, 4), 0.1, np.float32)])
    save_rt_detr(tmp_path / "detr.onnx", all_boxes, [0.9, 0.8, 0.7, 0.3])
    detector = example.RtDetr(str(tmp_path / "detr.onnx"), class_id=1)
    result = measure([bench], instances=detector, segmenter=example.GrabCut())
    assert len(result.fruit) == 3  # the fourth is below the confidence
    found = np.array([fruit.instance.box for fruit in result.fruit])
    assert np.diag(box_ious(found, boxes)).min() > 0.99
    by_masks = measure([bench], instances="dataset")
    for fruit, own in zip(result.fruit, by_masks.fruit, strict=True):
        assert fruit.mask_source is MaskSource.SEGMENTER
        assert fruit.length is not None
        assert own.length is not None
        assert fruit.length.value_m == pytest.approx(own.length.value_m, rel=0.08)
    named = {(m["kind"], m["name"]) for m in result.captures[0].models if "package" in m}
    assert named == {("detector", "RtDetr"), ("segmenter", "GrabCut")}


def test_sam_2_draws_each_box(
    bench: Capture, example: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Predictor:
        """Stands in for SAM2ImagePredictor."""

        def __init__(self, model: tuple[str, str]) -> None:
            assert model == ("config.yaml", "sam2.pt")

        set_image = staticmethod(np.shape)

        def predict(self, box: NDArray[np.float64], multimask_output: bool) -> tuple[Any, ...]:
            assert not multimask_output
            k = int(np.abs(boxes_of(bench) + 0.5 - box).sum(axis=1).argmin())
            return bench.masks[k][None].astype(np.float32), np.array([0.9]), None

    build, predictor = ModuleType("sam2.build_sam"), ModuleType("sam2.sam2_image_predictor")
    build.build_sam2 = lambda *model, device: model  # type: ignore[attr-defined]
    predictor.SAM2ImagePredictor = Predictor  # type: ignore[attr-defined]
    for module in (ModuleType("sam2"), build, predictor):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setenv("SAM2_CONFIG", "config.yaml")
    monkeypatch.setenv("SAM2_FILE", "sam2.pt")
    result = measure([bench], instances="dataset", segmenter=example.Sam2())
    for fruit, mask in zip(result.fruit, bench.masks, strict=True):
        assert fruit.mask is not None
        assert (fruit.mask == mask).mean() > 0.999


def test_what_is_installed_gives_columns_and_leaves_the_rest_alone(
    bench: Capture, package: Path
) -> None:
    plain = [field.name for field in FIELDS]
    result = measure([bench], instances="dataset")
    rows = result.rows()
    assert [*rows[0]] == [*plain, "m7_cm", "m8_cm", "mean_green"]
    for row, fruit, mask in zip(rows, result.fruit, bench.masks, strict=True):
        assert row["method"] == "M6"  # the selector never takes what has no rank
        assert row["m6_cm"] == row["length_cm"]
        assert row["m7_cm"] is not None
        assert row["m8_cm"] is None
        assert row["mean_green"] == pytest.approx(bench.color[mask][:, 1].mean() / 255, abs=1e-4)
        assert Flag.PLUGIN_FAILED not in fruit.flags
    # A name that is taken, and what cannot be loaded, are said.
    words = "\n".join(failure.message for failure in result.failures)
    assert "the method M6 has a name that is taken" in words
    assert "the method M8 cannot be loaded" in words
    assert all(failure.error == "PluginError" for failure in result.failures)
    models = result.captures[0].models
    assert {"kind": "trait", "name": "mean_green", "package": "cucumber-extras"}.items() <= next(
        model for model in models if model["name"] == "mean_green"
    ).items()


def test_the_command_uses_what_is_installed_and_says_so(
    bench: Capture, package: Path, tmp_path: Path
) -> None:
    save_rt_detr(tmp_path / "detr.onnx", shares(boxes_of(bench), bench), [0.9, 0.8, 0.7])
    code = (
        "import os, sys\n"
        f"sys.path.insert(0, {str(package)!r})\n"
        f"os.environ['RTDETR_ONNX'] = {str(tmp_path / 'detr.onnx')!r}\n"
        "import cucumber_extras\n"
        "cucumber_extras.RtDetr.__init__.__defaults__ = (None, 1, 0.5)\n"
        "from cucumbervision.cli.app import main\n"
        "main()\n"
    )
    folder = tmp_path / "sequence"
    (folder / "rgb").mkdir(parents=True)
    write_png(folder / "rgb" / "bench.png", bench.color)
    write_png(folder / "1.02.png", np.rint(5000 * bench.depth_m).astype(np.uint16))
    (folder / "associations.txt").write_text("1.0 rgb/bench.png 1.02 1.02.png\n")
    camera = CameraModel.of(bench.intrinsics).model_dump_json()
    (tmp_path / "camera.json").write_text(camera)
    out = tmp_path / "run"
    arguments = ["measure", str(folder), "--intrinsics", str(tmp_path / "camera.json")]
    arguments += ["--instances", "rt-detr", "--segmenter", "grabcut"]

    def run() -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", code, *arguments, "--out", str(out)]
        return subprocess.run(command, capture_output=True, text=True, timeout=300)

    first = run()
    assert first.returncode == 1, first.stderr
    # Two of the package's plug-ins cannot be used.
    with (out / "measurements.csv").open(encoding="utf-8-sig") as lines:
        rows = list(csv.DictReader(lines))
    assert len(rows) == 3
    assert all(row["m7_cm"] and row["mean_green"] for row in rows)
    report = json.loads((out / "measurements.json").read_text(encoding="utf-8"))
    named = {plugin["name"]: plugin["version"] for plugin in report["plugins"]}
    assert named == dict.fromkeys(("rt-detr", "grabcut", "M7", "mean_green", "tum"), "2.1")
    assert "1 of them by an earlier run" in run().stdout
    # A new version of the package may measure differently.
    about = package / "cucumber_extras-2.1.dist-info"
    newer = about.rename(about.with_name("cucumber_extras-2.2.dist-info"))
    (newer / "METADATA").write_text(METADATA.format("2.2"))
    assert "by an earlier run" not in run().stdout


class Broken:
    """A segmenter, detector or trait that fails."""

    def __call__(self, *_: Any) -> Any:
        raise RuntimeError("no licence")

    def segment(self, color_rgb: Any, instances: Any, /) -> Any:
        return instances[:1]


def test_what_fails_leaves_the_rest_of_the_row(bench: Capture) -> None:
    trait = TableTrait("firmness_mm", "mm", "firmness", Broken())
    wrong = TableTrait("size_mm", "mm", "size", lambda capture, fruit: float("nan"))
    plain = measure([bench], instances="dataset")
    result = measure([bench], instances="dataset", traits=[trait, wrong])
    for row, own in zip(result.rows(), plain.rows(), strict=True):
        assert row["firmness_mm"] is None
        assert row["size_mm"] is None
        assert row["length_cm"] == own["length_cm"]
        assert "plugin-failed" in str(row["flags"])
    words = {failure.message for failure in result.failures}
    assert any("firmness_mm failed (RuntimeError: no licence)" in line for line in words)
    assert any("size_mm returned nan in place of a finite number" in line for line in words)

    detector = measure([bench], instances=Broken())
    assert len(detector.captures) == 0
    assert detector.failures[0].error == "PluginError"
    segmenter = Measurer(
        MeasureOptions(instances="dataset"), plug_ins=PlugIns(segmenter=Broken())
    ).attempt(bench)
    assert "returned 1 masks for 3 fruit" in segmenter.failures[0].message


def test_a_trait_needs_a_unit_and_a_name_that_ends_with_it(bench: Capture) -> None:
    for trait in (
        TableTrait("firmness", "mm", "firmness", lambda capture, fruit: 1.0),
        TableTrait("two words", "", "x", lambda capture, fruit: 1.0),
    ):
        result = measure([bench], instances="dataset", traits=[trait])
        assert [failure.error for failure in result.failures] == ["PluginError"]
        assert trait.name not in result.rows()[0]


def test_a_missing_plug_in_is_named() -> None:
    with pytest.raises(PluginError, match="the trait x cannot be loaded"):
        plugins.Plugin("traits", "x", "no_such_module:x", "other", "1").load()
