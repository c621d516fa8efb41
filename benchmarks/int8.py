r"""What the detector loses, and what it gains, where its convolutions count in eight bits.

    python benchmarks/int8.py --photos DIR [--captures DIR] [--seg SEG.onnx] [--size 640] \
        [--calibrate 64] [--split val] [--keep INT8.onnx]

Static quantisation by ONNX Runtime (weights by channel), its ranges taken from photos of the split
'train'; the head's last layers stay in floating point. Printed for both networks: recall and
precision on the audited photos of the split at full size and at half of it, processor milliseconds
of a frame of 1280x720 in turns, and how much lengths differ on captures with depth (the package's
own without --captures). An eight-bit network is worth shipping where it loses less than half a
point of recall. All runs in ONNX Runtime: OpenVINO 2026 reads this form of the network without a
word and finds nothing with it, so its milliseconds are printed beside, its finds are not.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import numpy_helper
from onnxruntime.quantization import (
    CalibrationDataReader,
    CalibrationMethod,
    QuantFormat,
    QuantType,
    quantize_static,
)

from cucumbervision.capture.files import read_color
from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import bundled_captures
from cucumbervision.errors import CucumberVisionError
from cucumbervision.measurement.result import Method
from cucumbervision.perception.boxes import box_iou
from cucumbervision.perception.resize import fit
from cucumbervision.perception.yolo import YoloDetector
from cucumbervision.pipeline.measurer import Measurer
from cucumbervision.pipeline.options import MeasureOptions
from cucumbervision_lab.detection.photos import audited_photos, evaluate_photos
from cucumbervision_lab.detection.picture_result import open_networks
from cucumbervision_lab.detection.pictures import spread
from cucumbervision_lab.detection.run import chosen_networks

RUNTIMES = ("onnxruntime", "openvino")
HEAD = "/model.23/"
FRAME_PX = (720, 1280)
SAME_FRUIT_IOU = 0.7


class Photos(CalibrationDataReader):  # type: ignore[misc]
    """Photos as the network sees them, one at a time."""

    def __init__(self, paths: list[Path], size_px: int, name: str) -> None:
        self._inputs = ({name: as_input(read_color(path), size_px)} for path in paths)

    def get_next(self) -> dict[str, Any] | None:
        """Return the next photo, or None."""
        return next(self._inputs, None)


def as_input(color: np.ndarray[Any, Any], size_px: int) -> np.ndarray[Any, Any]:
    """Return a picture as a batch of one, float32, letterboxed."""
    height, width = color.shape[:2]
    box = fit(height, width, (size_px, size_px), minimal=True, stride=32)
    return box.as_input(color)


def widen_weights(network: onnx.ModelProto) -> None:
    """Turn weights stored in half precision, each behind a Cast, into float32 ones."""
    stored = {tensor.name: tensor for tensor in network.graph.initializer}
    nodes = []
    for node in network.graph.node:
        tensor = stored.get(node.input[0]) if node.op_type == "Cast" else None
        if tensor is None:
            nodes.append(node)
            continue
        values = numpy_helper.to_array(tensor).astype(np.float32)
        tensor.CopyFrom(numpy_helper.from_array(values, node.output[0]))
    del network.graph.node[:]
    network.graph.node.extend(nodes)


def quantise(source: Path, out: Path, photos: list[Path], size_px: int) -> None:
    """Write the network with its convolutions in eight bits."""
    network = onnx.load(source)
    widen_weights(network)
    convolutions = [node for node in network.graph.node if node.op_type == "Conv"]
    # What a box or a score is made of needs finer steps than 256.
    last = [n.name for n in convolutions if HEAD in n.name and n.name.endswith(".2/Conv")]
    reader = Photos(photos, size_px, network.graph.input[0].name)
    wide = out.with_suffix(".wide.onnx")
    onnx.save(network, wide)
    quantize_static(
        wide,
        out,
        reader,
        quant_format=QuantFormat.QDQ,
        op_types_to_quantize=["Conv"],
        per_channel=True,
        activation_type=QuantType.QUInt8,
        weight_type=QuantType.QInt8,
        nodes_to_exclude=last,
        calibrate_method=CalibrationMethod.MinMax,
    )
    written = onnx.load(out)
    entries = {entry.key: entry.value for entry in network.metadata_props}
    onnx.helper.set_model_props(written, entries)
    onnx.save(written, out)
    wide.unlink()


def busy_ms(paths: dict[str, Path], size_px: int, turns: int) -> Iterator[str]:
    """Return the median processor time of one frame by runtime, the networks in turns."""
    color = np.random.default_rng(0).integers(0, 255, (*FRAME_PX, 3), np.uint8)
    for runtime in RUNTIMES:
        try:
            opened = {
                name: YoloDetector(path, runtime, full_precision=True, input_sizes=(size_px,))
                for name, path in paths.items()
            }
        except CucumberVisionError as error:
            yield f"{runtime}: left out, {error}"
            continue
        times: dict[str, list[float]] = {name: [] for name in opened}
        for turn in range(turns + 1):
            for name, network in opened.items():
                start = time.process_time()
                network.detect(color)
                if turn:  # the first turn sets the runtime up
                    times[name].append(1e3 * (time.process_time() - start))
        yield f"{runtime}: " + ", ".join(f"{n} {np.median(t):.0f} ms" for n, t in times.items())


def lengths(path: Path, folder: Path, limit: int, size_px: int) -> list[list[Any]]:
    """Return boxes and M6's lengths of the fruit of each capture."""
    options = MeasureOptions(
        instances=str(path),
        keypoints=False,
        methods=(Method.M6,),
        input_sizes=(size_px,),
        runtime=RUNTIMES[0],
    )
    measurer = Measurer(options)
    found = []
    for reference in spread(tuple(open_source(folder)), limit):
        fruit = measurer.measure(reference.load()).fruit
        found.append([(one.instance.box, one.length and one.length.value_m) for one in fruit])
    return found


