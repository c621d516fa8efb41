"""Convert intrinsics files of other programs to the keys of the native format."""

from __future__ import annotations

import io
import re
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.pictures import check_array_head
from cucumbervision.errors import IntrinsicsError, wrap_reader_errors
from cucumbervision.files import read_bytes, read_json, read_text

if TYPE_CHECKING:
    from pathlib import Path

_BOP_KEYS = frozenset({"cx", "cy", "depth_scale", "fx", "fy", "height", "width"})
_MATRICES = ("camera_matrix", "cameraMatrix", "K", "k", "cam_K")
_LENSES = ("distortion_coefficients", "distCoeffs", "dist_coeffs", "D", "d")
# One number or more by the names of other programs: nerfstudio, ORB-SLAM.
_NAMES = {
    **{"fl_x": "fx", "fl_y": "fy", "w": "width", "h": "height"},
    **{f"Camera.{key}": key for key in ("fx", "fy", "cx", "cy", "width", "height")},
    **{f"Camera.{key}": key for key in ("k1", "k2", "p1", "p2", "k3", "k4")},
}
_LENS_KEYS = ("k1", "k2", "p1", "p2", "k3")
_MORE_LENS_KEYS = ("k4", "k5", "k6")
# Keys that name a lens model, and the names of those with the five coefficients: a fisheye lens
# has others by the same keys.
_LENS_MODELS = ("distortion_model", "camera_model", "Camera.type", "is_fisheye", "fisheye_model")
_FIVE_COEFFICIENTS = frozenset(
    {
        *("plumb_bob", "brown_conrady", "rational_polynomial", "radtan", "opencv", "radial"),
        *("pinhole", "simple_pinhole", "simple_radial", "rectified", "none", "false", "0"),
    }
)
# As librealsense prints it: [ 640x480  p[319.5 239.5]  f[600 600]  Brown Conrady [0 0 0 0 0] ]
_PRINTED = re.compile(
    r"\[\s*(\d+)x(\d+)\s+p\[(\S+) (\S+)\]\s+f\[(\S+) (\S+)\]\s+([A-Za-z ]+?)\s*"
    r"\[([^\]]*)\]\s*\]"
)
# COLMAP's models: the parameters by name; f is fx and fy.
_COLMAP = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}
_COARSEST_M = 0.01  # a larger 'depth_scale' is not in metres
_MOST_BYTES = 4096  # of a matrix in a file of NumPy's
_COLOR = re.compile(r"colou?r|rgb", re.IGNORECASE)
_NOT_COLOR = re.compile(r"depth|infra|(^|[^a-z])ir([^a-z]|$)", re.IGNORECASE)


def camera_document(path: Path) -> dict[str, Any]:
    """Read an intrinsics file of any supported format as a document with native keys.

    Parameters
    ----------
    path : Path
        JSON or YAML: ours; BOP's `camera.json`; Open3D's (`intrinsic_matrix`); ROS's `camera_info`
        (`K`, `D`); a stream's intrinsics of pyrealsense2 (`ppx`, `ppy`, `coeffs`), or as it prints
        them; those of several streams by name (`color`, `depth`); nerfstudio's (`fl_x`), Kalibr's
        (`cam0`), ORB-SLAM's (`Camera.fx`). OpenCV's YAML, XML or JSON (`camera_matrix`). COLMAP's
        `cameras.txt`. A matrix alone, of three or four rows and columns, by rows or by columns, as
        text, JSON or `.npy`.

    Raises
    ------
    CaptureError
        If the file is missing or cannot be parsed.
    IntrinsicsError
        If the file contains no intrinsics, or a lens model with more than five coefficients.

    Notes
    -----
    Formats without a place for the stream are the colour camera's, unless the file's name or its
    frame's says 'depth' or 'infra'; BOP's is by definition. pyrealsense2's must say it, in the file
    or by its name, since it writes those of any stream alike.
    """
    data = _read(path)
    if isinstance(data, list):
        data = {"K": data}
    if not isinstance(data, dict):
        raise IntrinsicsError(
            "holds no intrinsics", source=path, remedy="give one JSON object with stream, fx, …"
        )
    with wrap_reader_errors(path, IntrinsicsError):
        data = _color_block(data, path)
        data = dict(data.get("intrinsic") or data)
        if frozenset(data) == _BOP_KEYS:
            # BOP: depth_scale times the stored number is millimetres.
            return data | {"stream": "color", "depth_unit_m": data.pop("depth_scale") * 0.001}
        if "ppx" in data:
            return _of_realsense(data, path)
        if not {"fl_x", "Camera.fx"}.isdisjoint(data):
            return _of_other_names(data, path)
        return data if "stream" in data and "fx" in data else _of_matrix(data, path)


