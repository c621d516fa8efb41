"""Read intrinsics files: ours, those of ROS and librealsense, and plain matrices."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, PlainValidator, model_validator

from cucumbervision.arrays import Array
from cucumbervision.capture.intrinsics import (
    DepthAlong,
    Distortion,
    Intrinsics,
    Stream,
    pinhole_of_matrix,
)
from cucumbervision.capture.pictures import read_array
from cucumbervision.errors import IntrinsicsError, as_errors_of, wrap_reader_errors
from cucumbervision.files import parse_model, read_json, read_text


class StrictModel(BaseModel):
    """Model that rejects unknown keys and numbers that are not finite."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class CameraModel(StrictModel):
    """The camera block of a native capture: intrinsics and their stream."""

    width: int = Field(gt=0)
    height: int = Field(gt=0)
    fx: float = Field(gt=0)
    fy: float = Field(gt=0)
    cx: float
    cy: float
    distortion: Distortion = Distortion.NONE
    coefficients: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    stream: Stream

    @model_validator(mode="after")
    def _names_its_lens(self) -> CameraModel:
        if any(self.coefficients) and "distortion" not in self.model_fields_set:
            raise ValueError("coefficients need 'distortion', which says whose they are")
        return self

    @property
    def intrinsics(self) -> Intrinsics:
        """The block as `Intrinsics`."""
        names = (parameter.name for parameter in fields(Intrinsics))
        return Intrinsics(**{name: getattr(self, name.removesuffix("_px")) for name in names})

    @classmethod
    def of(cls, intrinsics: Intrinsics) -> CameraModel:
        """Create the block from `intrinsics`."""
        return cls(**{key.removesuffix("_px"): value for key, value in vars(intrinsics).items()})


def _rotation(values: Any) -> Array:
    """Return R, shape (3, 3), of its rows, or of the nine numbers of the SDK by columns."""
    rotation = np.array(values, dtype=float)
    rotation = rotation.reshape(3, 3).T if rotation.shape == (9,) else rotation
    is_square = rotation.shape == (3, 3)
    if not is_square or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        raise ValueError("is not a rotation, as three rows or the SDK's nine numbers by columns")
    if np.linalg.det(rotation) < 0:
        raise ValueError("is not a rotation but a mirror image")
    return rotation


def _vector(values: Any) -> Array:
    return np.array(values, dtype=float).reshape(3)


class Extrinsics(StrictModel):
    """Transform from depth to colour camera coordinates: x_color = R x_depth + t.

    Parameters
    ----------
    rotation : ndarray of float64, shape (3, 3)
        R.
    translation_m : ndarray of float64, shape (3,)
        t, metres.
    """

    rotation: Annotated[Any, PlainValidator(_rotation)]
    translation_m: Annotated[Any, PlainValidator(_vector)]


class _DepthModel(CameraModel):
    stream: Literal[Stream.DEPTH] = Stream.DEPTH


class CameraFile(CameraModel):
    """Contents of an intrinsics file; `intrinsics` is the camera of its stream.

    Parameters
    ----------
    path : Path
        The file, for error messages.
    depth : CameraModel, optional
        The depth camera, for depth that is not aligned to colour.
    depth_to_color : Extrinsics, optional
        Transform from the depth camera to the colour camera.
    depth_unit_m : float, optional
        Metres per depth step.
    depth_along : DepthAlong, optional
        Direction in which depth is measured.
    aligned_to : Stream, optional
        The camera whose pixels both images have.
    is_sized : bool
        Whether the file contains the image size.
    rectified : Intrinsics, optional
        Those of rectified images, where the file has them beside those of raw ones.
    """

    path: Any
    depth: _DepthModel | None = None
    depth_to_color: Extrinsics | None = None
    depth_unit_m: float | None = Field(default=None, gt=0)
    depth_along: DepthAlong | None = None
    aligned_to: Stream | None = None
    is_sized: bool = True
    rectified: Annotated[Any, PlainValidator(lambda camera: camera)] = None


