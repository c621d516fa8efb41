"""Read colour and depth pictures with matching names, and `.npz` files with both."""

from __future__ import annotations

import re
import zipfile
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING
from unicodedata import normalize

import numpy as np

from cucumbervision.capture.camera_file import CameraFile, camera_file_near, read_camera_file
from cucumbervision.capture.intrinsics import Intrinsics, Stream
from cucumbervision.capture.pictures import (
    COLOR_SUFFIXES,
    DEPTH_SUFFIXES,
    read_arrays,
    read_color,
    read_depth,
)
from cucumbervision.capture.readers.common import frame_capture, no_intrinsics
from cucumbervision.capture.source import CaptureSource, fail
from cucumbervision.errors import CaptureError, IntrinsicsError, as_errors_of
from cucumbervision.files import read_head, read_text

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from cucumbervision.capture.frames import Capture
    from cucumbervision.capture.source import CaptureEntry, CaptureLister, Folder, ReadOptions

_COLOR_WORD = re.compile(r"colou?r|rgb", re.IGNORECASE)
_LISTS = frozenset({"associations.txt", "associated.txt", "associate.txt", "assoc.txt"})
_TIMES = ("rgb.txt", "depth.txt")
_LENS = re.compile(r"dist(ort|_?coef|$)|coef|lens", re.IGNORECASE)  # names of arrays in an `.npz`
_UNIT = re.compile(r"depth_?(scale|unit)", re.IGNORECASE)
_TUM_STEP_M = 1 / 5000
_TUM_APART_S = 0.02  # most between a colour picture and its depth
_DEPTH_WORD = re.compile(r"depth", re.IGNORECASE)


@dataclass(frozen=True)
class Pair:
    """Files of one frame; None for a missing file, the same `.npz` for both if it contains both.

    Parameters
    ----------
    color, depth : Path, optional
        The pictures.
    camera : Path, optional
        Nearest intrinsics file, in the folder of the colour picture or above.
    unit_m : float, optional
        Metres per depth step, if defined by the format.
    fault : CaptureError, optional
        Why no intrinsics file can be chosen.
    """

    color: Path | None
    depth: Path | None
    camera: Path | None = None
    unit_m: float | None = None
    fault: CaptureError | None = None

    @property
    def is_whole(self) -> bool:
        """Whether one file contains both."""
        return self.color is not None and self.color == self.depth


def find_pairs(folder: Folder) -> CaptureLister | None:
    """Find the frames of `match_pairs`, and mark their files as used."""
    try:
        pairs = _associated(folder)
    except CaptureError as error:
        folder.faults.append(error)
        pairs = []
    pairs = pairs or match_pairs(folder)
    taken = {file for pair in pairs for file in (pair.color, pair.depth)}
    for folder_path, names in folder.files.items():
        names[:] = [name for name in names if folder.path / folder_path / name not in taken]
    return partial(_open_pairs, folder.path, pairs) if pairs else None


def match_pairs(folder: Folder) -> list[Pair]:
    """Pair the pictures of a folder by name, and add `.npz` files with colour and depth.

    Names match if they are equal except for the words 'color', 'colour', 'rgb' and 'depth':
    `rgb_7.png` and `depth_7.png`, `color/7.jpg` and `depth/7.npy`, `7_color_depth.npy` and
    `7_color.png`, or plain `7.png` and `7_depth.npy`. An unmatched picture becomes a pair with a
    missing part, so that it is reported; unmatched 8-bit 'depth' pictures are ignored. Without any
    complete pair, the result is empty.
    """
    colors, depths = _by_role(folder)
    shared = colors.keys() & depths.keys()
    used = {depths[key] for key in shared}
    arrays = [n for n in folder if n.lower().endswith(".npz") and n not in used]
    color_arrays = [name for name in arrays if _holds_color(folder.path / name)]
    named: list[tuple[str | None, str | None]] = [(name, name) for name in color_arrays]
    for key in sorted(colors.keys() | depths.keys()) if shared else ():
        color, depth = colors.get(key), depths.get(key)
        if depth not in color_arrays and (color or not _is_8_bit_png(folder.path / str(depth))):
            named.append((color, depth))
    pairs = []
    for color, depth in named:
        folder_path, _, picture = str(color or depth).rpartition("/")
        pictures = [None if name is None else folder.path / name for name in (color, depth)]
        pairs.append(_pair(folder, folder_path, picture, pictures))
    return pairs