def _color_block(data: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the colour camera's block of a file with several, else the file's own keys."""
    blocks = {key: value for key, value in data.items() if isinstance(value, dict)}
    kalibr = {key: value for key, value in blocks.items() if re.fullmatch(r"cam\d+", key)}
    if len(kalibr) > 1:
        kalibr = {k: v for k, v in kalibr.items() if _COLOR.search(str(v.get("rostopic", "")))}
        if len(kalibr) != 1:
            raise IntrinsicsError(
                "holds several cameras, and nothing tells which is the colour camera",
                source=path,
                remedy="keep its block alone",
            )
    for block in kalibr.values():
        return _of_kalibr(block, path)
    colors = [key for key in blocks if _COLOR.search(key) and not _NOT_COLOR.search(key)]
    if len(colors) != 1 or "stream" in data:
        return data
    step = data.get("depth_scale")
    unit = {"depth_unit_m": step} if isinstance(step, float) and 0 < step <= _COARSEST_M else {}
    return {**blocks[colors[0]], "stream": "color", **unit}


def _read(path: Path) -> Any:
    suffix = path.suffix.lower()
    if suffix == ".json":
        return read_json(path)
    if suffix == ".npy":
        with wrap_reader_errors(path, IntrinsicsError):
            stored = read_bytes(path)[:_MOST_BYTES]
            check_array_head(io.BytesIO(stored), len(stored))
            return {"K": np.load(io.BytesIO(stored), allow_pickle=False).astype(float)}
    text = read_text(path)
    if "<!ENTITY" in text or ("&" in text and "*" in text):
        raise IntrinsicsError(
            "has entities or anchors, which may stand for much more than they are",
            source=path,
            remedy="write it without them",
        )
    with wrap_reader_errors(path, IntrinsicsError):
        if suffix == ".xml":
            from xml.etree import ElementTree

            root = ElementTree.fromstring(text)
            return {node.tag: {part.tag: part.text for part in node} or node.text for node in root}
        if suffix in (".yaml", ".yml"):
            import yaml

            # OpenCV's first line and tags are not valid in current YAML.
            return yaml.safe_load(re.sub(r"^%YAML.*|!!opencv-matrix", "", text, flags=re.M))
        return _of_text(text, path)


def _of_text(text: str, path: Path) -> dict[str, Any]:
    """Return the camera of a plain text: as librealsense prints it, COLMAP's, or a matrix."""
    if printed := _PRINTED.search(text):
        width, height, cx, cy, fx, fy, lens, coefficients = printed.groups()
        return {
            **{"width": int(width), "height": int(height)},
            **{"fx": float(fx), "fy": float(fy), "ppx": float(cx), "ppy": float(cy)},
            "model": lens.strip().lower().replace(" ", "_"),
            "coeffs": [float(number) for number in coefficients.split()],
        }
    rows = [line.split() for line in text.splitlines() if not line.lstrip().startswith("#")]
    cameras = [row for row in rows if len(row) > 4 and row[1] in _COLMAP]
    if len(cameras) > 1:
        raise IntrinsicsError(
            f"holds {len(cameras)} cameras", source=path, remedy="keep the pictures' camera alone"
        )
    if cameras:
        return _of_colmap(cameras[0])
    return {"K": np.array(text.replace(",", " ").split(), dtype=float)}


def _of_colmap(row: list[str]) -> dict[str, Any]:
    values = dict(zip(_COLMAP[row[1]], map(float, row[4:]), strict=True))
    focal = values.pop("f", 0.0)
    # COLMAP's pixels begin at the corner of the first, half a pixel before its centre.
    centre = {key: values.pop(key) - 0.5 for key in ("cx", "cy")}
    return {
        **{"fl_x": values.pop("fx", focal), "fl_y": values.pop("fy", focal)},
        **{"w": int(row[2]), "h": int(row[3])},
        **centre,
        **values,
    }


def _of_kalibr(block: dict[str, Any], path: Path) -> dict[str, Any]:
    lens_model = block.get("distortion_model", "none")
    if block.get("camera_model") != "pinhole" or lens_model not in ("radtan", "none"):
        raise IntrinsicsError(
            "has another camera model than pinhole with radtan",
            source=path,
            remedy="rectify the pictures, or calibrate with these",
        )
    fx, fy, cx, cy = block["intrinsics"]
    width, height = block["resolution"]
    lens = dict(zip(_LENS_KEYS, block.get("distortion_coeffs", ()), strict=False))
    topic = {"camera_name": block.get("rostopic", "")}
    return {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": width, "h": height, **lens, **topic}


def _of_other_names(data: dict[str, Any], path: Path) -> dict[str, Any]:
    ours = {_NAMES.get(key, key): value for key, value in data.items()}
    keys = ("fx", "fy", "cx", "cy", "width", "height")
    camera = {key: ours[key] for key in keys if key in ours}
    lens = [float(ours.get(key) or 0.0) for key in (*_LENS_KEYS, *_MORE_LENS_KEYS)]
    _require_five(data, lens, path)
    if any(lens):
        camera |= {"distortion": "brown_conrady", "coefficients": lens[:5]}
    if steps := data.get("DepthMapFactor"):
        camera["depth_unit_m"] = 1 / float(steps)
    return {**camera, "stream": data.get("stream") or _stream_of(data, path)}


def _of_realsense(data: dict[str, Any], path: Path) -> dict[str, Any]:
    names = {"ppx": "cx", "ppy": "cy", "coeffs": "coefficients", "model": "distortion"}
    ours = {names.get(key, key): value for key, value in data.items()}
    if "distortion" in ours:
        ours["distortion"] = str(ours["distortion"]).removeprefix("distortion.")
    if "stream" not in ours:
        by_name = {"color": _COLOR, "depth": _NOT_COLOR}
        streams = [stream for stream, word in by_name.items() if word.search(path.stem)]
        if len(streams) == 1:
            ours["stream"] = streams[0]
    return ours


def _of_matrix(data: dict[str, Any], path: Path) -> dict[str, Any]:
    matrix = next((data[key] for key in _MATRICES if key in data), None)
    if "intrinsic_matrix" in data:  # Open3D uses column-major order
        matrix = np.asarray(data["intrinsic_matrix"], dtype=float)
        matrix = matrix.reshape(3, 3).T if matrix.ndim == 1 else matrix
    if matrix is None:
        return data
    ours: dict[str, Any] = {
        "stream": data.get("stream") or _stream_of(data, path),
        "matrix": _of_rows(_numbers(matrix)),
    }
    for key in ("width", "height"):
        value = data.get(key, data.get(f"image_{key}", data.get(key[0])))
        if value is not None:
            ours[key] = value
    lens = next((_numbers(data[key]) for key in _LENSES if key in data), [])
    _require_five(data, lens, path)
    if any(lens):
        ours |= {"distortion": "brown_conrady", "coefficients": [*lens, *[0.0] * 5][:5]}
    return ours


def _require_five(data: dict[str, Any], lens: list[float], path: Path) -> None:
    """Refuse a lens that is not described by k1, k2, p1, p2 and k3 alone."""
    models = {str(data[key]).lower() for key in _LENS_MODELS if data.get(key)}
    if any(lens[5:]) or not models <= _FIVE_COEFFICIENTS:
        raise IntrinsicsError(
            "has a lens model of more than five coefficients, or another than plumb_bob",
            source=path,
            remedy="rectify the pictures, or calibrate with five coefficients",
        )


def _of_rows(values: list[float]) -> list[float]:
    """Return a camera matrix's nine values by rows, of one by columns or with a fourth row."""
    matrix = np.array(values)
    if matrix.size == 16 and np.array_equal(matrix[[3, 7, 11, 12, 13, 14, 15]], [0] * 6 + [1]):
        matrix = matrix.reshape(4, 4)[:3, :3]
    if matrix.size == 9:
        matrix = matrix.reshape(3, 3)
        is_by_columns = matrix[2, :2].any() and not matrix[:2, 2].any()
        matrix = matrix.T if is_by_columns else matrix
    flat: list[float] = matrix.ravel().tolist()
    return flat


def _stream_of(data: dict[str, Any], path: Path) -> str:
    """Return the stream by the name of the frame, otherwise by those of the camera and the file.

    Depth that is aligned to colour has the colour camera's intrinsics and frame, and 'depth' in the
    name of its file and topic.
    """
    header = data.get("header")
    frame = str(header.get("frame_id", "")) if isinstance(header, dict) else str(header or "")
    if _COLOR.search(frame) and not _NOT_COLOR.search(frame):
        return "color"
    names = f"{path.stem} {data.get('camera_name', '')} {frame}"
    return "depth" if _NOT_COLOR.search(names) else "color"


def _numbers(value: Any) -> list[float]:
    """Return the values of a matrix given as lists, as `data` (OpenCV, ROS) or as text."""
    data = value["data"] if isinstance(value, dict) else value
    data = data.split() if isinstance(data, str) else data
    return np.asarray(data, dtype=float).ravel().tolist()
