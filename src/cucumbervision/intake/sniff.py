"""What a file is, by its first bytes: its name is not believed."""

from __future__ import annotations

from enum import StrEnum

__all__ = ["HEAD_BYTES", "PICTURES", "Kind", "sniff"]

HEAD_BYTES = 512

_TEXT_CONTROLS = frozenset(range(32)) - {9, 10, 12, 13}


class Kind(StrEnum):
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


PICTURES = frozenset({Kind.PNG, Kind.JPEG, Kind.TIFF, Kind.WEBP})

_MAGIC = (
    (b"\x89PNG\r\n\x1a\n", Kind.PNG),
    (b"\xff\xd8\xff", Kind.JPEG),
    (b"II*\x00", Kind.TIFF),
    (b"MM\x00*", Kind.TIFF),
    (b"\x93NUMPY", Kind.NPY),
    (b"PK\x03\x04", Kind.ZIP),
    (b"PK\x05\x06", Kind.ZIP),
    (b"#ROSBAG V2.0\n", Kind.BAG),
    (b"SQLite format 3\x00", Kind.DB3),
)


def sniff(head: bytes, name: str = "") -> Kind | None:
    """Tell a file's kind from its first `HEAD_BYTES` bytes.

    The name decides only where bytes cannot: an `.npz` is a zip, a text is JSON or a table, and
    the 16-bit numbers of RealSense Viewer's `*_Depth.raw` have no head at all.

    Parameters
    ----------
    head : bytes
        The file's beginning.
    name : str
        What the sender calls it.

    Returns
    -------
    Kind or None
        None for what is not taken.

    Examples
    --------
    >>> sniff(b"PK" + bytes((3, 4)) + b"rest of it", "depth.png")
    <Kind.ZIP: '.zip'>
    >>> sniff(b"MZ" + bytes(100), "depth.png") is None
    True
    """
    lower = name.lower()
    for magic, kind in _MAGIC:
        if head.startswith(magic):
            return Kind.NPZ if kind is Kind.ZIP and lower.endswith(".npz") else kind
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return Kind.WEBP
    if lower.endswith("_depth.raw"):
        return Kind.RAW
    return _text_kind(head, lower)


def _text_kind(head: bytes, lower: str) -> Kind | None:
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if not text or not _TEXT_CONTROLS.isdisjoint(text):
        return None
    if text[:1] in (b"{", b"["):
        return Kind.JSON
    return Kind.CSV if lower.endswith(".csv") else None
