"""One received file: what it is, and whether it may stay."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from cucumbervision.errors import UploadError
from cucumbervision.intake.arrays import check_npy, check_npz
from cucumbervision.intake.headers import check_picture
from cucumbervision.intake.sniff import HEAD_BYTES, PICTURES, Kind, sniff

if TYPE_CHECKING:
    from pathlib import Path, PurePosixPath
    from typing import NoReturn

    from cucumbervision.intake.limits import Limits

__all__ = ["COLORS", "DEPTHS", "Item", "check_item", "parse_json"]

COLORS = frozenset({Kind.PNG, Kind.JPEG, Kind.TIFF})
DEPTHS = frozenset({Kind.PNG, Kind.TIFF, Kind.NPY, Kind.NPZ})


@dataclass(frozen=True, eq=False)
class Item:
    """A received file that passed its checks.

    Parameters
    ----------
    name : PurePosixPath
        What its sender calls it, inside its zip or batch; never used on the disk.
    title : str
        The same, fit to be shown.
    path : Path
        Where it lies, under a name of our own.
    kind : Kind
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
    kind: Kind
    pixels: int = 0
    arrays: frozenset[str] = frozenset()
    document: Any = None


def check_item(name: PurePosixPath, title: str, path: Path, limits: Limits) -> Item:
    """Find out what a file is, and refuse it where it is too large, damaged or unknown.

    Raises
    ------
    UploadError
        Of no known kind, too large, or damaged.
    DepthError
        For an array file that holds objects or is damaged.
    """
    size = path.stat().st_size
    with path.open("rb") as stream:
        kind = sniff(stream.read(HEAD_BYTES), name.name)
    if kind is None:
        raise UploadError(
            "the file is empty" if not size else "is of no kind that is taken",
            source=title,
            remedy="send PNG, JPEG or TIFF pictures, .npy or .npz, .bag or .db3, JSON, or a zip of "
            "them",
        )
    if kind is Kind.WEBP:
        check_picture(path, kind, limits.pixels, source=title)
        raise UploadError(
            "WebP pictures are not measured", source=title, remedy="save it as PNG or JPEG"
        )
    if kind in PICTURES:
        width, height = check_picture(path, kind, limits.pixels, source=title)
        return Item(name, title, path, kind, pixels=width * height)
    if kind is Kind.NPY:
        check_npy(path, limits, source=title)
    elif kind is Kind.NPZ:
        return Item(name, title, path, kind, arrays=check_npz(path, limits, source=title))
    elif kind in {Kind.JSON, Kind.CSV}:
        return Item(name, title, path, kind, document=_text(path, kind, size, limits, title))
    elif kind is Kind.RAW and size > 2 * limits.pixels:
        raise UploadError(
            f"has more than {limits.pixels / 1e6:g} million pixels",
            source=title,
            remedy="send a smaller picture",
        )
    return Item(name, title, path, kind)


def _text(path: Path, kind: Kind, size: int, limits: Limits, title: str) -> Any:
    if size > limits.text_bytes:
        raise UploadError(
            f"has more than {limits.text_bytes / 1e6:g} MB of text",
            source=title,
            remedy="send a smaller file",
        )
    data = path.read_bytes()
    if kind is Kind.JSON:
        return parse_json(data, source=title)
    try:
        data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise UploadError(
            "is no text in UTF-8", source=title, remedy="save the table as UTF-8"
        ) from None
    return None


def parse_json(data: bytes, *, source: str) -> Any:
    """Read JSON from a stranger: strictly, and without numbers that are none.

    Raises
    ------
    UploadError
        If it is none, is nested too deeply, or holds NaN or Infinity.

    Examples
    --------
    >>> parse_json(b'{"stop": {"row": NaN}}', source="capture.json")
    Traceback (most recent call last):
    ...
    cucumbervision.errors.UploadError: capture.json: is no JSON; correct or export it again
    """
    try:
        return json.loads(data.decode("utf-8-sig"), parse_constant=_refuse)
    except (ValueError, RecursionError):
        raise UploadError(
            "is no JSON", source=source, remedy="correct or export it again"
        ) from None


def _refuse(name: str) -> NoReturn:
    raise ValueError(f"{name} is no number")
