"""Unpack zip files from untrusted senders within limits, which all uploads share."""

from __future__ import annotations

import re
import stat
import struct
import unicodedata
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import IO, TYPE_CHECKING, BinaryIO

from cucumbervision.capture.source import no_device
from cucumbervision.errors import UploadError, wrap_os_errors

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


_LONGEST_NAME, _DEEPEST_FOLDER = 120, 32
_FORBIDDEN = re.compile(r'[<>:"|?*]')  # in names on Windows; a part after ':' would be hidden
_CLUTTER = frozenset({".ds_store", "thumbs.db", "desktop.ini"})


def clean_name(text: str) -> str:
    """Sanitise a file name from a sender: last path component, valid on Windows, limited length.

    Examples
    --------
    >>> clean_name("../../etc/pass" + chr(0) + "wd" + chr(0x202E) + ".png")
    'passwd.png'
    >>> clean_name("docs/con"), clean_name("row: 3?.png. ")
    ('_con', 'row_ 3_.png')
    >>> clean_name("a" * 200 + ".png")[-7:], len(clean_name("a" * 200))
    ('aa….png', 120)
    """
    last = text.replace("\\", "/").rstrip("/").rsplit("/", 1)[-1]
    plain = unicodedata.normalize("NFC", last.encode("utf-8", "replace").decode())
    # Control characters, bidirectional formatting characters and unassigned code points.
    printable = "".join(
        c for c in plain if not unicodedata.category(c).startswith(("C", "Zl", "Zp"))
    )
    printable = no_device(" ".join(_FORBIDDEN.sub("_", printable).split()).rstrip(". "))
    if len(printable) > _LONGEST_NAME or len(printable.encode()) > 2 * _LONGEST_NAME:
        suffix = PurePosixPath(printable).suffix[-8:]
        start = printable[: _LONGEST_NAME - 1 - len(suffix)].encode()[: 2 * _LONGEST_NAME - 35]
        printable = f"{start.decode(errors='ignore')}…{suffix}"
    return printable if printable.strip(". ") else "unnamed"


def _member_path(name: str, archive: str) -> PurePosixPath:
    """Return the path of a zip member inside the archive.

    Raises
    ------
    UploadError
        If the path leaves the archive, is invalid or is nested too deeply.

    Examples
    --------
    >>> _member_path("row 3/rgb/1.png", "a.zip").parts
    ('row 3', 'rgb', '1.png')
    >>> _member_path("../.bashrc", "a.zip")
    Traceback (most recent call last):
    ...
    cucumbervision.errors.UploadError: a.zip: a member's name leads out of the zip ('.bashrc');
    pack the captures' folder again
    """
    plain = name.replace("\\", "/")
    parts = plain.split("/")
    drive = len(parts[0]) > 1 and parts[0][1] == ":"
    if plain.startswith("/") or drive or ".." in parts or "\0" in plain or not plain.strip("/ ."):
        raise UploadError(
            "a member's name leads out of the zip ({name!r})",
            source=archive,
            remedy="pack the captures' folder again",
            name=clean_name(name),
        )
    if len(parts) > _DEEPEST_FOLDER:
        raise UploadError(
            "nests more than {depth} folders",
            source=archive,
            remedy="pack the captures' folder alone",
            depth=_DEEPEST_FOLDER,
        )
    return PurePosixPath(*(clean_name(part) for part in parts if part not in ("", ".")))


def is_zip(path: Path, name: str) -> bool:
    """Return whether a file is a zip by its first bytes, and not an `.npz` by its name."""
    with path.open("rb") as stream:
        head = stream.read(4)
    return head in (b"PK\x03\x04", b"PK\x05\x06") and not name.lower().endswith(".npz")


def _is_clutter(path: PurePosixPath) -> bool:
    """Return whether a file is metadata of an operating system.

    Examples
    --------
    >>> _is_clutter(PurePosixPath("__MACOSX/a/._1.png")), _is_clutter(PurePosixPath("a/1.png"))
    (True, False)
    """
    name = path.name.lower()
    return name in _CLUTTER or name.startswith("._") or "__MACOSX" in path.parts


