"""A small valid file or folder of every kind that is read, made by the real writers."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

import cucumbervision
import cucumbervision_lab
from cucumbervision.capture.frames import Capture, Stop
from cucumbervision.capture.intrinsics import Intrinsics
from cucumbervision.capture.readers.native import write_native
from cucumbervision.geometry.camera import Distortion
from cucumbervision.instances.mask_codes import encode_rle
from cucumbervision.measurement.result import Length
from cucumbervision_greenhouse.store.records import (
    ArtifactRecord,
    CaptureRecord,
    DetectionRecord,
    JointRecord,
    MethodRecord,
    Round,
    StopRecord,
    key_of,
)

if TYPE_CHECKING:
    from cucumbervision_greenhouse.store.repository import Store

_WIDTH, _HEIGHT = 64, 48
CAMERA = Intrinsics(
    *(_WIDTH, _HEIGHT, 60.5, 60.25, 31.5, 24.5),
    distortion=Distortion.INVERSE_BROWN_CONRADY,
    coefficients=(0.1, -0.05, 0.001, -0.002, 0.01),
)
_LENS: dict[str, Any] = {"width": _WIDTH, "height": _HEIGHT, "fx": 60, "fy": 60, "cx": 31, "cy": 23}
_PACKAGE = Path(str(cucumbervision.__file__)).parent
_POINTS = [[12.0 + 8 * k, 25.0, 2] for k in range(5)]


def _color() -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.random.default_rng(3).integers(60, 200, (_HEIGHT, _WIDTH, 3), dtype=np.uint8)


def _depth_mm() -> np.ndarray[Any, np.dtype[np.uint16]]:
    return np.random.default_rng(4).integers(300, 900, (_HEIGHT, _WIDTH), dtype=np.uint16)


def _mask() -> np.ndarray[Any, np.dtype[np.bool_]]:
    mask = np.zeros((_HEIGHT, _WIDTH), bool)
    mask[20:30, 10:50] = True
    return mask


def _picture(path: Path, image: np.ndarray[Any, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    _, data = cv2.imencode(path.suffix, image)
    path.write_bytes(data.tobytes())


def _json(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=1), encoding="utf-8")


def copied(file: Path, folder: Path, name: str = "") -> None:
    """Copy a file into a folder."""
    shutil.copyfile(file, folder / (name or file.name))


def native(folder: Path) -> None:
    """Write a single frame with masks, and a burst of three."""
    about: dict[str, Any] = {
        "masks": (_mask(), ~_mask()),
        "stop": Stop(row="3", side="left", position_m=4.5, step=2),
        "timestamp_s": 1_700_000_000.25,
        "provenance": {"camera": "D435", "serial": "1234"},
    }
    depth_m = (_depth_mm() * 0.001).astype(np.float32)
    write_native(Capture(_color(), depth_m, CAMERA, "one", frame=17, **about), folder / "one")
    burst = [(_color(), depth_m + np.float32(0.001) * k) for k in range(3)]
    write_native(Capture(_color(), depth_m, CAMERA, "burst"), folder / "burst", burst=burst)


def bop(folder: Path) -> None:
    """Write a scene of one picture."""
    _picture(folder / "rgb" / "000001.png", _color())
    _picture(folder / "depth" / "000001.png", _depth_mm())
    _picture(folder / "mask_visib" / "000001_000000.png", _mask().astype(np.uint8) * 255)
    matrix = [60.0, 0.0, 31.0, 0.0, 60.0, 23.0, 0.0, 0.0, 1.0]
    _json(folder / "scene_camera.json", {"1": {"cam_K": matrix, "depth_scale": 1.0}})


def _extrinsics() -> dict[str, Any]:
    rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    return {"rotation": rotation, "translation_m": [0.015, 0.0, 0.0]}


def camera_file(folder: Path) -> None:
    """Write a camera file with everything that one may say."""
    said = {"stream": "color", **_LENS, "depth_unit_m": 0.001, "distortion": "brown_conrady"}
    said |= {"coefficients": [0.1, -0.05, 0.001, -0.002, 0.01]}
    _json(folder / "camera.json", {**said, "depth": _LENS, "depth_to_color": _extrinsics()})
    lens = {"width": _WIDTH, "height": _HEIGHT, "stream": "color"}
    _json(folder / "matrix.json", {**lens, "matrix": [[60, 0, 31], [0, 60, 23], [0, 0, 1]]})
    bop_keys = ("cx", "cy", "fx", "fy", "height", "width")
    _json(folder / "bop.json", {**{k: _LENS[k] for k in bop_keys}, "depth_scale": 0.1})
    size = {"width": _WIDTH, "height": _HEIGHT}
    columns = [60.0, 0, 0, 0, 60.0, 0, 31.0, 23.0, 1]
    _json(folder / "open3d.json", {**size, "intrinsic_matrix": columns})
    realsense = {"fx": 60, "fy": 60, "ppx": 31, "ppy": 23, "model": "brown_conrady"}
    realsense |= {"coeffs": [0.1, 0, 0, 0, 0]}
    _json(folder / "realsense.json", {**size, **realsense, "stream": "color"})
    rows = [60.0, 0, 31.0, 0, 60.0, 23.0, 0, 0, 1]
    ros = f"height: {_HEIGHT}\nwidth: {_WIDTH}\nD: [0.1, 0.0, 0.0, 0.0, 0.0]\nK: {rows}\n"
    (folder / "ros.yaml").write_text(ros)
    (folder / "cam_K.txt").write_text(" ".join(map(str, rows)))
    storage = cv2.FileStorage(str(folder / "opencv.xml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", _WIDTH)
    storage.write("image_height", _HEIGHT)
    storage.write("camera_matrix", np.array(rows).reshape(3, 3))
    storage.release()


def pairs(folder: Path) -> None:
    """Write colour and depth by matching names, in every kind of file that depth may have."""
    for name, kind in (("a", "png"), ("b", "tif"), ("c", "npy"), ("d", "npz")):
        place = folder / ("pictures" if name in "ab" else "arrays")
        file = place / f"depth_{name}.{kind}"
        _picture(place / f"color_{name}.{'jpg' if name == 'a' else 'png'}", _color())
        if kind == "npy":
            np.save(file, _depth_mm())
        elif kind == "npz":
            np.savez_compressed(file, depth=_depth_mm().astype(np.float32) / 1000)
        else:
            _picture(file, _depth_mm())
        _json(place / "intrinsics.json", {"stream": "color", **_LENS})
    np.savez(folder / "whole.npz", color=_color(), depth=_depth_mm(), matrix=CAMERA.matrix)


def viewer(folder: Path) -> None:
    """Write a snapshot as RealSense Viewer exports it, and the camera file that it needs."""
    (folder / "s").mkdir()
    _picture(folder / "s" / "a_Color.png", _color())
    (folder / "s" / "a_Depth.raw").write_bytes(_depth_mm().tobytes())
    for kind, form in (("Depth", "Z16"), ("Color", "RGB8")):
        lines = [
            *("Frame Info", f"Type,{kind}", f"Format,{form}", "Frame Number,17"),
            *(
                "Timestamp (ms),1700000000000.25",
                f"Resolution x,{_WIDTH}",
                f"Resolution y,{_HEIGHT}",
            ),
            *("Bytes per pixel,2", "Intrinsic:", "Fx,60.5", "Fy,60.25", "PPx,31.5", "PPy,24.5"),
            "Distorsion,Brown Conrady",
        ]
        (folder / "s" / f"a_{kind}_metadata.csv").write_text("\n".join(lines) + "\n")
    camera_file(folder)


def coco(folder: Path) -> None:
    """Write annotations of every form, and results."""
    rle = {"size": [_HEIGHT, _WIDTH], "counts": encode_rle(_mask())}
    plain = {"size": [_HEIGHT, _WIDTH], "counts": [100, 20, _HEIGHT * _WIDTH - 120]}
    outline = [[10.0, 20.0, 50.0, 20.0, 50.0, 30.0, 10.0, 30.0]]
    keypoints = [value for point in _POINTS for value in point]
    common = {"image_id": 1, "category_id": 1, "bbox": [10.0, 20.0, 40.0, 10.0], "iscrowd": 0}
    shapes = [{"segmentation": shape} for shape in (outline, rle, plain)]
    items = [{**common, "id": k, **one} for k, one in enumerate(shapes)]
    items.append({**common, "id": 9, "keypoints": keypoints, "num_keypoints": 5, "score": 0.9})
    image = {"id": 1, "file_name": "a.png", "width": _WIDTH, "height": _HEIGHT}
    categories = [{"id": 1, "name": "cucumber", "keypoints": [f"KP{k}" for k in range(5)]}]
    _json(folder / "coco.json", {"images": [image], "annotations": items, "categories": categories})
    _json(folder / "results.json", [{**item, "score": 0.8} for item in items])


def yolo(folder: Path) -> None:
    """Write labels of every form with their classes."""
    pose = " ".join(f"{u / _WIDTH:.6f} {v / _HEIGHT:.6f} {s}" for u, v, s in _POINTS)
    lines = ["0 0.5 0.5 0.2 0.4", "0 0.5 0.5 0.2 0.4 0.93", "1 0.1 0.1 0.4 0.1 0.4 0.5 0.1 0.5"]
    (folder / "a.txt").write_text("\n".join([*lines, f"0 0.5 0.5 0.2 0.4 {pose}"]) + "\n")
    (folder / "classes.txt").write_text("cucumber\ncourgette\n", encoding="utf-8")


def truth(folder: Path) -> None:
    """Write hand-measured lengths, once with commas and once with semicolons."""
    head = ["capture", "fruit", "length_1_cm", "length_2_cm", "kind", "specimen"]
    lines = [["a", "1", "20.5", "20.7", "thread", "s1"], ["b", "1", "20.5", "20.7", "thread", "s1"]]
    lines.append(["b", "missed", "11.5", "", "chord", "s2"])
    (folder / "truth.csv").write_text("\n".join(",".join(line) for line in [head, *lines]) + "\n")
    german = "\r\n".join(";".join(line).replace(".", ",") for line in [head, *lines])
    (folder / "german.csv").write_bytes(b"\xef\xbb\xbf" + german.encode())


def poses(folder: Path) -> None:
    """Write poses as CSV and as JSON."""
    head = "capture,position_m,position_sd_m,row,side,height_m,yaw_deg,pitch_deg,roll_deg"
    lines = ["a,0.41,0.02,3,left,1.1,-2,0.5,0", "b,0.82,0.02,3,left,1.1,1,0.5,0"]
    (folder / "poses.csv").write_text("\n".join([head, *lines]) + "\n")
    cells = [dict(zip(head.split(","), line.split(","), strict=True)) for line in lines]
    _json(folder / "poses.json", cells)


def run(folder: Path) -> None:
    """Measure a bundled capture with three methods, for its CSV and JSON."""
    from cucumbervision.accuracy.measured import read_measured
    from cucumbervision.capture.source import example_captures
    from cucumbervision.measurement.result import MethodName
    from cucumbervision.pipeline.options import MeasureOptions
    from cucumbervision.pipeline.run import measure_inputs

    out = folder / "measured"
    methods = (MethodName.M1, MethodName.M2, MethodName.M3)
    options = MeasureOptions(instances="dataset", methods=methods, segmenter="none")
    measure_inputs([example_captures() / "simulated-row-b"], out, options)
    for ending in ("csv", "json"):
        copied(out / f"measurements.{ending}", folder)
    shutil.rmtree(out)
    found = read_measured(folder).readings
    lines = [f"{one.capture},{one.fruit},20.0,thread" for one in found]
    (folder / "true.csv").write_text("\n".join(["capture,fruit,length_cm,kind", *lines]) + "\n")


def calibration(folder: Path) -> None:
    """Write a site's calibration."""
    from cucumbervision.calibration.calibration_file import (
        CalibratedCamera,
        DepthScaleEntry,
        MeasuredWith,
        SiteCalibration,
        write_site_calibration,
    )

    run_of = MeasuredWith(
        software="x", config_sha256="", selector="best", methods=["M3"], instances="auto"
    )
    scale = DepthScaleEntry(
        value=1.01,
        standard_error=0.001,
        spread=0.002,
        captures=4,
        spacing_m=0.01,
    )
    site = SiteCalibration(
        name="house-3",
        created="2026-05-02T10:00:00+00:00",
        software="cucumbervision",
        camera=CalibratedCamera.of(CAMERA, "841512"),
        measured_with=run_of,
        depth_scale=scale,
    )
    write_site_calibration(folder / "site.json", site)


