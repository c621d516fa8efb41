"""Parity with Ultralytics' own predictions, from the packaged checkpoints."""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

if importlib.util.find_spec("ultralytics") is None:  # its import alone would ask the network
    pytest.skip("needs the extra 'train'", allow_module_level=True)
pytest.importorskip("onnx")

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import example_captures
from cucumbervision.errors import ModelError
from cucumbervision.fruit.instance import Instance
from cucumbervision.networks.runtime import open_network
from cucumbervision.networks.yolo import YoloDetector
from cucumbervision_lab.train import export
from cucumbervision_lab.train.export import export_yolo
from cucumbervision_lab.train.network import import_ultralytics, load_yolo

pytestmark = [pytest.mark.train, pytest.mark.usefixtures("_suppression")]

SIZE_PX = 160
CONFIDENCE = 0.30
TOLERANCE_PX, TOLERANCE = 0.02, 1e-3
SIZES = ((160, 160), (120, 200), (97, 233), (301, 75), (480, 640))


@pytest.fixture(scope="module")
def _suppression() -> Iterator[None]:
    """Let Ultralytics suppress boxes by itself where torchvision's operators do not load."""
    import_ultralytics()
    import torchvision
    from ultralytics.utils.nms import TorchNMS

    with pytest.MonkeyPatch.context() as patched:
        if not torchvision.extension._has_ops():
            patched.setattr(torchvision.ops, "nms", TorchNMS.nms)
        yield