# Exceptions that zipfile raises for damaged files.
_ZIP_FAULTS = (
    *(zipfile.BadZipFile, zlib.error, struct.error, OSError, EOFError, ValueError),
    *(NotImplementedError, RuntimeError, KeyError, IndexError, OverflowError, MemoryError),
)
_CHUNK = 1 << 20
_PLAIN = frozenset({zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED})
_END, _END64, _LOCATOR64 = b"PK\x05\x06", b"PK\x06\x06", b"PK\x06\x07"
_ENTRY_BYTES = 600  # maximum size of a directory entry, including name and extra fields


@dataclass
class Budget:
    """Remaining limits of an upload, shared by all of its zips.

    Parameters
    ----------
    members : int
        Remaining number of files.
    unpacked_bytes : int
        Remaining number of bytes.
    """

    members: int
    unpacked_bytes: int

    def take(self, size: int, source: str) -> None:
        """Subtract bytes from the budget.

        Raises
        ------
        UploadError
            If the budget is exceeded.
        """
        self.unpacked_bytes -= size
        if self.unpacked_bytes < 0:
            raise UploadError(
                "unpacks to more than is accepted", source=source, remedy="send it in smaller parts"
            )


def _check_directory(path: Path, most_members: int, source: str) -> None:
    """Reject a zip with a huge directory before it is read into memory.

    Raises
    ------
    UploadError
        If the zip is damaged, or lists too many members.

    Notes
    -----
    Sizes are read from the same records as in `zipfile`: the last end record (APPNOTE 4.3.16), or
    the zip64 record of the locator before it (4.3.14, 4.3.15).
    """
    size = path.stat().st_size
    with path.open("rb") as stream:
        start = max(0, size - 65_557)
        stream.seek(start)
        tail = stream.read()
        end = tail.rfind(_END)
        if end < 0 or len(tail) - end < 22:
            raise _damaged(source)
        (listed,) = struct.unpack_from("<I", tail, end + 12)
        if end >= 20 and tail[end - 20 : end - 16] == _LOCATOR64:
            (offset,) = struct.unpack_from("<Q", tail, end - 12)
            stream.seek(min(offset, size))
            records = (tail[max(0, end - 76) : end - 20], stream.read(56))
            sizes = [
                struct.unpack_from("<Q", x, 40)[0] for x in records if x[:4] == _END64 and x[47:]
            ]
            listed = max([listed if listed < 0xFFFFFFFF else 0, *sizes])
    if listed > most_members * _ENTRY_BYTES:
        raise _too_many(most_members, source)


def unpack(
    path: Path, folder: Path, limits: Limits, budget: Budget, *, source: str
) -> Iterator[tuple[str, Path]]:
    """Unpack a zip file by file.

    Parameters
    ----------
    path : Path
        The zip.
    folder : Path
        Output folder; created.
    limits : Limits
        Limits of file size and compression ratio.
    budget : Budget
        Remaining limits, updated while unpacking, because sizes in the directory may be false.
    source : str
        Name of the zip, for error messages.

    Yields
    ------
    str, Path
        Name and path of each unpacked file, without folders and metadata of operating systems.

    Raises
    ------
    UploadError
        If the zip is damaged or encrypted, a member leaves the folder, is a link or a device, a
        name occurs twice, or a limit is exceeded.
    """
    _check_directory(path, limits.members, source)
    folder.mkdir(parents=True)
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            wanted_members = [
                (m, _member_path(m.orig_filename, source)) for m in members if not m.is_dir()
            ]
            wanted_members = [(m, name) for m, name in wanted_members if not _is_clutter(name)]
            for member, name in wanted_members:
                _check_member(member, name, source, limits)
            budget.members -= len(wanted_members)
            if budget.members < 0:
                raise _too_many(limits.members, source)
            for member, name in wanted_members:
                target = folder / name
                with archive.open(member) as packed, _created(target, source) as unpacked:
                    _copy(packed, unpacked, member, limits, budget, source)
                yield str(name), target
    except FileExistsError:
        raise UploadError(
            "has two members of one name", source=source, remedy="pack the folder again"
        ) from None
    except _ZIP_FAULTS:
        raise _damaged(source) from None


