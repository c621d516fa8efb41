"""Read colour and depth images with matching names."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from unicodedata import normalize

from cucumbervision.capture import source as sources
from cucumbervision.capture.camera_file import CameraFile, read_camera_file
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.pictures import COLOR_SUFFIXES, DEPTH_SUFFIXES, read_color, read_depth
from cucumbervision.capture.readers.common import CameraFinder, frame_capture, no_intrinsics
from cucumbervision.errors import CaptureError, IntrinsicsError
from cucumbervision.files import read_head

_COLOR_WORD = re.compile(r"colou?r|rgb", re.IGNORECASE)
_DEPTH_WORD = re.compile(r"depth", re.IGNORECASE)
# Lists of a TUM sequence: its depth has steps of 1/5000 m or others; no file states which.
_TUM_LIST = re.compile(r"assoc(iat(e|ed|ions))?\.txt|rgb\.txt", re.IGNORECASE)


@dataclass(frozen=True)
class Pair:
    """Files of one frame; None for a missing file.

    Parameters
    ----------
    color, depth : Path, optional
        The images.
    camera : Path, optional
        Nearest intrinsics file, in the folder of the colour image or above.
    fault : CaptureError, optional
        Why no intrinsics file can be chosen.
    """

    color: Path | None
    depth: Path | None
    camera: Path | None = None
    fault: CaptureError | None = None

    def load(
        self, frame: int, camera: CameraFile | CaptureError, options: sources.ReadOptions, name: str
    ) -> Capture:
        """Read the frame."""
        if self.color is None or self.depth is None:
            fault = "has no depth picture of a matching name"
            fault = fault if self.color else "has no colour picture of a matching name"
            source = self.color or self.depth
            raise CaptureError(fault, source=source, remedy="put it beside this one")
        if isinstance(camera, CaptureError):
            raise camera
        return frame_capture(
            read_color(self.color),
            partial(read_depth, self.depth),
            None,
            camera,
            options,
            source=self.color,
            depth_source=self.depth,
            name=name,
            frame=frame,
            provenance={"reader": "pair", "depth": str(self.depth), "intrinsics": str(camera.path)},
        )


def find_pairs(folder: sources.Folder) -> sources.CaptureLister | None:
    """Find the frames of `match_pairs`, and mark their files as used."""
    pairs = match_pairs(folder)
    taken = {file for pair in pairs for file in (pair.color, pair.depth)}
    for folder_path, names in folder.files.items():
        names[:] = [name for name in names if folder.path / folder_path / name not in taken]
    return partial(_open_pairs, folder.path, pairs) if pairs else None


def tum_lists(folder: sources.Folder) -> dict[str, str]:
    """Return the lists of TUM sequences by folder; images below them are no pairs."""
    return {
        folder_path: name
        for folder_path, names in folder.files.items()
        for name in names
        if _TUM_LIST.fullmatch(name)
    }


def match_pairs(folder: sources.Folder) -> list[Pair]:
    """Pair the images of a folder by name.

    Names match if they are equal except for the words 'color', 'colour', 'rgb' and 'depth':
    `rgb_7.png` and `depth_7.png`, `color/7.jpg` and `depth/7.npy`, `7_color_depth.npy` and
    `7_color.png`, or plain `7.png` and `7_depth.npy`. An unmatched image becomes a pair with a
    missing part, so that it is reported; unmatched 8-bit 'depth' images are ignored. Without any
    complete pair, the result is empty.
    """
    colors, depths = _by_role(folder)
    pairs, cameras = [], CameraFinder(folder)
    for key in sorted(colors.keys() | depths.keys()) if colors.keys() & depths.keys() else ():
        files = [
            None if name is None else folder.path / name
            for name in (colors.get(key), depths.get(key))
        ]
        if files[0] is None and _is_8_bit_png(folder.path / depths[key]):
            continue
        folder_path, _, picture = colors.get(key, depths.get(key, "")).rpartition("/")
        try:
            pairs.append(Pair(files[0], files[1], cameras.find(folder_path, picture)))
        except IntrinsicsError as error:
            pairs.append(Pair(files[0], files[1], fault=error))
    return pairs


def _by_role(folder: sources.Folder) -> tuple[dict[str, str], dict[str, str]]:
    """Return the colour and the depth images by the key of their pair.

    An 8-bit depth image is replaced by any other one with the same key. An image without a role
    in its name is the colour of the depth image with the same key.
    """
    colors: dict[str, str] = {}
    depths: dict[str, str] = {}
    plain: dict[str, str] = {}
    sequences = tuple(f"{place}/".lstrip("/") for place in tum_lists(folder))
    for name in sorted(name for name in folder if not name.startswith(sequences)):
        role, key = _pair_role(name)
        if role == "depth" and (key not in depths or _is_8_bit_png(folder.path / depths[key])):
            depths[key] = name
        elif role == "color":
            colors.setdefault(key, name)
        elif role == "image":
            plain.setdefault(key, name)
    return {key: name for key, name in plain.items() if key in depths} | colors, depths


def _pair_role(name: str) -> tuple[str, str]:
    """Return the role of a file by its name, and the key of its pair.

    The role is 'depth', 'color', 'image' if no name has one, or '' for other files. The file's
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
    role = next((role for part in reversed(parts) if (role := _role_of(part))), "image")
    if role == "depth" and suffix not in DEPTH_SUFFIXES:
        role = "" if suffix not in COLOR_SUFFIXES else "image"
    if role in ("color", "image") and suffix not in COLOR_SUFFIXES:
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
    """Return the replacement of a removed word: the separator before it, if it was between two."""
    before, after = match.groups()
    if before and after:
        return str(before) if match.start() and match.end() < len(match.string) else ""
    outer = (before and match.end() == len(match.string)) or (after and not match.start())
    return "" if outer else str(before or after)