def _pair(folder: Folder, folder_path: str, picture: str, files: Sequence[Path | None]) -> Pair:
    try:
        return Pair(files[0], files[1], camera_file_near(folder, folder_path, picture))
    except IntrinsicsError as error:
        return Pair(files[0], files[1], fault=error)


def _associated(folder: Folder) -> list[Pair]:
    """Return the pairs of a TUM sequence.

    Pairs come from the association file (time, colour, time, depth), or without one from the times
    in both lists.
    """
    names, pairs = {*folder}, []
    for folder_path, file_names in folder.files.items():
        lists = [
            _rows(folder.path / folder_path / name, 4)
            for name in file_names
            if name.lower() in _LISTS
        ]
        if not lists and {*_TIMES} <= {*file_names}:
            lists = [
                _nearest_in_time(*(_rows(folder.path / folder_path / name, 2) for name in _TIMES))
            ]
        camera = camera_file_near(folder, folder_path) if lists else None
        for words in (row for rows in lists for row in rows):
            files = [f"{folder_path}/{word}".lstrip("/") for word in words[1::2]]
            if {*files} <= names:
                color, depth = sorted(files, key=lambda f: bool(_DEPTH_WORD.search(f)))
                pairs.append(Pair(folder.path / color, folder.path / depth, camera, _TUM_STEP_M))
    return pairs


def _rows(path: Path, words: int) -> list[list[str]]:
    # A line that begins with # is a comment.
    rows = [line.split() for line in read_text(path).splitlines() if not line.startswith("#")]
    return [row for row in rows if len(row) == words]


def _nearest_in_time(colors: list[list[str]], depths: list[list[str]]) -> list[list[str]]:
    """Return each colour picture's row with that of the depth picture nearest in time."""
    from scipy.spatial import cKDTree

    try:
        at_s, depth_s = (np.array([[float(r[0])] for r in rows]) for rows in (colors, depths))
        nearest = cKDTree(depth_s).query(at_s, distance_upper_bound=_TUM_APART_S)[1]
    except ValueError:  # no times, or none that are finite
        return []
    pairs = zip(colors, np.asarray(nearest).tolist(), strict=True)
    return [[*color, *depths[k]] for color, k in pairs if k < len(depths)]


def _by_role(folder: Folder) -> tuple[dict[str, str], dict[str, str]]:
    """Return the colour and the depth pictures by the key of their pair.

    An 8-bit depth picture is replaced by any other one with the same key. A picture without a role
    in its name is the colour of the depth picture with the same key.
    """
    colors: dict[str, str] = {}
    depths: dict[str, str] = {}
    plain: dict[str, str] = {}
    for name in sorted(folder):
        role, key = _pair_role(name)
        if role == "depth" and (key not in depths or _is_8_bit_png(folder.path / depths[key])):
            depths[key] = name
        elif role == "color":
            colors.setdefault(key, name)
        elif role == "picture":
            plain.setdefault(key, name)
    return {key: name for key, name in plain.items() if key in depths} | colors, depths


def _pair_role(name: str) -> tuple[str, str]:
    """Return the role of a file by its name, and the key of its pair.

    The role is 'depth', 'color', 'picture' if no name has one, or '' for other files. The file's
    own name decides, then its folder's, then those above. The key is what remains without the
    words of the roles; it is the same for two files only if every other letter and sign is.

    Examples
    --------
    >>> _pair_role("color/7.jpg"), _pair_role("depth/7.npy"), _pair_role("notes.txt")[0]
    (('color', '7'), ('depth', '7'), '')
    >>> _pair_role("depthcam/color_1.png"), _pair_role("左/depth_1.png")
    (('color', 'cam/1'), ('depth', '左/1'))
    """
    stem, dot, ending = name.rpartition(".")
    suffix = f"{dot}{ending}".lower()
    parts = normalize("NFC", stem).split("/")
    role = next((role for part in reversed(parts) if (role := _role_of(part))), "picture")
    if role == "depth" and suffix not in DEPTH_SUFFIXES:
        role = "" if suffix not in COLOR_SUFFIXES else "picture"
    if role in ("color", "picture") and suffix not in COLOR_SUFFIXES:
        return "", ""
    return role, "/".join(filter(None, map(_without_roles, parts)))