def _created(path: Path, source: str) -> BinaryIO:
    remedy = "pack it with shorter names, in fewer folders"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return path.open("xb")
    except FileExistsError:
        raise
    except OSError as error:
        fault = f"its member {path.name!r} cannot be kept ({error.strerror or error})"
        raise UploadError(fault, source=source, remedy=remedy) from None


def _check_member(
    member: zipfile.ZipInfo, name: PurePosixPath, source: str, limits: Limits
) -> None:
    title = clean_name(name.name)
    kind = stat.S_IFMT(member.external_attr >> 16)
    if kind not in {0, stat.S_IFREG}:
        raise UploadError(
            "its member {name!r} is a link or a device",
            source=source,
            remedy="pack the files themselves",
            name=title,
        )
    if member.flag_bits & 0x1 or member.compress_type not in _PLAIN:
        raise UploadError(
            "its member {name!r} is locked or packed in an unusual way",
            source=source,
            remedy="pack it without a password, as a plain zip",
            name=title,
        )
    _check_sizes(member.file_size, member.compress_size, title, source, limits)


def _check_sizes(size: int, packed: int, title: str, source: str, limits: Limits) -> None:
    if size > limits.file_bytes:
        raise UploadError(
            "its member {name!r} has more than {size:g} MB",
            source=source,
            remedy="send it in smaller parts",
            name=title,
            size=limits.file_bytes / 1e6,
        )
    if size > limits.ratio_from_bytes and size > limits.ratio * max(packed, 1):
        raise UploadError(
            "its member {name!r} unpacks to more than {ratio:g} times its size",
            source=source,
            remedy="pack the files again; pictures never shrink that much",
            name=title,
            ratio=limits.ratio,
        )


def _copy(
    packed: IO[bytes],
    unpacked: BinaryIO,
    member: zipfile.ZipInfo,
    limits: Limits,
    budget: Budget,
    source: str,
) -> None:
    size = 0
    while chunk := packed.read(_CHUNK):
        size += len(chunk)
        budget.take(len(chunk), source)
        _check_sizes(size, member.compress_size, clean_name(member.filename), source, limits)
        write_chunk(unpacked, chunk, source)


def write_chunk(stream: BinaryIO, chunk: bytes, source: str) -> None:
    """Write bytes to a file.

    Raises
    ------
    UploadError
        If the disk is full.
    """
    with wrap_os_errors("cannot be kept", source, "make room on the disk", UploadError):
        stream.write(chunk)


def _damaged(source: str) -> UploadError:
    return UploadError("is not a readable zip", source=source, remedy="pack or copy it again")


def _too_many(most_files: int, source: str) -> UploadError:
    return UploadError(
        "holds more than {files} files",
        source=source,
        remedy="send it in smaller parts",
        files=most_files,
    )


_MB = 1_000_000
_GB = 1000 * _MB


@dataclass(frozen=True)
class Limits:
    """Limits of an upload.

    Parameters
    ----------
    files : int
        Maximum number of files.
    file_bytes, total_bytes : int
        Maximum size of one file, and of all files.
    members : int
        Maximum number of files in all zips of an upload.
    unpacked_bytes : int
        Maximum unpacked size of all zips.
    ratio : float
        Maximum compression ratio of members larger than `ratio_from_bytes`; Deflate reaches 1032.
    ratio_from_bytes : int
        Size above which `ratio` applies.
    zip_depth : int
        Allowed nesting of zips: 1 allows a zip in a zip, 0 none.
    text_bytes : int
        Maximum size of a JSON, YAML, XML or text file.
    """

    files: int = 500
    file_bytes: int = 2 * _GB
    total_bytes: int = 4 * _GB
    members: int = 5000
    unpacked_bytes: int = 8 * _GB
    ratio: float = 200.0
    ratio_from_bytes: int = 4 * _MB
    zip_depth: int = 1
    text_bytes: int = 2 * _MB