_SAY_STREAM = (
    'add "stream": "color", or call the file color_intrinsics, if they are the colour camera\'s at '
    "that size (depth-stream intrinsics scale every length)"
)
_REMEDY = (
    "write ours (docs/captures.md), ROS's camera_info, librealsense's or a 3x3 matrix; a reader "
    "can be plugged in: examples/plugins.py"
)
# Keys of ROS and librealsense, with ours.
_KEYS = {
    **{"camera_matrix": "matrix", "K": "matrix", "k": "matrix", "cam_K": "matrix"},
    **{"projection_matrix": "P", "p": "P", "distortion_coefficients": "D", "d": "D"},
    **{"image_width": "width", "image_height": "height", "ppx": "cx", "ppy": "cy"},
    **{"coeffs": "coefficients", "model": "distortion"},
}
_FIVE_COEFFICIENTS = frozenset({"plumb_bob", "rational_polynomial", "brown_conrady", "none", ""})
# Files that are not read, since their lens, pixel or unit conventions are others: by a key, or by
# a beginning of their text.
_OTHERS = {
    **{"fl_x": "nerfstudio", "Camera.fx": "ORB-SLAM", "cam0": "Kalibr", "distCoeffs": "OpenCV"},
    **{"intrinsic": "Open3D", "intrinsic_matrix": "Open3D"},
}
_OTHER_TEXTS = (
    (re.compile(r"%YAML.*Camera\.fx", re.DOTALL), "ORB-SLAM"),
    (re.compile(r"%YAML|<opencv_storage|<\?xml"), "OpenCV"),
    (re.compile(r"(#.*\n)*\d+ [A-Z_]+ \d+ \d+ "), "COLMAP"),
)
_BOP_KEYS = frozenset({"cx", "cy", "depth_scale", "fx", "fy", "height", "width"})
# As librealsense prints it: [ 640x480  p[319.5 239.5]  f[600 600]  Brown Conrady [0 0 0 0 0] ]
_PRINTED = re.compile(
    r"\[\s*(\d+)x(\d+)\s+p\[(\S+) (\S+)\]\s+f\[(\S+) (\S+)\]\s+([A-Za-z ]+?)\s*"
    r"\[([^\]]*)\]\s*\]"
)
_COARSEST_M = 0.01  # of the steps of depth
_COLOR = re.compile(r"colou?r|rgb", re.IGNORECASE)
_NOT_COLOR = re.compile(r"depth|infra|(^|[^a-z])ir([^a-z]|$)", re.IGNORECASE)


def read_camera_file(path: Path) -> CameraFile:
    """Read an intrinsics file.

    Parameters
    ----------
    path : Path
        JSON with `stream, width, height, fx, fy, cx, cy`, optionally `distortion, coefficients,
        depth, depth_to_color, depth_unit_m, depth_along, aligned_to`, or the same with a 3x3
        `matrix` for fx, fy, cx, cy; ROS's `camera_info` (`K`, `D`) or its calibration file
        (`camera_matrix`); a stream's intrinsics of pyrealsense2 (`ppx`, `ppy`, `coeffs`), or as it
        prints them; those of several streams by name (`color`, `depth`). A matrix alone, of three
        or four rows and columns, as text, JSON or `.npy`.

    Returns
    -------
    CameraFile
        Contents of the file; use `check_intrinsics` to check them against an image.

    Raises
    ------
    CaptureError
        If the file is missing or cannot be parsed.
    IntrinsicsError
        If a key is missing, unknown or invalid, the stream is missing, the file is of another
        program, or has a lens model with more than five coefficients.

    Notes
    -----
    A matrix, or ROS's, is the colour camera's, unless the name of the file or of its frame
    contains 'depth' or 'infra'. Ours and pyrealsense2's must name the stream, in the file or in
    its name.
    """
    data = _read(path)
    data = {"matrix": data} if isinstance(data, list) else data
    if not isinstance(data, dict):
        remedy = "give one JSON object with stream, fx, …"
        raise IntrinsicsError("holds no intrinsics", source=path, remedy=remedy)
    program = next((_OTHERS[key] for key in data if key in _OTHERS), "")
    if program or frozenset(data) == _BOP_KEYS:
        raise _other_program(program or "BOP", path)
    with wrap_reader_errors(path, IntrinsicsError):
        data, step = _color_block(data), data.get("depth_scale")
        unit = {} if step is None else {"depth_unit_m": _unit_m(float(step), path)}
        data = {_KEYS.get(key, key): value for key, value in data.items() if key != "depth_scale"}
        if "matrix" in data and ("stream" not in data or "D" in data):
            data = _of_ros(data, path)
        data |= unit
    is_sized = {"width", "height"} <= data.keys()
    if "matrix" in data:
        with as_errors_of(path):
            fx, fy, cx, cy = pinhole_of_matrix(data.pop("matrix"))
        # Without a size, the intrinsics apply to the image that they are used with.
        about = (
            {} if is_sized else {"width": max(1, round(2 * cx)), "height": max(1, round(2 * cy))}
        )
        data |= {"fx": fx, "fy": fy, "cx": cx, "cy": cy, **about}
    by_name = {"color": _COLOR, "depth": _NOT_COLOR}
    streams = [stream for stream, word in by_name.items() if word.search(path.stem)]
    if "stream" not in data and len(streams) != 1:
        fault = "does not say which stream these intrinsics belong to"
        raise IntrinsicsError(fault, source=path, remedy=_SAY_STREAM)
    data = {"stream": streams[0] if streams else "", **data, "path": path, "is_sized": is_sized}
    rectified = data.pop("rectified", None)
    if "distortion" in data:
        data["distortion"] = str(data["distortion"]).removeprefix("distortion.")
    camera = parse_model(CameraFile, data, source=path, error=IntrinsicsError)
    with as_errors_of(path):
        _ = camera.intrinsics, camera.depth and camera.depth.intrinsics  # a camera can be these
        if rectified is not None:
            size = camera.intrinsics.size
            camera.rectified = Intrinsics.from_matrix(rectified, *size, camera.stream)
    return camera


