"""Picture files: finding them, their size from the header, and putting them elsewhere."""

from __future__ import annotations

import os
import shutil
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from cucumbervision.capture.files import COLOR_SUFFIXES, read_bytes, read_color
from cucumbervision.errors import DataSetError

if TYPE_CHECKING:
    from collections.abc import Iterable

__all__ = ["flat_names", "list_pictures", "picture_size", "place_file", "write_text"]

_SOF = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def list_pictures(folder: Path) -> list[Path]:
    """Give all pictures in a folder and below it, in order."""
    return sorted(p for p in folder.rglob("*") if p.suffix.lower() in COLOR_SUFFIXES)


def picture_size(path: Path) -> tuple[int, int]:
    """Read a picture's width and height, from the header alone where it is PNG or JPEG.

    Raises
    ------
    CaptureError
        If the file is missing or no picture.

    Notes
    -----
    PNG: ISO/IEC 15948, 11.2.2. JPEG: ITU-T T.81, B.2.2. An EXIF orientation is not applied.
    """
    data = read_bytes(path)
    if data.startswith(b"\x89PNG\r\n\x1a\n") and len(data) >= 24:
        return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    found = _jpeg_size(data) if data.startswith(b"\xff\xd8") else None
    if found is None:
        height, width = read_color(path).shape[:2]
        return width, height
    return found


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    at = 2
    while at + 9 < len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker in _SOF:
            height, width = data[at + 5 : at + 7], data[at + 7 : at + 9]
            return int.from_bytes(width, "big"), int.from_bytes(height, "big")
        # A fill byte may stand before a marker.
        at += 1 if marker == 0xFF else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None


def flat_names(files: Iterable[str]) -> dict[str, str]:
    """Give every file a name without folders, none of them twice, also without their endings.

    Examples
    --------
    >>> flat_names(["images/a.jpg", "train/a.png", "images/b.jpg"])
    {'images/a.jpg': 'a.jpg', 'train/a.png': 'train_a.png', 'images/b.jpg': 'b.jpg'}
    """
    taken: set[str] = set()
    names: dict[str, str] = {}
    for file in files:
        path = PurePosixPath(file)
        name = path.name
        if path.stem.lower() in taken:
            name = "_".join(part for part in path.parts if part != "images")
        number = 2
        while PurePosixPath(name).stem.lower() in taken:
            name, number = f"{path.stem}_{number}{path.suffix}", number + 1
        taken.add(PurePosixPath(name).stem.lower())
        names[file] = name
    return names


def place_file(source: Path, target: Path, *, link: bool) -> None:
    """Put a file elsewhere: as a second name of the same file where the disk can, else copied.

    Raises
    ------
    DataSetError
        If the source is missing or the target cannot be written.
    """
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.resolve() == source.resolve() or (link and _same(source, target)):
            return
        target.unlink(missing_ok=True)
        if link:
            try:
                os.link(source, target)
            except FileNotFoundError:
                raise
            except OSError:  # another disk, or a file system without links
                shutil.copyfile(source, target)
        else:
            shutil.copyfile(source, target)
    except FileNotFoundError:
        raise DataSetError(
            "the file is missing", source=source, remedy="copy the data set again"
        ) from None
    except OSError as error:
        raise DataSetError(
            f"cannot be written ({error.strerror})", source=target, remedy="choose another folder"
        ) from None


def _same(source: Path, target: Path) -> bool:
    return target.exists() and target.samefile(source)


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all: under another name first, then renamed.

    Raises
    ------
    DataSetError
        If it cannot be written.
    """
    part = path.with_name(f"{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except OSError as error:
        raise DataSetError(
            f"cannot be written ({error.strerror})", source=path, remedy="choose another folder"
        ) from None
