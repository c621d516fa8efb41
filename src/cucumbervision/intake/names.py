"""Strangers' names: kept as text to show, never as paths."""

from __future__ import annotations

import unicodedata
from pathlib import PurePosixPath

from cucumbervision.errors import UploadError

__all__ = ["clean_name", "is_clutter", "member_path"]

_LONGEST = 120
_CLUTTER = frozenset({".ds_store", "thumbs.db", "desktop.ini"})


def clean_name(text: str) -> str:
    """Make a stranger's name fit to be shown: its last part, printable, not too long.

    Examples
    --------
    >>> clean_name("../../etc/pass" + chr(0) + "wd" + chr(0x202E) + ".png")
    'passwd.png'
    >>> clean_name("a" * 200)[-3:], len(clean_name("a" * 200))
    ('aa…', 120)
    """
    last = text.replace("\\", "/").rstrip("/").rsplit("/", 1)[-1]
    plain = unicodedata.normalize("NFC", last.encode("utf-8", "replace").decode())
    # Controls, marks that turn the direction of writing, and what is assigned to nothing.
    kept = "".join(c for c in plain if not unicodedata.category(c).startswith(("C", "Zl", "Zp")))
    kept = " ".join(kept.split())
    return f"{kept[: _LONGEST - 1]}…" if len(kept) > _LONGEST else kept or "unnamed"


def member_path(name: str, archive: str) -> PurePosixPath:
    """Read the name of a zip's member as a path inside the zip.

    Raises
    ------
    UploadError
        If it leads out of the zip, or is no name.

    Examples
    --------
    >>> member_path("row 3/rgb/1.png", "a.zip").parts
    ('row 3', 'rgb', '1.png')
    >>> member_path("../.bashrc", "a.zip")
    Traceback (most recent call last):
    ...
    cucumbervision.errors.UploadError: a.zip: a member's name leads out of the zip ('.bashrc');
    pack the captures' folder anew
    """
    plain = name.replace("\\", "/")
    parts = plain.split("/")
    drive = len(parts[0]) > 1 and parts[0][1] == ":"
    if plain.startswith("/") or drive or ".." in parts or "\0" in plain or not plain.strip("/ ."):
        raise UploadError(
            f"a member's name leads out of the zip ({clean_name(name)!r})",
            source=archive,
            remedy="pack the captures' folder anew",
        )
    return PurePosixPath(plain)


def is_clutter(path: PurePosixPath) -> bool:
    """Say whether a file is what systems leave behind everywhere.

    Examples
    --------
    >>> is_clutter(PurePosixPath("__MACOSX/a/._1.png")), is_clutter(PurePosixPath("a/1.png"))
    (True, False)
    """
    name = path.name.lower()
    return name in _CLUTTER or name.startswith("._") or "__MACOSX" in path.parts