def _other_program(program: str, path: Path) -> IntrinsicsError:
    return IntrinsicsError(f"is a camera file of {program}", source=path, remedy=_REMEDY)


def _color_block(data: dict[str, Any]) -> dict[str, Any]:
    """Return the colour camera's block of a file with several, else the file's own keys."""
    blocks = [key for key, value in data.items() if isinstance(value, dict)]
    colors = [key for key in blocks if _COLOR.search(key) and not _NOT_COLOR.search(key)]
    if len(colors) != 1 or "stream" in data:
        return data
    return {**data[colors[0]], "stream": "color"}


def _unit_m(scale: float, path: Path) -> float:
    """Return the unit of a 'depth_scale', in metres a step or steps a metre."""
    if 0 < scale <= _COARSEST_M:
        return scale
    if scale >= 1 / _COARSEST_M:
        return 1 / scale
    fault = f"has a depth_scale of {scale:g}, neither metres a step nor steps a metre"
    raise IntrinsicsError(fault, source=path, remedy="write depth_unit_m, the metres of a step")


def _read(path: Path) -> Any:
    suffix = path.suffix.lower()
    if suffix == ".json":
        return read_json(path)
    with wrap_reader_errors(path, IntrinsicsError):
        if suffix == ".npy":
            return {"matrix": read_array(path).astype(float)}
        text = read_text(path)
        for other, program in _OTHER_TEXTS:
            if other.match(text):
                raise _other_program(program, path)
        if suffix in (".yaml", ".yml"):
            import yaml

            if "&" in text and "*" in text:
                raise ValueError("it has anchors, which may stand for much more than they are")
            return yaml.safe_load(text)
        if printed := _PRINTED.search(text):
            *numbers, lens, coefficients = printed.groups()
            names = ("width", "height", "ppx", "ppy", "fx", "fy")
            return {
                **{name: float(number) for name, number in zip(names, numbers, strict=True)},
                "model": lens.strip().lower().replace(" ", "_"),
                "coeffs": [float(number) for number in coefficients.split()],
            }
        rows = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
        return {"matrix": np.array(" ".join(rows).replace(",", " ").split(), dtype=float)}


def _of_ros(data: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the camera of a matrix, with what ROS's `camera_info` writes beside it."""
    lens = _numbers(data.get("D") or []).tolist()
    lens_model = str(data.get("distortion_model") or "").lower()
    if any(lens[5:]) or lens_model not in _FIVE_COEFFICIENTS:
        raise IntrinsicsError(
            "has a lens model of more than five coefficients, or another than plumb_bob",
            source=path,
            remedy="rectify the pictures, or calibrate with five coefficients",
        )
    matrix = _numbers(data["matrix"])
    matrix = matrix.reshape(4, 4)[:3, :3] if matrix.size == 16 else matrix
    ours: dict[str, Any] = {"stream": data.get("stream") or _stream_of(data, path)}
    if any(lens):
        ours |= {"distortion": "brown_conrady", "coefficients": [*lens, *[0.0] * 5][:5]}
    # The region of interest and the binning that `camera_info` states.
    roi = data.get("roi") or {}
    start = np.array([float(roi.get(f"{axis}_offset") or 0) for axis in "xy"])
    binning = np.array([int(data.get(f"binning_{axis}") or 1) for axis in "xy"])
    for key, binned in zip(("width", "height"), binning.tolist(), strict=True):
        if key in data:
            ours[key] = int(roi.get(key) or data[key]) // binned
    matrices = {"matrix": matrix}
    projection = _numbers(data.get("P") or [])
    if projection.size == 12 and projection.any():
        matrices["rectified"] = projection.reshape(3, 4)[:, :3]
    for name, values in matrices.items():
        if values.size == 9 and (start.any() or (binning > 1).any()):
            values = values.reshape(3, 3).copy()
            values[:2, :2] /= binning[:, None]
            values[:2, 2] = (values[:2, 2] - start + 0.5) / binning - 0.5
        ours[name] = values
    return ours


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


def _numbers(value: Any) -> Array:
    """Return the values of a matrix given as lists, or as `data`."""
    return np.array(value["data"] if isinstance(value, dict) else value, dtype=float).ravel()
