"""Read and find intrinsics files: ours, those of ROS and librealsense, and plain matrices."""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from cucumbervision.capture.intrinsics import DepthAlong, Intrinsics, Stream, pinhole_of_matrix
from cucumbervision.capture.pictures import read_array
from cucumbervision.errors import CaptureError, IntrinsicsError, as_errors_of, wrap_reader_errors
from cucumbervision.files import parse_model, read_json, read_text
from cucumbervision.tube.camera import Distortion

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from cucumbervision.capture.source import Folder


_OWN_NAME = "intrinsics.json"
_CAMERA_NAME = re.compile(
    r"(.*(intrinsic|camera|cam_?k|calib).*|k)\.(json|ya?ml|xml|txt)"
    r"|(.*(intrinsics?|cam_?k|camera_?matrix)|k)\.npy",
    re.IGNORECASE,
)
_CAMERA_WORD = re.compile(
    r"intrinsics?|camera|cam|k|camk|calib(ration)?|info|colou?r|rgb|depth|aligned|to|matrix|params?"
)
_SAY_STREAM = (
    'add "stream": "color", or call the file color_intrinsics, if they are the colour camera\'s at '
    "that size (depth-stream intrinsics scale every length)"
)


@dataclass(frozen=True, eq=False)
class Extrinsics:
    """Transform from depth to colour camera coordinates: x_color = R x_depth + t.

    Parameters
    ----------
    rotation : ndarray of float64, shape (3, 3)
        R in row-major order.
    translation_m : ndarray of float64, shape (3,)
        t, metres.
    """

    rotation: NDArray[np.float64]
    translation_m: NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraFile:
    """Contents of an intrinsics file.

    Parameters
    ----------
    intrinsics : Intrinsics
        Intrinsics of the stream given in the file.
    path : Path
        The file, for error messages.
    depth : Intrinsics, optional
        Intrinsics of the depth camera, for depth that is not aligned to colour.
    depth_to_color : Extrinsics, optional
        Transform from the depth camera to the colour camera.
    depth_unit_m : float, optional
        Metres per depth step.
    depth_along : DepthAlong, optional
        Direction in which depth is measured.
    aligned_to : Stream, optional
        The camera whose pixels both pictures have.
    is_sized : bool
        Whether the file contains the picture size.
    rectified : Intrinsics, optional
        Those of rectified pictures, where the file has them beside those of raw ones.
    """

    intrinsics: Intrinsics
    path: Path
    depth: Intrinsics | None = None
    depth_to_color: Extrinsics | None = None
    depth_unit_m: float | None = None
    depth_along: DepthAlong | None = None
    aligned_to: Stream | None = None
    is_sized: bool = True
    rectified: Intrinsics | None = None


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
        return Intrinsics(
            **{
                parameter.name: getattr(self, parameter.name.removesuffix("_px"))
                for parameter in fields(Intrinsics)
            }
        )

    @classmethod
    def of(cls, intrinsics: Intrinsics) -> CameraModel:
        """Create the block from `intrinsics`."""
        return cls(**{key.removesuffix("_px"): value for key, value in vars(intrinsics).items()})


class _DepthModel(CameraModel):
    stream: Literal[Stream.DEPTH] = Stream.DEPTH


class _ExtrinsicsModel(StrictModel):
    # Nine numbers are the SDK's rs2_extrinsics in column-major order; three rows are a matrix.
    rotation: list[float] | list[list[float]]
    translation_m: tuple[float, float, float]


class _FileModel(CameraModel):
    depth: _DepthModel | None = None
    depth_to_color: _ExtrinsicsModel | None = None
    depth_unit_m: float | None = Field(default=None, gt=0)
    depth_along: DepthAlong | None = None
    aligned_to: Stream | None = None


class CameraFinder:
    """Finds the intrinsics file of a picture, in its folder or the nearest parent folder.

    A file whose name refers to certain pictures (`cam1_intrinsics.json` beside `cam1_color_1.png`
    and `cam2_color_1.png`) belongs only to these. Of several other files, the native name has
    priority; the others must contain the same camera.

    Parameters
    ----------
    folder : Folder
        The available files.

    Examples
    --------
    >>> from pathlib import Path
    >>> from cucumbervision.capture.source import Folder
    >>> walk = Folder(Path("walk"), {"": ["camera.json"], "rgb": ["1.png"]})
    >>> CameraFinder(walk).find("rgb")
    PosixPath('walk/camera.json')
    """

    def __init__(self, folder: Folder) -> None:
        self._folder = folder
        self._pictures = lru_cache(maxsize=None)(self._begins_of_pictures)
        self._cameras = lru_cache(maxsize=None)(self._cameras_by_owner)
        self._only = lru_cache(maxsize=None)(_only)

    def find(self, folder_path: str, picture: str = "") -> Path | None:
        """Return the file of a picture, or of a subfolder; None without one.

        Raises
        ------
        IntrinsicsError
            If several files could belong to the picture and differ.
        """
        words, others = _stem_words(picture), self._pictures(folder_path)
        while True:
            owners = self._cameras(folder_path)
            length = next((k for k in range(len(words), 0, -1) if words[:k] in owners), 0)
            shared = (name for owner in owners if owner not in others for name in owners[owner])
            names = tuple(sorted(owners[words[:length]] if length else shared))
            if names or not folder_path:
                file = self._only(self._folder.path / folder_path, names)
                if isinstance(file, IntrinsicsError):
                    raise file
                return file
            folder_path = folder_path.rpartition("/")[0]

    def _begins_of_pictures(self, folder_path: str) -> set[tuple[str, ...]]:
        """Return the words with which names of pictures begin."""
        names = self._folder.files.get(folder_path, ())
        pictures = (_stem_words(name) for name in names if _is_picture(name))
        return {words[:k] for words in pictures for k in range(1, len(words) + 1)}

    def _cameras_by_owner(self, folder_path: str) -> dict[tuple[str, ...], list[str]]:
        """Return the intrinsics files of a folder by the words that refer to certain pictures."""
        owners: dict[tuple[str, ...], list[str]] = {}
        for name in self._folder.files.get(folder_path, ()):
            if _CAMERA_NAME.fullmatch(name):
                owner = tuple(w for w in _stem_words(name) if not _CAMERA_WORD.fullmatch(w))
                owners.setdefault(owner, []).append(name)
        return owners