def store(folder: Path) -> None:
    """Write a store of one round with a stop, fruit and pictures."""
    from cucumbervision_greenhouse.store.repository import open_store

    with open_store(folder / "house.db", images=folder / "pictures") as opened:
        walk, stop = stop_of(opened)
        opened.save_round(walk)
        opened.save_stop(stop)
        one = stop.captures[0].fruit[0]
        pose = tuple(np.eye(4).ravel().tolist())
        together = JointRecord(key_of("joint"), "a", 2, record=one, poses={"b": pose})
        opened.save_joint(walk.key, [together, JointRecord(key_of("none"), "a", 0, "x")], ())


def stop_of(opened: Store) -> tuple[Round, StopRecord]:
    """Return a round and a stop of it, whose pictures are written."""
    walk = Round(key_of("walk"), "morning", "house 1", 1000.0)
    path = ((0.0, 0.1, 0.5), (0.2, 0.1, 0.5))
    methods = (
        MethodRecord("M1", 0.2),
        MethodRecord("M6", 0.25, thread_m=0.27, path_m=path, diameter_m=(0.04, 0.05)),
    )
    found = tuple(
        DetectionRecord(
            k,
            method="M6",
            length=Length(0.2 + 0.01 * k),
            offset_m=0.1,
            offset_sd_m=0.03,
            view_score=0.5,
            keypoints=((1.0, 2.0, 0.9),),
            mask="123",
            methods=methods,
        )
        for k in (1, 2)
    )
    color = opened.images.put_color(_color())
    depth = opened.images.put_depth((_depth_mm() * 0.001).astype(np.float32))
    capture = CaptureRecord("a", camera={"fx_px": 600.0}, color=color, depth=depth, fruit=found)
    return walk, StopRecord(
        key_of("stop"),
        walk.key,
        row="3",
        side="left",
        position_m=0.4,
        position_sd_m=0.04,
        captures=(capture,),
        artifacts=(ArtifactRecord("model", "detector", "ab", {"runtime": "x"}),),
        failures=({"capture": "b", "error": "CaptureError"},),
    )