def _role_of(part: str) -> str:
    """Return the role in a single name; whole words before parts of words, depth first."""
    words = re.findall(r"[^\W\d_]+", part)
    for is_role in (re.Pattern.fullmatch, re.Pattern.search):
        for role, pattern in (("depth", _DEPTH_WORD), ("color", _COLOR_WORD)):
            if any(is_role(pattern, word) for word in words):
                return role
    return ""


def _without_roles(part: str) -> str:
    """Return a name without the words of the roles and one separator for each.

    Examples
    --------
    >>> [_without_roles(name) for name in ("color_7", "7-depth", "a_depth_b", "d2__1_rgb")]
    ['7', '7', 'a_b', 'd2__1']
    """
    for pattern in (_DEPTH_WORD, _COLOR_WORD):
        words = rf"([\W_]?)(?:{pattern.pattern})([\W_]?)"
        part = re.sub(words, _separator, part, flags=re.IGNORECASE)
    return part


def _separator(match: re.Match[str]) -> str:
    """Return what stands for a removed word: the separator before it, if it stood between two."""
    before, after = match.groups()
    if before and after:
        return str(before) if match.start() and match.end() < len(match.string) else ""
    outer = (before and match.end() == len(match.string)) or (after and not match.start())
    return "" if outer else str(before or after)


def is_half_a_pair(name: str) -> bool:
    """Return whether a file is a colour or a depth picture by its name."""
    return _pair_role(name)[0] in ("color", "depth")


def _is_8_bit_png(path: Path) -> bool:
    """Return whether a file is an 8-bit PNG, which is a visualisation of depth."""
    head = _head(path, 25)
    return head.startswith(b"\x89PNG") and head[-1] == 8


def _head(path: Path, size: int) -> bytes:
    try:
        return read_head(path, size)
    except CaptureError:  # reported when the file is read
        return b""


def _holds_color(path: Path) -> bool:
    """Return whether an `.npz` has an array 'color'; damaged files are reported when read."""
    if _head(path, 2) != b"PK":
        return True
    try:
        with path.open("rb") as stream, zipfile.ZipFile(stream) as archive:
            return "color.npy" in archive.namelist()
    except Exception:  # zipfile can raise any exception
        return True


def _open_pairs(
    path: Path, pairs: Sequence[Pair], options: ReadOptions, camera_file: CameraFile | None
) -> Iterator[CaptureEntry]:
    cameras_by_path: dict[Path | None, CameraFile | CaptureError | None] = {None: camera_file}
    for file in {pair.camera for pair in pairs if pair.camera}:
        try:
            cameras_by_path[file] = camera_file or read_camera_file(file)
        except CaptureError as error:
            cameras_by_path[file] = error
    cameras = [(camera_file or pair.fault or cameras_by_path[pair.camera]) for pair in pairs]
    if not any(isinstance(camera, CameraFile) for camera in cameras) and not any(
        p.is_whole for p in pairs
    ):
        raise next(
            (camera for camera in cameras if isinstance(camera, CaptureError)), no_intrinsics(path)
        )
    for frame, (pair, camera) in enumerate(zip(pairs, cameras, strict=True)):
        picture = pair.color or pair.depth or path
        load: Callable[[str], Capture]
        if isinstance(camera, CaptureError):
            yield picture.stem, frame, partial(fail, camera), picture, partial(_files, pair, None)
            continue
        if pair.is_whole:
            load = partial(_load_npz, picture, camera, options)
        else:
            load = partial(_load_pair, pair, frame, camera, options)
        yield picture.stem, frame, load, picture, partial(_files, pair, camera)


def _files(pair: Pair, camera_file: CameraFile | None) -> list[Path]:
    return [
        *dict.fromkeys(f for f in (pair.color, pair.depth, camera_file and camera_file.path) if f)
    ]