def is_half_a_pair(name: str) -> bool:
    """Return whether a file is a colour or a depth image by its name."""
    return _pair_role(name)[0] in ("color", "depth")


def _is_8_bit_png(path: Path) -> bool:
    """Return whether a file is an 8-bit PNG, which is a visualisation of depth."""
    try:
        head = read_head(path, 25)
    except CaptureError:  # reported when the file is read
        return False
    return head.startswith(b"\x89PNG") and head[-1] == 8


def _open_pairs(
    path: Path, pairs: Sequence[Pair], options: sources.ReadOptions, camera_file: CameraFile | None
) -> Iterator[sources.CaptureEntry]:
    cameras: dict[Path | None, CameraFile | CaptureError] = {None: no_intrinsics(path)}
    for file in {pair.camera for pair in pairs if pair.camera and not camera_file}:
        try:
            cameras[file] = read_camera_file(file)
        except CaptureError as error:
            cameras[file] = error
    chosen = [camera_file or pair.fault or cameras[pair.camera] for pair in pairs]
    if not any(isinstance(camera, CameraFile) for camera in chosen):
        raise next(camera for camera in chosen if isinstance(camera, CaptureError))
    for frame, (pair, camera) in enumerate(zip(pairs, chosen, strict=True)):
        picture = pair.color or pair.depth or path
        load = partial(pair.load, frame, camera, options)
        files = [pair.color, pair.depth, getattr(camera, "path", None)]
        yield picture.stem, frame, load, picture, partial(list, filter(None, files))


def open_pair_file(path: Path, options: sources.ReadOptions) -> sources.CaptureSource:
    """Open a colour image with `options.depth`.

    Raises
    ------
    CaptureError
        If the file is no image.
    IntrinsicsError
        If the intrinsics are missing or invalid.
    """
    suffix = path.suffix.lower()
    if suffix not in COLOR_SUFFIXES or options.depth is None:
        fault = "a colour picture alone has no distances"
        fault = fault if suffix in COLOR_SUFFIXES else f"'{suffix}' files are not captures"
        remedy = "name a colour picture with its depth picture, or a capture folder"
        raise CaptureError(fault, source=path, remedy=remedy)
    camera_file = read_camera_file(options.intrinsics) if options.intrinsics else None
    pairs = [Pair(path, options.depth)]
    return sources.CaptureSource.listed(
        path, "pair", _open_pairs(path, pairs, options, camera_file)
    )
