"""A picture's size from its head, before anything decodes it."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, BinaryIO

from cucumbervision.errors import UploadError
from cucumbervision.intake.sniff import Kind

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

__all__ = ["check_picture", "picture_size"]

_SIDE = 65_500  # what JPEG can say; nothing that is a picture of fruit is wider
_JPEG_ALONE = frozenset({0x01, *range(0xD0, 0xD9)})  # markers without a length
_JPEG_SIZES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_SEGMENTS = 10_000
_TIFF_SIDES = {256: "width", 257: "height", 322: "tile width", 323: "tile height"}
_TIFF_BITS, _TIFF_SAMPLES, _TIFF_TYPES = 258, 277, {1: "B", 3: "H", 4: "I"}


def check_picture(path: Path, kind: Kind, most_pixels: int, *, source: str) -> tuple[int, int]:
    """Refuse a picture that is too large, or whose head is broken, without decoding it.

    Parameters
    ----------
    path : Path
        The file.
    kind : Kind
        One of `sniff.PICTURES`.
    most_pixels : int
        Width times height at most.
    source : str
        The picture's name, for errors.

    Returns
    -------
    (int, int)
        Width and height.

    Raises
    ------
    UploadError
        If it is too large, or says no size.
    """
    try:
        with path.open("rb") as stream:
            width, height = picture_size(stream, kind)
    except (struct.error, ValueError, IndexError, OverflowError):
        raise UploadError(
            "is damaged: its head tells no size", source=source, remedy="copy or export it again"
        ) from None
    if width * height > most_pixels:
        raise UploadError(
            f"has {width}x{height} pixels, more than {most_pixels / 1e6:g} million",
            source=source,
            remedy="send a smaller picture",
        )
    return width, height


def picture_size(stream: BinaryIO, kind: Kind) -> tuple[int, int]:
    r"""Read width and height from the head of a PNG, JPEG, TIFF or WebP.

    Raises
    ------
    ValueError
        If it says none, or one that cannot be; `struct.error` where it ends too early.

    Notes
    -----
    PNG: ISO/IEC 15948, 11.2.2. JPEG: ITU-T T.81, B.2.2. TIFF 6.0, section 2; only the first
    picture is ever decoded, whose tiles must be within the limits too. WebP: RFC 9649, 2.

    Examples
    --------
    >>> import io
    >>> head = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 640, 480) + bytes((8, 2))
    >>> picture_size(io.BytesIO(head), Kind.PNG)
    (640, 480)
    """
    readers: dict[Kind, Callable[[BinaryIO], tuple[int, int]]] = {
        Kind.PNG: _png,
        Kind.JPEG: _jpeg,
        Kind.TIFF: _tiff,
        Kind.WEBP: _webp,
    }
    width, height = readers[kind](stream)
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
    for _ in range(_SEGMENTS):
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
    sides = dict.fromkeys(_TIFF_SIDES, 1)
    for _ in range(min(count, 200)):
        tag, kind, values, data = struct.unpack(f"{order}HHI4s", stream.read(12))
        if tag not in {*_TIFF_SIDES, _TIFF_BITS, _TIFF_SAMPLES} or values != 1:
            continue
        form = _TIFF_TYPES.get(kind, "?")
        value = struct.unpack_from(f"{order}{form}", data)[0]
        if tag in sides:
            sides[tag] = int(value)
        elif value > (64 if tag == _TIFF_BITS else 4):
            raise ValueError("more bits or channels than a picture has")
    width, height, tile_width, tile_height = sides.values()
    if max(tile_width, tile_height) > max(4096, 2 * max(width, height)):
        raise ValueError("tiles larger than the picture")
    return width, height


def _webp(stream: BinaryIO) -> tuple[int, int]:
    head = stream.read(30)
    if head[12:16] == b"VP8X":
        return (
            1 + int.from_bytes(head[24:27], "little"),
            1 + int.from_bytes(head[27:30], "little"),
        )
    if head[12:16] == b"VP8L":
        (bits,) = struct.unpack("<I", head[21:25])
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if head[12:16] == b"VP8 ":
        width, height = struct.unpack("<HH", head[26:30])
        return width & 0x3FFF, height & 0x3FFF
    raise ValueError("no picture in it")
