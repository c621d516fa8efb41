"""Convert intrinsics files of other programs to the keys of the native format."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.capture.files import read_json, read_text
from cucumbervision.errors import IntrinsicsError, wrap_reader_errors

if TYPE_CHECKING:
    from pathlib import Path

_BOP_KEYS = frozenset({"cx", "cy", "depth_scale", "fx", "fy", "height", "width"})
_MATRICES = ("camera_matrix", "cameraMatrix", "K", "k", "cam_K")
_LENSES = ("distortion_coefficients", "distCoeffs", "dist_coeffs", "D", "d")
_COLOR = re.compile(r"colou?r|rgb", re.IGNORECASE)
_NOT_COLOR = re.compile(r"depth|infra|(^|[^a-z])ir([^a-z]|$)", re.IGNORECASE)


def camera_document(path: Path) -> dict[str, Any]:
    """Read an intrinsics file of any supported format as a document with native keys.

    Parameters
    ----------
    path : Path
        JSON or YAML: ours; BOP's `camera.json`; Open3D's (`intrinsic_matrix`); ROS's `camera_info`
        (`K`, `D`); a stream's intrinsics of pyrealsense2 (`ppx`, `ppy`, `coeffs`). OpenCV's YAML,
        XML or JSON (`camera_matrix`). A text of three rows of three numbers.

    Raises
    ------
    CaptureError
        If the file is missing or cannot be parsed.
    IntrinsicsError
        If the file contains no intrinsics, or a lens model with more than five coefficients.

    Notes
    -----
    Formats without a place for the stream are the colour camera's, unless the file's name or its
    frame's says 'depth' or 'infra'; BOP's is by definition. pyrealsense2's must say it, since it
    writes those of any stream alike.
    """
    data = _read(path)
    if not isinstance(data, dict):
        raise IntrinsicsError(
            "holds no intrinsics", source=path, remedy="give one JSON object with stream, fx, …"
        )
    with wrap_reader_errors(path, IntrinsicsError):
        data = dict(data.get("intrinsic") or data)
        if frozenset(data) == _BOP_KEYS:
            # BOP: depth_scale times the stored number is millimetres.
            return data | {"stream": "color", "depth_unit_m": data.pop("depth_scale") * 0.001}
        if "ppx" in data:
            return _of_realsense(data)
        return data if "stream" in data else _of_matrix(data, path)


def _read(path: Path) -> Any:
    suffix = path.suffix.lower()
    if suffix == ".json":
        return read_json(path)
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
            return {one.tag: {part.tag: part.text for part in one} or one.text for one in root}
        if suffix in (".yaml", ".yml"):
            import yaml

            # OpenCV's first line and tags are not valid in current YAML.
            return yaml.safe_load(re.sub(r"^%YAML.*|!!opencv-matrix", "", text, flags=re.M))
        return {"K": np.array(text.split(), dtype=float)}


def _of_realsense(data: dict[str, Any]) -> dict[str, Any]:
    names = {"ppx": "cx", "ppy": "cy", "coeffs": "coefficients", "model": "distortion"}
    ours = {names.get(key, key): value for key, value in data.items()}
    if "distortion" in ours:
        ours["distortion"] = str(ours["distortion"]).removeprefix("distortion.")
    return ours


def _of_matrix(data: dict[str, Any], path: Path) -> dict[str, Any]:
    matrix = next((data[key] for key in _MATRICES if key in data), None)
    if "intrinsic_matrix" in data:  # Open3D uses column-major order
        matrix = np.asarray(data["intrinsic_matrix"], dtype=float)
        matrix = matrix.reshape(3, 3).T if matrix.ndim == 1 else matrix
    if matrix is None:
        return data
    ours: dict[str, Any] = {
        "stream": _stream_of(data, path),
        "matrix": _numbers(matrix),
    }
    for key in ("width", "height"):
        value = data.get(key, data.get(f"image_{key}"))
        if value is not None:
            ours[key] = value
    lens = next((_numbers(data[key]) for key in _LENSES if key in data), [])
    if any(lens):
        if any(lens[5:]) or str(data.get("distortion_model", "plumb_bob")) != "plumb_bob":
            raise IntrinsicsError(
                "has a lens model of more than five coefficients, or another than plumb_bob",
                source=path,
                remedy="rectify the pictures, or calibrate with five coefficients",
            )
        ours |= {"distortion": "brown_conrady", "coefficients": [*lens, *[0.0] * 5][:5]}
    return ours


def _stream_of(data: dict[str, Any], path: Path) -> str:
    """Return the stream: by the frame's name where that tells it, else by the camera's and file's.

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
