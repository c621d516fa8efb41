"""What a received file is, by its content, and whether it is accepted."""

from __future__ import annotations

import json
import math
import struct
import tokenize
import zipfile
from dataclasses import dataclass
from enum import StrEnum
from typing import IO, TYPE_CHECKING, Any, BinaryIO

from numpy.lib import format as npy

from cucumbervision.errors import DepthError, UploadError
from cucumbervision.intake.archives import ZIP_FAULTS, check_directory

if TYPE_CHECKING:
    from pathlib import Path, PurePosixPath
    from typing import NoReturn

    from cucumbervision.intake.limits import Limits

HEAD_BYTES = 512
_TEXT_CONTROLS = frozenset(range(32)) - {9, 10, 12, 13}
_SIDE = 65_500  # JPEG's largest; nothing that is a picture of fruit is wider
# What reading a damaged head may raise.
_HEAD_FAULTS = (
    *(ValueError, TypeError, KeyError, SyntaxError, EOFError, OverflowError, RecursionError),
    *(MemoryError, AttributeError, IndexError, tokenize.TokenError, struct.error),
)
_JPEG_ALONE = frozenset({0x01, *range(0xD0, 0xD9)})  # markers without a length
_JPEG_SIZES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_SEGMENTS = 10_000
_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_BITS, _TIFF_SAMPLES = 256, 257, 258, 277
_TIFF_TILE_WIDTH, _TIFF_TILE_HEIGHT = 322, 323
_TIFF_TYPES = {1: "B", 3: "H", 4: "I"}
_ARRAY_KINDS = frozenset("biufUS")
_ITEM_BYTES = 8
_ARRAYS = 16


class FileKind(StrEnum):
    """A file's kind; the value is the ending that it is kept under."""

    PNG = ".png"
    JPEG = ".jpg"
    TIFF = ".tif"
    WEBP = ".webp"
    NPY = ".npy"
    NPZ = ".npz"
    ZIP = ".zip"
    BAG = ".bag"
    DB3 = ".db3"
    JSON = ".json"
    CSV = ".csv"
    RAW = ".raw"


COLORS = frozenset({FileKind.PNG, FileKind.JPEG, FileKind.TIFF})
DEPTHS = frozenset({FileKind.PNG, FileKind.TIFF, FileKind.NPY, FileKind.NPZ})
PICTURES = COLORS | {FileKind.WEBP}

_MAGIC = (
    (b"\x89PNG\r\n\x1a\n", FileKind.PNG),
    (b"\xff\xd8\xff", FileKind.JPEG),
    (b"II*\x00", FileKind.TIFF),
    (b"MM\x00*", FileKind.TIFF),
    (b"\x93NUMPY", FileKind.NPY),
    (b"PK\x03\x04", FileKind.ZIP),
    (b"PK\x05\x06", FileKind.ZIP),
    (b"#ROSBAG V2.0\n", FileKind.BAG),
    (b"SQLite format 3\x00", FileKind.DB3),
)


@dataclass(frozen=True, eq=False)
class Item:
    """A received file that passed its checks.

    Parameters
    ----------
    name : PurePosixPath
        The sender's name, inside its zip or batch; never used on the disk.
    title : str
        The same, fit to be shown.
    path : Path
        Where it lies, under a name of our own.
    kind : FileKind
        What it is.
    pixels : int
        Of a picture: width times height.
    arrays : frozenset of str
        Of an `.npz`: its arrays.
    document : object
        Of a JSON file: what it holds.
    """

    name: PurePosixPath
    title: str
    path: Path
    kind: FileKind
    pixels: int = 0
    arrays: frozenset[str] = frozenset()
    document: Any = None


def file_kind(head: bytes, name: str = "") -> FileKind | None:
    """Return a file's kind by its first `HEAD_BYTES` bytes; None for what is not accepted.

    The name decides only where bytes cannot: an `.npz` is a zip, a text is JSON or a table, and
    the 16-bit numbers of RealSense Viewer's `*_Depth.raw` have no head at all.

    Parameters
    ----------
    head : bytes
        The file's beginning.
    name : str
        The sender's name for it.

    Examples
    --------
    >>> file_kind(b"PK" + bytes((3, 4)) + b"rest of it", "depth.png")
    <FileKind.ZIP: '.zip'>
    >>> file_kind(b"MZ" + bytes(100), "depth.png") is None
    True
    """
    lower = name.lower()
    for magic, kind in _MAGIC:
        if head.startswith(magic):
            return FileKind.NPZ if kind is FileKind.ZIP and lower.endswith(".npz") else kind
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return FileKind.WEBP
    if lower.endswith("_depth.raw"):
        return FileKind.RAW
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if not text or not _TEXT_CONTROLS.isdisjoint(text):
        return None
    if text[:1] in (b"{", b"["):
        return FileKind.JSON
    return FileKind.CSV if lower.endswith(".csv") else None


