"""Convert intrinsics files of ROS and librealsense, and plain matrices, to our keys."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.pictures import read_array
from cucumbervision.errors import IntrinsicsError, wrap_reader_errors
from cucumbervision.files import read_json, read_text

if TYPE_CHECKING:
    from pathlib import Path

_MATRICES = ("camera_matrix", "K", "k", "cam_K")
_PROJECTIONS = ("projection_matrix", "P", "p")
_LENSES = ("distortion_coefficients", "D", "d")
_FIVE_COEFFICIENTS = frozenset({"plumb_bob", "rational_polynomial", "brown_conrady", "none", ""})
# Keys of files that are not read: their lens, pixel or unit conventions are others.
_OTHERS = {
    "fl_x": "nerfstudio",
    "Camera.fx": "ORB-SLAM",
    "cam0": "Kalibr",
    "intrinsic": "Open3D",
    "intrinsic_matrix": "Open3D",
    "distCoeffs": "OpenCV",
    "opencv_storage": "OpenCV",
}
_BOP_KEYS = frozenset({"cx", "cy", "depth_scale", "fx", "fy", "height", "width"})
_REMEDY = (
    "write ours (docs/captures.md), ROS's camera_info, librealsense's or a 3x3 matrix; a reader "
    "can be plugged in: examples/plugins.py"
)
# As librealsense prints it: [ 640x480  p[319.5 239.5]  f[600 600]  Brown Conrady [0 0 0 0 0] ]
_PRINTED = re.compile(
    r"\[\s*(\d+)x(\d+)\s+p\[(\S+) (\S+)\]\s+f\[(\S+) (\S+)\]\s+([A-Za-z ]+?)\s*"
    r"\[([^\]]*)\]\s*\]"
)
_COLMAP = re.compile(r"^\d+ [A-Z_]+ \d+ \d+ ", re.MULTILINE)
_COARSEST_M = 0.01  # a larger 'depth_scale' is not in metres
_COLOR = re.compile(r"colou?r|rgb", re.IGNORECASE)
_NOT_COLOR = re.compile(r"depth|infra|(^|[^a-z])ir([^a-z]|$)", re.IGNORECASE)


def camera_document(path: Path) -> dict[str, Any]:
    """Read an intrinsics file of any supported format as a document with our keys.

    Parameters
    ----------
    path : Path
        JSON or YAML: ours; ROS's `camera_info` (`K`, `D`) or its calibration file
        (`camera_matrix`); a stream's intrinsics of pyrealsense2 (`ppx`, `ppy`, `coeffs`), or as it
        prints them; those of several streams by name (`color`, `depth`). A matrix alone, of three
        or four rows and columns, by rows or by columns, as text, JSON or `.npy`.

    Raises
    ------
    CaptureError
        If the file is missing or cannot be parsed.
    IntrinsicsError
        If the file contains no intrinsics, is of another program, or has a lens model with more
        than five coefficients.

    Notes
    -----
    Formats without a place for the stream are the colour camera's, unless the file's name or its
    frame's says 'depth' or 'infra'. pyrealsense2's must say it, in the file or by its name, since
    it writes those of any stream alike.
    """
    data = _read(path)
    if isinstance(data, list):
        data = {"K": data}
    if not isinstance(data, dict):
        raise IntrinsicsError(
            "holds no intrinsics", source=path, remedy="give one JSON object with stream, fx, …"
        )
    program = next((_OTHERS[key] for key in data if key in _OTHERS), "")
    if program or (frozenset(data) == _BOP_KEYS):
        raise _other_program(program or "BOP", path)
    with wrap_reader_errors(path, IntrinsicsError):
        data = _color_block(data)
        if "ppx" in data:
            return _of_realsense(data, path)
        return data if "stream" in data and "fx" in data else _of_matrix(data, path)


def _other_program(program: str, path: Path) -> IntrinsicsError:
    return IntrinsicsError(f"is a camera file of {program}", source=path, remedy=_REMEDY)


def _color_block(data: dict[str, Any]) -> dict[str, Any]:
    """Return the colour camera's block of a file with several, else the file's own keys."""
    colors = [
        key
        for key, value in data.items()
        if isinstance(value, dict) and _COLOR.search(key) and not _NOT_COLOR.search(key)
    ]
    if len(colors) != 1 or "stream" in data:
        return data
    step = data.get("depth_scale")
    unit = {"depth_unit_m": step} if isinstance(step, float) and 0 < step <= _COARSEST_M else {}
    return {**data[colors[0]], "stream": "color", **unit}


def _read(path: Path) -> Any:
    suffix = path.suffix.lower()
    if suffix == ".json":
        return read_json(path)
    with wrap_reader_errors(path, IntrinsicsError):
        if suffix == ".npy":
            return {"K": read_array(path).astype(float)}
        text = read_text(path)
        if suffix == ".xml" or text.startswith("%YAML"):
            raise _other_program("OpenCV" if "Camera.fx" not in text else "ORB-SLAM", path)
        if suffix in (".yaml", ".yml"):
            import yaml

            if "&" in text and "*" in text:
                raise ValueError("it has anchors, which may stand for much more than they are")
            return yaml.safe_load(text)
        if printed := _PRINTED.search(text):
            width, height, cx, cy, fx, fy, lens, coefficients = printed.groups()
            return {
                **{"width": int(width), "height": int(height)},
                **{"fx": float(fx), "fy": float(fy), "ppx": float(cx), "ppy": float(cy)},
                "model": lens.strip().lower().replace(" ", "_"),
                "coeffs": [float(number) for number in coefficients.split()],
            }
        if _COLMAP.search(text):
            raise _other_program("COLMAP", path)
        rows = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
        return {"K": np.array(" ".join(rows).replace(",", " ").split(), dtype=float)}


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
    """Return the camera of a matrix, with what ROS's `camera_info` writes beside it."""
    value = _first(data, _MATRICES)
    if value is None:
        return data
    lens = _numbers(_first(data, _LENSES) or [])
    lens_model = str(data.get("distortion_model") or "").lower()
    if any(lens[5:]) or lens_model not in _FIVE_COEFFICIENTS:
        raise IntrinsicsError(
            "has a lens model of more than five coefficients, or another than plumb_bob",
            source=path,
            remedy="rectify the pictures, or calibrate with five coefficients",
        )
    matrix = _by_rows(_numbers(value))
    ours: dict[str, Any] = {"stream": data.get("stream") or _stream_of(data, path)}
    for key in ("width", "height"):
        number = data.get(key, data.get(f"image_{key}", data.get(key[0])))
        if number is not None:
            ours[key] = number
    if any(lens):
        ours |= {"distortion": "brown_conrady", "coefficients": [*lens, *[0.0] * 5][:5]}
    projection = _numbers(_first(data, _PROJECTIONS) or [])
    if len(projection) == 12 and any(projection):
        ours["rectified"] = np.reshape(projection, (3, 4))[:, :3]
    return _in_region(ours | {"matrix": matrix}, data)