def length_changes(first: list[list[Any]], second: list[list[Any]]) -> list[float]:
    """Return the relative difference of every fruit that both networks found and measured."""
    changes = []
    for before, after in zip(first, second, strict=True):
        for box, length_m in before:
            same = [m for other, m in after if box_iou(box, other) > SAME_FRUIT_IOU and m]
            if length_m and same:
                changes.append(abs(same[0] / length_m - 1))
    return changes


def main() -> None:
    """Quantise, judge both, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--photos", type=Path, required=True, help="folder of the audited photos")
    parser.add_argument("--captures", type=Path, help="captures with depth, for lengths")
    parser.add_argument("--seg", type=Path, help="a detector; else the package's own")
    parser.add_argument("--size", type=int, default=640, help="long side of the input, pixels")
    parser.add_argument("--calibrate", type=int, default=64, help="photos to take ranges from")
    parser.add_argument("--split", default="val")
    parser.add_argument("--limit", type=int, default=20, help="captures at most")
    parser.add_argument("--turns", type=int, default=7, help="of timing")
    parser.add_argument("--keep", type=Path, help="where the eight-bit network is kept")
    options = parser.parse_args()
    path, _ = chosen_networks(options.seg, None)
    if path is None:
        raise SystemExit("this version comes without a detector: name one with --seg")
    with tempfile.TemporaryDirectory() as folder:
        eight = options.keep or Path(folder) / "int8.onnx"
        train, _ = audited_photos(options.photos, "train")
        chosen = [photo.path for photo in spread(tuple(train), options.calibrate)]
        quantise(path, eight, chosen, options.size)
        paths = {"float32": path, "int8": eight}
        photos, _ = audited_photos(options.photos, options.split)
        for name, one in paths.items():
            networks = open_networks(
                *chosen_networks(one, None),
                None,
                runtime=RUNTIMES[0],
                ranked=False,
                input_sizes=(options.size,),
            )
            result = evaluate_photos(photos, networks)
            for kind, (_, score) in zip(
                ("full", "half"), (result.scores[0], result.small[0]), strict=True
            ):
                precision = score.precision.value if score.precision else float("nan")
                print(f"{name} {kind}: recall {score.recall.value:.3f}, precision {precision:.3f}")
            print(f"{name}: {one.stat().st_size / 1e6:.1f} MB")
        for line in busy_ms(paths, options.size, options.turns):
            print(line)
        captures = options.captures or bundled_captures()
        every = [lengths(one, captures, options.limit, options.size) for one in paths.values()]
        changes = 100 * np.array(length_changes(*every))
        print(
            f"lengths of {len(changes)} fruit found by both differ by {np.median(changes):.2f} % "
            f"in the median, {np.percentile(changes, 90):.2f} % at most for nine of ten"
        )


if __name__ == "__main__":
    main()