def check_item(name: PurePosixPath, title: str, path: Path, limits: Limits) -> Item:
    """Return a file with its kind and what is known of it.

    Raises
    ------
    UploadError
        If it is of no known kind, too large, or damaged.
    DepthError
        If it is an array file that holds objects or is damaged.
    """
    size = path.stat().st_size
    with path.open("rb") as stream:
        kind = file_kind(stream.read(HEAD_BYTES), name.name)
    if kind is None:
        raise UploadError(
            "is of no kind that is accepted" if size else "the file is empty",
            source=title,
            remedy="send PNG, JPEG or TIFF pictures, .npy or .npz, .bag or .db3, JSON, or a zip of "
            "them",
        )
    if kind is FileKind.WEBP:
        raise UploadError(
            "WebP pictures are not measured", source=title, remedy="save it as PNG or JPEG"
        )
    if kind in PICTURES:
        width, height = check_picture(path, kind, limits.pixels, source=title)
        return Item(name, title, path, kind, pixels=width * height)
    if kind is FileKind.NPY:
        with path.open("rb") as stream:
            _check_array(stream, size, limits, title)
    elif kind is FileKind.NPZ:
        return Item(name, title, path, kind, arrays=_check_npz(path, limits, source=title))
    elif kind in {FileKind.JSON, FileKind.CSV}:
        return Item(name, title, path, kind, document=_text(path, kind, size, limits, title))
    elif kind is FileKind.RAW and size > 2 * limits.pixels:
        raise UploadError(
            f"has more than {limits.pixels / 1e6:g} million pixels",
            source=title,
            remedy="send a smaller picture",
        )
    return Item(name, title, path, kind)


def check_picture(path: Path, kind: FileKind, most_pixels: int, *, source: str) -> tuple[int, int]:
    """Return a picture's width and height from its head, without decoding it.

    Parameters
    ----------
    path : Path
        The file.
    kind : FileKind
        One of `COLORS`.
    most_pixels : int
        Width times height at most.
    source : str
        The picture's name, for errors.

    Raises
    ------
    UploadError
        If it is too large, or its head is damaged.
    """
    try:
        with path.open("rb") as stream:
            width, height = picture_size(stream, kind)
    except _HEAD_FAULTS:
        raise UploadError(
            "is damaged: its head holds no size", source=source, remedy="copy or export it again"
        ) from None
    if width * height > most_pixels:
        raise UploadError(
            f"has {width}x{height} pixels, more than {most_pixels / 1e6:g} million",
            source=source,
            remedy="send a smaller picture",
        )
    return width, height


def picture_size(stream: BinaryIO, kind: FileKind) -> tuple[int, int]:
    r"""Return width and height from the head of a PNG, JPEG or TIFF.

    Raises
    ------
    ValueError
        If it holds none, or one that cannot be; `struct.error` where it ends too early.

    Notes
    -----
    PNG: ISO/IEC 15948, 11.2.2. JPEG: ITU-T T.81, B.2.2. TIFF 6.0, section 2; only the first
    picture is ever decoded, whose tiles must be within the limits too.

    Examples
    --------
    >>> import io
    >>> head = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 640, 480) + bytes((8, 2))
    >>> picture_size(io.BytesIO(head), FileKind.PNG)
    (640, 480)
    """
    width, height = {FileKind.PNG: _png, FileKind.JPEG: _jpeg, FileKind.TIFF: _tiff}[kind](stream)
    if not (0 < width <= _SIDE and 0 < height <= _SIDE):
        raise ValueError(f"a picture of {width}x{height}")
    return width, height


def _png(stream: BinaryIO) -> tuple[int, int]:
    _, name, width, height, bits, color = struct.unpack(">I4sIIBB", stream.read(26)[8:])
    if name != b"IHDR" or bits not in {1, 2, 4, 8, 16} or color not in {0, 2, 3, 4, 6}:
        raise ValueError("no IHDR")
    return width, height


def _jpeg(stream: BinaryIO) -> tuple[int, int]:
    stream.seek(2)
    for _ in range(_JPEG_SEGMENTS):
        mark, code = stream.read(2)
        while code == 0xFF:  # filling
            code = stream.read(1)[0]
        if mark != 0xFF or code in {0xD9, 0xDA}:
            raise ValueError("no size before the pixels")
        if code in _JPEG_ALONE:
            continue
        (length,) = struct.unpack(">H", stream.read(2))
        if code in _JPEG_SIZES:
            _, height, width = struct.unpack(">BHH", stream.read(5))
            return width, height
        stream.seek(length - 2, 1)
    raise ValueError("too many segments")


