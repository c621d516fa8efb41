"""A colour and a depth picture with given intrinsics."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from cucumbervision.capture.files import (
    COLOR_SUFFIXES,
    DEPTH_SUFFIXES,
    read_arrays,
    read_color,
    read_depth,
)
from cucumbervision.capture.intrinsics import Intrinsics, Stream
from cucumbervision.capture.readers.common import frame_capture, given_calibration, no_intrinsics
from cucumbervision.capture.source import CaptureSource, ReadOptions
from cucumbervision.errors import CaptureError, IntrinsicsError, as_errors_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    from cucumbervision.capture.camera_file import CameraFile
    from cucumbervision.capture.frames import Capture

Part = TypeVar("Part")

_COLOR_WORD = re.compile(r"colou?r|rgb", re.IGNORECASE)
_DEPTH_WORD = re.compile(r"depth", re.IGNORECASE)


@dataclass(frozen=True)
class Pair:
    """Files of one frame; a part that is missing is None."""

    color: Path | None
    depth: Path | None


def find_pairs(path: Path) -> list[Pair]:
    """Pair the pictures of a folder, and of the folders in it, by their names.

    Names match when they are equal but for the words 'color', 'colour', 'rgb' and 'depth':
    `rgb_7.png` and `depth_7.png`, `color/7.jpg` and `depth/7.npy`, `7_color_depth.npy` and
    `7_color.png`, or plain `7.png` and `7_depth.npy`. A picture left alone is a
    pair with one part missing, so that it is not lost silently; an 8-bit 'depth' picture left
    alone is only there to be looked at. Without any whole pair there are none.
    """
    files = sorted(f for pattern in ("*", "*/*") for f in path.glob(pattern))
    named = ((file.relative_to(path).as_posix(), file) for file in files)
    colors, depths = pair_up(named, is_8_bit_png)
    if not colors.keys() & depths.keys():
        return []
    alone = {k for k in depths.keys() - colors.keys() if is_8_bit_png(depths[k])}
    return [
        Pair(colors.get(key), depths.get(key))
        for key in sorted((colors.keys() | depths.keys()) - alone)
    ]


def pair_up(
    named: Iterable[tuple[str, Part]], is_8_bit: Callable[[Part], bool]
) -> tuple[dict[str, Part], dict[str, Part]]:
    """Return the colour and the depth pictures among files by name, under the key of their pair.

    A depth picture of 8 bits gives way to any other of its key. A picture whose name says neither
    is the colour of the depth picture that is called so.
    """
    colors: dict[str, Part] = {}
    depths: dict[str, Part] = {}
    plain: dict[str, Part] = {}
    for name, part in named:
        role, key = _pair_role(name)
        if role == "depth" and (key not in depths or is_8_bit(depths[key])):
            depths[key] = part
        elif role == "color":
            colors.setdefault(key, part)
        elif role == "picture":
            plain.setdefault(key, part)
    return {key: part for key, part in plain.items() if key in depths} | colors, depths


def _pair_role(name: str) -> tuple[str, str]:
    """Return which part of a pair a file is by its name, and the key of the pair.

    'depth', 'color', 'picture' for one whose name says neither, or '' for no picture.

    Both parts of a pair have one key.

    Examples
    --------
    >>> _pair_role("color/7.jpg"), _pair_role("depth/7.npy"), _pair_role("notes.txt")[0]
    (('color', '7'), ('depth', '7'), '')
    """
    stem, dot, ending = name.rpartition(".")
    suffix = f"{dot}{ending}".lower()
    if _DEPTH_WORD.search(stem) and suffix in DEPTH_SUFFIXES:
        return "depth", _key(stem)
    if suffix not in COLOR_SUFFIXES:
        return "", ""
    return ("color" if _COLOR_WORD.search(stem) else "picture"), _key(stem)


def _key(name: str) -> str:
    without = _DEPTH_WORD.sub(" ", _COLOR_WORD.sub(" ", name))
    return re.sub(r"[^a-z0-9]+", " ", without.lower()).strip()


def is_8_bit_png(path: Path) -> bool:
    """Return whether a file is a PNG of 8 bits, which is no depth but a picture of it."""
    with path.open("rb") as file:
        head = file.read(25)
    return head.startswith(b"\x89PNG") and head[-1] == 8


def open_pairs(path: Path, pairs: Sequence[Pair], options: ReadOptions) -> CaptureSource:
    """Open a folder of colour and depth pictures with matching names.

    Parameters
    ----------
    path : Path
        The folder; its `intrinsics.json` is taken if `options` names none.
    pairs : sequence of Pair
        From `find_pairs`.
    options : ReadOptions
        Intrinsics and depth unit.

    Raises
    ------
    IntrinsicsError
        If there are no intrinsics, or their file is malformed.
    """
    beside = path / "intrinsics.json"
    if options.intrinsics is None and beside.is_file():
        options = ReadOptions(beside, options.depth, options.depth_unit_m, options.burst)
    given = given_calibration(options)
    if given is None:
        raise no_intrinsics(path)
    parts = (
        (at.stem, i, partial(_load_pair, p, i, given, options), at, partial(_files, p, given))
        for i, p in enumerate(pairs)
        for at in (p.color or p.depth or path,)
    )
    return CaptureSource.listed(path, "pair", parts)


def _files(pair: Pair, given: CameraFile | None) -> list[Path]:
    files = (pair.color, pair.depth, None if given is None else given.path)
    return [file for file in files if file is not None]


def open_pair_file(path: Path, options: ReadOptions) -> CaptureSource:
    """Open one colour picture with `options.depth`, or an `.npz` that holds both.

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
        If a pair comes without intrinsics, or their file is malformed.
    """
    suffix, given = path.suffix.lower(), given_calibration(options)
    load: Callable[[str], Capture]
    if suffix == ".npz" and options.depth is None:
        pair, load = Pair(path, None), partial(_load_npz, path, given, options)
    elif suffix in COLOR_SUFFIXES and options.depth is not None:
        if given is None:
            raise no_intrinsics(path)
        pair = Pair(path, options.depth)
        load = partial(_load_pair, pair, 0, given, options)
    else:
        raise CaptureError(
            "a colour picture alone has no distances"
            if suffix in COLOR_SUFFIXES
            else f"'{suffix}' files are no captures",
            source=path,
            remedy="name a colour picture with its depth picture, or a capture folder",
        )
    files = partial(_files, pair, given)
    return CaptureSource.listed(path, "pair", [(path.stem, 0, load, path, files)])


def _load_pair(
    pair: Pair, frame: int, given: CameraFile, options: ReadOptions, name: str
) -> Capture:
    if pair.color is None or pair.depth is None:
        raise CaptureError(
            f"has no {'colour' if pair.color is None else 'depth'} picture of a matching name",
            source=pair.color or pair.depth,
            remedy="put it beside this one",
        )
    return frame_capture(
        read_color(pair.color),
        partial(read_depth, pair.depth),
        None,
        given,
        options.depth_unit_m,
        source=pair.color,
        depth_source=pair.depth,
        name=name,
        frame=frame,
        provenance={"reader": "pair", "depth": str(pair.depth), "intrinsics": str(given.path)},
    )


def _load_npz(path: Path, given: CameraFile | None, options: ReadOptions, name: str) -> Capture:
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
    own = _npz_intrinsics(arrays, path) if "matrix" in arrays else None
    return frame_capture(
        color,
        lambda: arrays["depth"],
        own,
        given,
        options.depth_unit_m,
        source=path,
        depth_source=path,
        name=name,
        provenance={"reader": "pair"},
    )


def _npz_intrinsics(arrays: dict[str, np.ndarray], path: Path) -> Intrinsics:
    height, width = arrays["color"].shape[:2]
    try:
        stream = Stream(str(arrays.get("stream", Stream.COLOR)))
        with as_errors_of(path):
            return Intrinsics.from_matrix(arrays["matrix"], width, height, stream)
    except (ValueError, TypeError):
        raise IntrinsicsError(
            "'matrix' is no 3x3 camera matrix, or 'stream' is neither 'color' nor 'depth'",
            source=path,
            remedy="save the colour camera's matrix in pixels",
        ) from None