def recording(folder: Path, frames: int = 22) -> None:
    """Record frames of the SDK's own software camera, as a D435 at a quarter of its size."""
    from cucumbervision.capture.realsense_device import import_realsense

    rs = import_realsense()
    device = rs.software_device()
    inlets = [device.add_sensor(name) for name in ("Stereo Module", "RGB Camera")]
    streams = (
        (rs.stream.depth, rs.format.z16, 2, 160.0),
        (rs.stream.color, rs.format.rgb8, 3, 227.0),
    )
    profiles = [
        inlet.add_video_stream(_stream(rs, uid, *said)).as_video_stream_profile()
        for uid, (inlet, said) in enumerate(zip(inlets, streams, strict=True), 1)
    ]
    inlets[0].add_read_only_option(rs.option.depth_units, 0.001)
    moved = rs.extrinsics()
    moved.rotation, moved.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [0.015, 0.0, 0.0]
    profiles[0].register_extrinsics_to(profiles[1], moved)
    device.create_matcher(rs.matchers.dlr_c)
    recorder = rs.recorder(str(folder / "walk.db3"), device)
    sensors, syncer = recorder.query_sensors(), rs.syncer(10)
    for sensor, profile in zip(sensors, profiles, strict=True):
        sensor.open(profile)
        sensor.start(syncer)
    depth = np.full((180, 320), 600, np.uint16)
    depth[80:100, 100:200] = 450
    images: tuple[np.ndarray[Any, Any], ...] = depth, np.full((180, 320, 3), 90, np.uint8)
    for number in range(1, frames + 1):
        for inlet, profile, image in zip(inlets, profiles, images, strict=True):
            frame = rs.software_video_frame()
            frame.pixels, frame.profile = np.ascontiguousarray(image), profile
            frame.bpp = 2 if image.ndim == 2 else 3
            frame.stride = 320 * frame.bpp
            frame.timestamp, frame.frame_number = 33.3 * number, number
            frame.domain = rs.timestamp_domain.system_time
            if image.ndim == 2:
                frame.depth_units = 0.001
            inlet.on_video_frame(frame)
        syncer.wait_for_frames(2000)
    for sensor in sensors:
        sensor.stop()
        sensor.close()