def open_pair_file(path: Path, options: ReadOptions) -> CaptureSource:
    """Open a colour picture with `options.depth`, or an `.npz` with both.

    Parameters
    ----------
    path : Path
        The colour picture, or an `.npz` with `color` uint8 (H, W, 3) RGB, `depth` (H, W) aligned
        to it and, unless `options` names intrinsics, `matrix`: the colour camera's 3x3 matrix in
        pixels. An array `stream` may say 'color'.
    options : ReadOptions
        The depth picture, intrinsics and depth unit.

    Raises
    ------
    CaptureError
        If the file is neither.
    IntrinsicsError
        If the intrinsics are missing or invalid.
    """
    suffix = path.suffix.lower()
    is_array = suffix == ".npz" and options.depth is None
    if not is_array and (suffix not in COLOR_SUFFIXES or options.depth is None):
        raise CaptureError(
            "a colour picture alone has no distances"
            if suffix in COLOR_SUFFIXES
            else f"'{suffix}' files are not captures",
            source=path,
            remedy="name a colour picture with its depth picture, or a capture folder",
        )
    camera_file = read_camera_file(options.intrinsics) if options.intrinsics else None
    pair = Pair(path, path if is_array else options.depth)
    return CaptureSource.listed(path, "pair", _open_pairs(path, [pair], options, camera_file))


def _load_pair(
    pair: Pair, frame: int, camera_file: CameraFile | None, options: ReadOptions, name: str
) -> Capture:
    if pair.color is None or pair.depth is None:
        raise CaptureError(
            f"has no {'colour' if pair.color is None else 'depth'} picture of a matching name",
            source=pair.color or pair.depth,
            remedy="put it beside this one",
        )
    if camera_file is None:
        raise no_intrinsics(pair.color)
    return frame_capture(
        read_color(pair.color),
        partial(read_depth, pair.depth),
        None,
        camera_file,
        options.depth_unit_m or camera_file.depth_unit_m or pair.unit_m,
        options,
        source=pair.color,
        depth_source=pair.depth,
        name=name,
        frame=frame,
        provenance={
            "reader": "pair",
            "depth": str(pair.depth),
            "intrinsics": str(camera_file.path),
        },
    )


def _load_npz(
    path: Path, camera_file: CameraFile | None, options: ReadOptions, name: str
) -> Capture:
    arrays = read_arrays(path)
    if "color" not in arrays:
        raise CaptureError(
            f"has no array 'color', only {', '.join(sorted(arrays))}",
            source=path,
            remedy="save it with numpy.savez(file, color=..., depth=..., matrix=...)",
        )
    color = arrays["color"]
    if color.ndim != 3 or color.shape[2] != 3 or color.dtype != np.uint8:
        raise CaptureError(
            f"'color' is {color.dtype} {color.shape}, not uint8 (H, W, 3)",
            source=path,
            remedy="save an 8-bit RGB picture",
        )
    unread = [name for name in arrays if _LENS.match(name) and camera_file is None]
    unread += [name for name in arrays if _UNIT.search(name) and options.depth_unit_m is None]
    if unread:
        raise CaptureError(
            f"has an array '{unread[0]}', which is not read",
            source=path,
            remedy="give a lens by --intrinsics and a unit by --depth-unit, or leave it out",
        )
    frame_intrinsics = _npz_intrinsics(arrays, path) if "matrix" in arrays else None
    return frame_capture(
        color,
        lambda: arrays["depth"],
        frame_intrinsics,
        camera_file,
        options.depth_unit_m,
        options,
        source=path,
        depth_source=path,
        name=name,
        provenance={"reader": "pair"},
    )


def _npz_intrinsics(arrays: dict[str, np.ndarray], path: Path) -> Intrinsics:
    height, width = arrays["color"].shape[:2]
    stream = str(arrays.get("stream", Stream.COLOR))
    if stream not in {*Stream}:
        raise IntrinsicsError(
            "'stream' is neither 'color' nor 'depth'",
            source=path,
            remedy="save the colour camera's matrix in pixels",
        )
    with as_errors_of(path):
        return Intrinsics.from_matrix(arrays["matrix"], width, height, Stream(stream))