def _first(data: dict[str, Any], keys: tuple[str, ...]) -> Any:
    return next((data[key] for key in keys if key in data), None)


def _in_region(camera: dict[str, Any], data: dict[str, Any]) -> dict[str, Any]:
    """Return a camera of the region of interest and binning that ROS's `camera_info` states."""
    roi = data.get("roi") or {}
    axes = (("width", "x", 0), ("height", "y", 1))
    for key, axis, row in axes:
        start, binning = (
            float(roi.get(f"{axis}_offset") or 0),
            int(data.get(f"binning_{axis}") or 1),
        )
        if roi.get(key):
            camera[key] = int(roi[key]) // binning
        elif binning > 1:
            camera[key] = int(camera[key]) // binning
        for name in ("matrix", "rectified"):
            if name in camera and (start or binning > 1):
                k = np.array(camera[name], float).reshape(3, 3)
                k[row, row] /= binning
                k[row, 2] = (k[row, 2] - start + 0.5) / binning - 0.5
                camera[name] = k.ravel().tolist()
    return camera


def _by_rows(values: list[float]) -> list[float]:
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
    """Return the values of a matrix given as lists, or as `data`."""
    data = value["data"] if isinstance(value, dict) else value
    return np.asarray(data, dtype=float).ravel().tolist()