def _stream(rs: Any, uid: int, kind: Any, pixels: Any, size: int, focal_px: float) -> Any:
    lens, stream = rs.intrinsics(), rs.video_stream()
    lens.width, lens.height, lens.ppx, lens.ppy = 320, 180, 160.3, 89.7
    lens.fx = lens.fy = focal_px
    lens.model, lens.coeffs = rs.distortion.brown_conrady, [0.0] * 5
    stream.type, stream.index, stream.uid, stream.fps = kind, 0, uid, 30
    stream.width, stream.height, stream.bpp, stream.fmt = 320, 180, size, pixels
    stream.intrinsics = lens
    return stream


def network(folder: Path) -> None:
    """Write a small network as ONNX."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    weight = numpy_helper.from_array(np.ones((4, 3, 3, 3), np.float32), "w")
    nodes = [
        helper.make_node("Conv", ["images", "w"], ["c"], pads=[1, 1, 1, 1], name="conv"),
        helper.make_node("Relu", ["c"], ["y"], name="relu"),
    ]
    shape = [1, 3, 8, 8]
    graph = helper.make_graph(
        nodes,
        "g",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 4, 8, 8])],
        [weight],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(model, {"task": "segment", "names": "{0: 'cucumber'}", "stride": "32"})
    onnx.save(model, str(folder / "net.onnx"))


def detector(folder: Path) -> None:
    """Write a segmenting detector that finds two fruit, whatever it sees."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    rows = np.zeros((1, 300, 38), np.float32)
    rows[0, :2, :6] = [[8, 8, 40, 30, 0.75, 0], [10, 34, 60, 44, 0.5, 0]]
    rows[0, :, 6] = 1
    weight = np.zeros((32, 3, 4, 4), np.float32)
    weight[0] = 0.1
    constants = {"zero": np.float32(0), "rows": rows, "weight": weight}
    nodes = [
        helper.make_node("ReduceMax", ["images"], ["brightest"], keepdims=0, name="brightest"),
        helper.make_node("Mul", ["brightest", "zero"], ["nothing"], name="nothing"),
        helper.make_node("Add", ["rows", "nothing"], ["output0"], name="rows"),
        helper.make_node("Conv", ["images", "weight"], ["output1"], strides=[4, 4], name="masks"),
    ]
    graph = helper.make_graph(
        nodes,
        "g",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, 64, 64])],
        [
            helper.make_tensor_value_info("output0", TensorProto.FLOAT, rows.shape),
            helper.make_tensor_value_info("output1", TensorProto.FLOAT, [1, 32, 16, 16]),
        ],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(
        model, {"names": "{0: 'cucumber'}", "task": "segment", "end2end": "True", "stride": "32"}
    )
    onnx.save(model, str(folder / "detector.onnx"))