def _tiff(stream: BinaryIO) -> tuple[int, int]:
    head = stream.read(8)
    order = "<" if head[:2] == b"II" else ">"
    stream.seek(struct.unpack(f"{order}I", head[4:])[0])
    (count,) = struct.unpack(f"{order}H", stream.read(2))
    tags: dict[int, int] = {}
    for _ in range(min(count, 200)):
        tag, kind, values, data = struct.unpack(f"{order}HHI4s", stream.read(12))
        if kind in _TIFF_TYPES and values == 1:
            tags[tag] = struct.unpack_from(f"{order}{_TIFF_TYPES[kind]}", data)[0]
    width, height = tags[_TIFF_WIDTH], tags[_TIFF_HEIGHT]
    if tags.get(_TIFF_BITS, 1) > 64 or tags.get(_TIFF_SAMPLES, 1) > 4:
        raise ValueError("more bits or channels than a picture has")
    # A decoder makes room for whole tiles.
    tile = max(tags.get(_TIFF_TILE_WIDTH, 1), tags.get(_TIFF_TILE_HEIGHT, 1))
    if tile > max(4096, 2 * max(width, height)):
        raise ValueError("tiles larger than the picture")
    return width, height


def _check_npz(path: Path, limits: Limits, *, source: str) -> frozenset[str]:
    """Return the names of an `.npz` file's arrays; its members are unpacked once, to nowhere.

    Raises
    ------
    DepthError
        If it holds Python objects, or is damaged.
    UploadError
        If it holds anything but arrays, too many or too large ones.
    """
    check_directory(path, _ARRAYS, source)
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            if len(members) > _ARRAYS:
                raise UploadError(
                    f"holds more than {_ARRAYS} arrays",
                    source=source,
                    remedy="send one capture in it",
                )
            for member in members:
                if not member.filename.endswith(".npy") or "/" in member.filename:
                    raise UploadError(
                        "holds something other than arrays",
                        source=source,
                        remedy="save it with numpy.savez",
                    )
                with archive.open(member) as stream:
                    _check_array(stream, member.file_size, limits, source)
                    while stream.read(1 << 20):  # to its end, where its checksum is compared
                        pass
    except ZIP_FAULTS:
        raise _damaged_array(source) from None
    return frozenset(member.filename.removesuffix(".npy") for member in members)


def _check_array(stream: IO[bytes], size: int, limits: Limits, source: str) -> None:
    try:
        version = npy.read_magic(stream)
        read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}[version]
        shape, _, dtype = read(stream, max_header_size=4000)
        elements = math.prod(int(n) for n in shape)
        right = all(n >= 0 for n in shape) and dtype.fields is None and dtype.subdtype is None
    except _HEAD_FAULTS:
        raise _damaged_array(source) from None
    if dtype.hasobject:
        raise _damaged_array(source, "holds Python objects (pickle), which are never loaded")
    # A colour picture has three numbers a pixel.
    if elements > 3 * limits.pixels or math.prod(shape[:2]) > limits.pixels:
        raise UploadError(
            f"an array has {elements:,} elements, more than a picture of "
            f"{limits.pixels / 1e6:g} million pixels",
            source=source,
            remedy="send a smaller picture",
        )
    text_or_number = dtype.kind in _ARRAY_KINDS and (
        dtype.itemsize <= _ITEM_BYTES or (dtype.kind in "US" and elements * dtype.itemsize < 10_000)
    )
    if not right or not text_or_number or size - stream.tell() != elements * dtype.itemsize:
        raise _damaged_array(source)


def _damaged_array(
    source: str, message: str = "is truncated or not a NumPy file of numbers"
) -> DepthError:
    remedy = "save the array as uint16 or float32 with numpy.save"
    return DepthError(message, source=source, remedy=remedy)


def _text(path: Path, kind: FileKind, size: int, limits: Limits, title: str) -> Any:
    if size > limits.text_bytes:
        raise UploadError(
            f"has more than {limits.text_bytes / 1e6:g} MB of text",
            source=title,
            remedy="send a smaller file",
        )
    fault, remedy = (
        ("is not JSON", "correct or export it again")
        if kind is FileKind.JSON
        else ("is not text in UTF-8", "save the table as UTF-8")
    )
    try:
        text = path.read_bytes().decode("utf-8-sig")
        return json.loads(text, parse_constant=_refuse) if kind is FileKind.JSON else None
    except (ValueError, RecursionError):
        raise UploadError(fault, source=title, remedy=remedy) from None


def _refuse(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number")