def _only(folder: Path, names: tuple[str, ...]) -> Path | IntrinsicsError | None:
    """Return the only file with a camera among these, or why none is; None without a file."""
    if _OWN_NAME in names or len(names) < 2:
        return folder / (_OWN_NAME if _OWN_NAME in names else names[0]) if names else None
    cameras: dict[str, Intrinsics] = {}
    for name in names:
        with suppress(CaptureError):
            camera = read_camera_file(folder / name).intrinsics
            if camera.stream is Stream.COLOR:
                cameras[name] = camera
    if len(set(cameras.values())) > 1:
        return IntrinsicsError(
            "{names} hold different cameras, and no name tells whose is whose",
            source=folder,
            remedy="begin its name as the pictures' (cam1_intrinsics.json), or give --intrinsics",
            names=", ".join(cameras),
        )
    return folder / next(iter(cameras), names[0])


def _is_picture(name: str) -> bool:
    return name.lower().endswith((".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".ppm"))


def _stem_words(name: str) -> tuple[str, ...]:
    return tuple(re.findall(r"[^\W_]+", name.rpartition(".")[0].casefold()))


def read_camera_file(path: Path) -> CameraFile:
    """Read an intrinsics file.

    Parameters
    ----------
    path : Path
        JSON with `stream, width, height, fx, fy, cx, cy`, optionally `distortion, coefficients,
        depth, depth_to_color, depth_unit_m, depth_along, aligned_to`, or the same with a 3x3
        `matrix` for fx, fy, cx, cy; or what `camera_document` knows.

    Returns
    -------
    CameraFile
        Contents of the file; use `check_intrinsics` to check them against a picture.

    Raises
    ------
    CaptureError
        If the file is missing or cannot be parsed.
    IntrinsicsError
        If a key is missing, unknown or invalid, or the stream is missing.
    """
    data = camera_document(path)
    if "stream" not in data:
        raise IntrinsicsError(
            "does not say which stream these intrinsics belong to", source=path, remedy=_SAY_STREAM
        )
    sized = True
    if "matrix" in data:
        with as_errors_of(path):
            values = pinhole_of_matrix(data.pop("matrix"))
        data |= dict(zip(("fx", "fy", "cx", "cy"), values, strict=True))
        # Without a size, the intrinsics apply to the picture that they are used with.
        sized = {"width", "height"} <= data.keys()
        if not sized:
            data |= {"width": max(1, round(2 * values[2])), "height": max(1, round(2 * values[3]))}
    rectified = data.pop("rectified", None)
    model = parse_model(_FileModel, data, source=path, error=IntrinsicsError)
    with as_errors_of(path):
        return CameraFile(
            intrinsics=model.intrinsics,
            path=path,
            depth=model.depth.intrinsics if model.depth else None,
            depth_to_color=_extrinsics(model.depth_to_color, path)
            if model.depth_to_color
            else None,
            depth_unit_m=model.depth_unit_m,
            depth_along=model.depth_along,
            aligned_to=model.aligned_to,
            is_sized=sized,
            rectified=None
            if rectified is None
            else Intrinsics.from_matrix(rectified, model.width, model.height, model.stream),
        )


def _extrinsics(model: _ExtrinsicsModel, path: Path) -> Extrinsics:
    try:
        rotation = np.array(model.rotation, dtype=float)
    except ValueError:
        rotation = np.zeros(0)
    if rotation.shape == (9,):
        rotation = rotation.reshape(3, 3).T
    proper = rotation.shape == (3, 3) and (
        np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) and np.linalg.det(rotation) > 0
    )
    if not proper:
        raise IntrinsicsError(
            "'depth_to_color.rotation' is not a rotation",
            source=path,
            remedy="give the SDK's nine numbers (column by column) or a matrix of three rows",
        )
    return Extrinsics(cast("NDArray[np.float64]", rotation), np.array(model.translation_m))


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