def own_networks(folder: Path) -> None:
    """Write the list of a user's own networks."""
    entry = {
        **{"name": "own", "task": "segment", "licence": "AGPL-3.0-only", "title": "ours"},
        **{"origin": "here", "source": None},
        "files": [{"role": "network", "file": "own.onnx", "sha256": "0" * 64, "size_bytes": 3}],
    }
    _json(folder / "in-use.json", {"models": [entry], "in_use": {"segment": ["own"]}})


def judgement(folder: Path) -> None:
    """Write what `train house` judged of a network."""
    network(folder)
    said = {"file": "net.onnx", "new": "0" * 64, "old": "1" * 64, "better": True, "why": "higher"}
    _json(folder / "judgement.json", said)


def settings(folder: Path) -> None:
    """Write the dashboard's settings."""
    from cucumbervision_greenhouse.backend.settings import Settings, write_settings

    write_settings(Settings(unit="in"), folder / "house.settings.json")


def labelled_set(folder: Path) -> None:
    """Write a labelled set with depth, as `synth` does."""
    images = []
    for name in ("a", "b"):
        _picture(folder / f"images/{name}.png", _color())
        _picture(folder / f"depth/{name}.png", _depth_mm())
        files = {"file_name": f"images/{name}.png", "depth_file": f"depth/{name}.png"}
        camera = {**_LENS, "distortion": "none", "coefficients": [0.0] * 5, "stream": "color"}
        images.append({**files, "depth_unit_m": 0.001, "camera": camera, "source": "synth"})
    _json(folder / "annotations.json", {"images": images, "annotations": []})


