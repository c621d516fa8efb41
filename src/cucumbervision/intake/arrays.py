"""NumPy files from strangers: heads first, never Python objects, no larger than a picture."""

from __future__ import annotations

import math
import tokenize
import zipfile
from typing import IO, TYPE_CHECKING

from numpy.lib import format as npy

from cucumbervision.errors import DepthError, UploadError
from cucumbervision.intake.archives import ZIP_FAULTS, check_directory

if TYPE_CHECKING:
    from pathlib import Path

    from cucumbervision.intake.limits import Limits

__all__ = ["check_npy", "check_npz"]

_KINDS = frozenset("biufUS")
_ITEM_BYTES = 8
_ARRAYS = 16
_HEAD_FAULTS = (
    *(ValueError, TypeError, KeyError, SyntaxError, EOFError, OverflowError, RecursionError),
    *(MemoryError, AttributeError, IndexError, tokenize.TokenError),
)


def check_npy(path: Path, limits: Limits, *, source: str) -> None:
    """Refuse an `.npy` that holds objects, is too large, or is cut short; its data is not read.

    Raises
    ------
    DepthError
        If it holds Python objects, or is damaged.
    UploadError
        If it has more elements than a picture may have.
    """
    with path.open("rb") as stream:
        _check_array(stream, path.stat().st_size, limits, source)


def check_npz(path: Path, limits: Limits, *, source: str) -> frozenset[str]:
    """Refuse an `.npz` for the same reasons; its members are unpacked once, to nowhere.

    Returns
    -------
    frozenset of str
        The names of its arrays.

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
            for member in members:
                if not member.filename.endswith(".npy") or "/" in member.filename:
                    raise UploadError(
                        "holds something that is no array",
                        source=source,
                        remedy="save it with numpy.savez",
                    )
                with archive.open(member) as stream:
                    _check_array(stream, member.file_size, limits, source)
                    while stream.read(1 << 20):  # to its end, where its checksum is compared
                        pass
    except ZIP_FAULTS:
        raise _damaged(source) from None
    if len(members) > _ARRAYS:
        raise _too_many(source)
    return frozenset(member.filename.removesuffix(".npy") for member in members)


def _check_array(stream: IO[bytes], size: int, limits: Limits, source: str) -> None:
    try:
        version = npy.read_magic(stream)
        read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}[version]
        shape, _, dtype = read(stream, max_header_size=4000)
        elements = math.prod(int(n) for n in shape)
        right = all(n >= 0 for n in shape) and dtype.fields is None and dtype.subdtype is None
    except _HEAD_FAULTS:
        raise _damaged(source) from None
    if dtype.hasobject:
        raise DepthError(
            "holds Python objects (pickle), which are never loaded",
            source=source,
            remedy="save the array as uint16 or float32 with numpy.save",
        )
    # A colour picture has three numbers a pixel.
    if elements > 3 * limits.pixels or math.prod(shape[:2]) > limits.pixels:
        raise UploadError(
            f"an array has {elements:,} elements, more than a picture of "
            f"{limits.pixels / 1e6:g} million pixels",
            source=source,
            remedy="send a smaller picture",
        )
    text_or_number = dtype.kind in _KINDS and (
        dtype.itemsize <= _ITEM_BYTES or (dtype.kind in "US" and elements * dtype.itemsize < 10_000)
    )
    if not right or not text_or_number or size - stream.tell() != elements * dtype.itemsize:
        raise _damaged(source)


def _damaged(source: str) -> DepthError:
    return DepthError(
        "is truncated or no NumPy file of numbers",
        source=source,
        remedy="save the array as uint16 or float32 with numpy.save",
    )


def _too_many(source: str) -> UploadError:
    return UploadError(
        f"holds more than {_ARRAYS} arrays", source=source, remedy="send one capture in it"
    )