@cache
def picture(height: int, width: int) -> NDArray[np.uint8]:
    """A row of fruit, drawn out to a size."""
    capture = next(iter(open_source(example_captures() / "simulated-row-a"))).load()
    resized = cv2.resize(capture.color, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(resized, np.uint8)


@pytest.fixture(scope="module", params=["seg", "pose"])
def checkpoint(request: pytest.FixtureRequest) -> Path:
    return checkpoint_of(request.param)


def checkpoint_of(kind: str) -> Path:
    path = Path(__file__).parents[3] / "checkpoints" / f"cucumber-{kind}.pt"
    if not path.is_file():
        pytest.skip("the source archive holds no checkpoints")
    return path


def ultralytics_export(checkpoint: Path, out: Path, nms: bool | None) -> Path:
    """Export as Ultralytics does by itself, which writes beside the checkpoint."""
    model = import_ultralytics().YOLO(str(checkpoint))
    model.ckpt_path = model.model.pt_path = str(out.with_suffix(".pt"))
    with warnings.catch_warnings(action="ignore"):  # the tracer's
        written = model.export(
            format="onnx", imgsz=SIZE_PX, opset=17, simplify=False, nms=nms, device="cpu"
        )
    return Path(written)


@pytest.fixture(scope="module")
def exports(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("onnx")

    def ours(name: str) -> Path:
        return export_yolo(load_yolo(checkpoint), folder / f"{name}.onnx", size_px=SIZE_PX)

    out = {"half": ours("half")}
    for name, nms in (("one-to-many", None), ("end-to-end", False)):
        out[name] = ultralytics_export(checkpoint, folder / f"{name}.onnx", nms)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export, "halve_storage", lambda network: None)
        out["one-to-one"] = ours("one-to-one")
    return out


@cache
def predictions(checkpoint: Path, *, many: bool, rect: bool) -> list[Any]:
    """Ultralytics' own, of a picture of each size: by the one-to-many head or the other."""
    model = import_ultralytics().YOLO(str(checkpoint))
    return [
        model.predict(
            np.ascontiguousarray(picture(*size)[..., ::-1]),
            conf=CONFIDENCE,
            imgsz=SIZE_PX,
            retina_masks=True,
            nms=None if many else False,
            rect=rect,
            device="cpu",
            verbose=False,
        )[0]
        for size in SIZES
    ]


def compare(found: tuple[Instance, ...], theirs: Any) -> int:
    """Compare all of one picture; give the number of detections."""
    boxes = theirs.boxes.xyxy.numpy()
    # Ultralytics leaves out what has no mask and keeps boxes that were clipped to nothing.
    kept = np.flatnonzero((boxes[:, 2] > boxes[:, 0]) & (boxes[:, 3] > boxes[:, 1]))
    ours = [f for f in found if theirs.masks is None or f.detector_mask is not None]
    assert len(ours) == len(kept)
    taken = set()
    for fruit in ours:
        # Scores that tie to rounding may change places.
        i = kept[np.abs(boxes[kept] - fruit.box - 0.5).max(axis=1).argmin()]
        taken.add(int(i))
        assert np.abs(fruit.box + 0.5 - boxes[i]).max() < TOLERANCE_PX
        assert abs(fruit.confidence - float(theirs.boxes.conf[i])) < TOLERANCE
        assert fruit.class_name == theirs.names[int(theirs.boxes.cls[i])]
        if theirs.masks is not None:
            mask = theirs.masks.data[i].numpy() > 0
            assert fruit.detector_mask is not None
            # Ultralytics crops the padding at whole cells of its prototypes: outlines may shift.
            least, most = (
                change(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
                for change in (cv2.erode, cv2.dilate)
            )
            different = (least & ~fruit.detector_mask) | (fruit.detector_mask & ~most)
            assert different.sum() <= 2 + 1e-2 * mask.sum()
        if fruit.keypoints is not None:
            points = theirs.keypoints.data[i].numpy()
            assert np.abs(fruit.keypoints[:, :2] + 0.5 - points[:, :2]).max() < TOLERANCE_PX
            assert np.abs(fruit.keypoints[:, 2] - points[:, 2]).max() < TOLERANCE
    assert taken == set(kept.tolist())
    return len(kept)


@pytest.mark.parametrize("runtime", ["onnxruntime", "openvino"])
@pytest.mark.parametrize("head", ["one-to-one", "one-to-many", "end-to-end"])
def test_parity(runtime: str, head: str, checkpoint: Path, exports: dict[str, Path]) -> None:
    pytest.importorskip(runtime)
    if (runtime, head) == ("openvino", "end-to-end"):
        with pytest.raises(ModelError, match="OpenVINO cannot load it"):
            YoloDetector(exports[head], runtime)
        return
    detector = YoloDetector(exports[head], runtime, CONFIDENCE, full_precision=True)
    theirs = predictions(checkpoint, many=head == "one-to-many", rect=head == "one-to-one")
    total = sum(
        compare(detector.detect(picture(*size)), one)
        for size, one in zip(SIZES, theirs, strict=True)
    )
    assert total >= 5


def test_half_storage_halves_the_file_and_moves_little(exports: dict[str, Path]) -> None:
    full, half = exports["one-to-one"], exports["half"]
    assert half.stat().st_size < 0.56 * full.stat().st_size
    feeds = {"images": picture(SIZE_PX, SIZE_PX).transpose(2, 0, 1)[None] / 255}
    a, b = (open_network(f, "onnxruntime").run(feeds)["output0"][0] for f in (full, half))
    assert np.median(np.abs(a[:4] - b[:4])) < 0.3
    assert np.median(np.abs(a[4] - b[4])) < 0.003


def test_the_same_weights_give_the_same_file(
    checkpoint: Path, exports: dict[str, Path], tmp_path: Path
) -> None:
    model = load_yolo(checkpoint)
    again = export_yolo(model, tmp_path / "half.onnx", size_px=SIZE_PX)
    assert again.read_bytes() == exports["half"].read_bytes()


def test_bad_checkpoints_are_named(tmp_path: Path) -> None:
    bad = tmp_path / "bad.pt"
    bad.write_bytes(b"no checkpoint")
    with pytest.raises(ModelError, match=r"bad\.pt: Ultralytics cannot load"):
        load_yolo(bad)
    older = import_ultralytics().YOLO("yolo11n.yaml")
    with pytest.raises(ModelError, match="no one-to-one head"):
        export_yolo(older, tmp_path / "out.onnx")


def test_the_order_of_the_points_and_the_sizes_go_into_the_file(tmp_path: Path) -> None:
    model = load_yolo(checkpoint_of("pose"))
    orders = {}
    for order in ("", "place"):
        model.model.keypoint_order = order
        path = export_yolo(
            model, tmp_path / f"pose-{order}.onnx", size_px=SIZE_PX, input_sizes=(96,)
        )
        orders[order] = YoloDetector(path, "onnxruntime").by_place
    assert orders == {"": False, "place": True}
    # Without the network that tells the ends apart nobody knows them.
    detector = YoloDetector(tmp_path / "pose-place.onnx", "onnxruntime", 0.05)
    found = detector.detect(picture(160, 160))
    assert {(one.end_confidence, one.input_size_px) for one in found} == {(0.5, 96)}