def crop_pack(folder: Path) -> None:
    """Write a crop's folder with a network and its card."""
    from cucumbervision.perception.registry import file_sha256

    copied(_PACKAGE / "agronomy" / "crops" / "long-cucumber.toml", folder, "profile.toml")
    network(folder)
    (folder / "net.onnx").rename(folder / "own-seg.onnx")
    _json(folder / "own-seg.json", {"sha256": file_sha256(folder / "own-seg.onnx")})


def queue(folder: Path) -> None:
    """Write presses that wait to be measured, a coded one and raw frames, and an upload."""
    from cucumbervision.capture.raw_frames import write_frame
    from cucumbervision_greenhouse.backend.uploads import Sending, SentFile, Uploads
    from cucumbervision_greenhouse.store.waiting import WaitingCaptures

    stop = Stop(row="3", side="left", position_m=4.5, step=2)
    depth_m = (_depth_mm() * 0.001).astype(np.float32)
    capture = Capture(_color(), depth_m, CAMERA, "press", stop=stop)
    waiting = WaitingCaptures(folder / "house.waiting")
    waiting.put(capture, key_of("first"), key_of("walk"), 1_700_000_000.0)
    frames = [folder / f"{k}.frame" for k in range(2)]
    for frame in frames:
        write_frame(capture, frame)
    waiting.put_frames(frames, stop, key_of("second"), key_of("walk"), 1_700_000_001.0)
    for frame in frames:
        frame.unlink()
    sent = Sending(round=key_of("walk"), files=(SentFile(name="a.zip", size=7),))
    uploads_ = Uploads(folder / "uploads")
    uploads_.begin(sent, 10**9)
    uploads_.append(sent.key, 0, 0, b"1234567")


def journal(folder: Path) -> None:
    """Measure a bundled capture, for its journal."""
    from cucumbervision.capture.source import example_captures
    from cucumbervision.measurement.result import MethodName
    from cucumbervision.pipeline.options import MeasureOptions
    from cucumbervision.pipeline.run import measure_inputs

    options = MeasureOptions(instances="dataset", methods=(MethodName.M1,), segmenter="none")
    measure_inputs([example_captures() / "simulated-row-b"], folder / "out", options)
    shutil.copytree(folder / "out" / "journal", folder / "journal")
    shutil.rmtree(folder / "out")


def hand_lengths(folder: Path) -> None:
    """Write a round's lengths by hand, as the page does."""
    head = "capture,fruit,specimen,length_1_cm,length_2_cm,kind"
    lines = [head, "s/a,1,f1,20.50,20.70,thread", "s/a,2,f2,,11.00,thread"]
    (folder / "round.csv").write_text("\r\n".join(lines) + "\r\n")


def _data_set(folder: Path) -> Any:
    from cucumbervision_lab.datasets.labels import DataSet, Label, LabelledPicture

    points = np.array(_POINTS)
    extras = {"distance_m": 0.5, "thread_m": 0.2}
    fruit = Label.of_mask(_mask(), keypoints=points, hidden_share=0.1, extras=extras)
    spare = Label(np.array([1.0, 1.0, 9.0, 9.0]), ignore=True)
    pictures = []
    for name, split, labels in (("a", "train", (fruit, spare)), ("b", "val", (fruit,))):
        _picture(folder / "images" / f"{name}.png", _color())
        pictures.append(
            LabelledPicture(
                f"images/{name}.png",
                _WIDTH,
                _HEIGHT,
                labels,
                split=split,
                scene=name,
                licence="CC0",
            )
        )
    return DataSet(folder, tuple(pictures))


def coco_set(folder: Path) -> None:
    """Write a data set in the hub form, and its pictures' fragments."""
    from cucumbervision_lab.datasets.coco import write_coco, write_fragment

    data = write_coco(_data_set(folder), folder)
    for k, picture in enumerate(data.pictures):
        write_fragment(picture, folder / "fragments" / f"{k}.json")


def yolo_set(folder: Path) -> None:
    """Write a data set as Ultralytics reads it."""
    from cucumbervision_lab.datasets.yolo import write_yolo

    spare = folder / "spare"
    write_yolo(_data_set(spare), folder, "pose")
    shutil.rmtree(spare)


def records(folder: Path) -> None:
    """Write a benchmark's records."""
    from cucumbervision_lab.benchmark.records import LengthRecord, Masks, append_record

    for k in range(3):
        known = (0.2, 0.22, 0.2, 0.5, 0.0, None, 0.0, 1.0)
        one = LengthRecord(
            f"c{k}", "paper", Masks.EXACT, "f1", *known, lengths_m={"M1": 0.2, "M6": None}
        )
        append_record(folder / "records.jsonl", one)


def training(folder: Path) -> None:
    """Write the state of a training."""
    from cucumbervision_lab.training.plan import RunState, parse_plan

    RunState("segment", "data", "init.pt", parse_plan("64x2,128x1"), 1).save(folder)


def model_card(folder: Path) -> None:
    """Copy a published network's card."""
    copied(_PACKAGE / "perception" / "weights" / "cucumber-look.json", folder)


def published(folder: Path) -> None:
    """Copy the registry of models, a crop profile, a recipe, interval models and an audit."""
    copied(_PACKAGE / "perception" / "models.toml", folder)
    copied(_PACKAGE / "agronomy" / "crops" / "long-cucumber.toml", folder)
    copied(_PACKAGE / "measurement" / "interval_models.json", folder)
    lab = Path(str(cucumbervision_lab.__file__)).parent
    copied(lab / "training" / "recipe.toml", folder)
    audit = json.loads((lab / "detection" / "audit" / "photos_audit.json").read_text())
    audit["photos"] = audit["photos"][:3]
    _json(folder / "audit.json", audit)


def uploads(folder: Path) -> None:
    """Write what a stranger may send: a zip of captures, arrays, a picture pair."""
    whole = folder / "whole"
    native(whole)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(p for p in whole.rglob("*") if p.is_file()):
            archive.write(file, file.relative_to(whole).as_posix())
    (folder / "walk.zip").write_bytes(stream.getvalue())
    shutil.rmtree(whole)
    np.savez(folder / "walk.npz", color=_color(), depth=_depth_mm(), matrix=CAMERA.matrix)
    _picture(folder / "color_1.jpg", _color())
    _picture(folder / "depth_1.png", _depth_mm())
    _json(folder / "intrinsics.json", {"stream": "color", **_LENS})
