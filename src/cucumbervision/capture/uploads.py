"""Unpack uploaded files within limits, and find their captures; each unusable file has an error."""

from __future__ import annotations

import io
import re
import shutil
import stat
import unicodedata
import uuid
import zipfile
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, BinaryIO

from cucumbervision.capture.pictures import COLOR_SUFFIXES, DEPTH_SUFFIXES
from cucumbervision.capture.readers import (
    RECORDING_SUFFIXES,
    find_captures,
    list_folder,
    open_source,
)
from cucumbervision.capture.source import CaptureRef, CaptureSource, ReadOptions, no_device
from cucumbervision.errors import (
    CaptureError,
    CucumberVisionError,
    DiskFullError,
    UploadError,
    wrap_os_errors,
    wrap_reader_errors,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from cucumbervision.capture.frames import Capture

LOOSE = "upload"
"""Title of files that were not sent in a zip."""

_CHUNK = 1 << 20
_TEXTS = frozenset({".json", ".txt", ".yaml", ".yml", ".xml"})
_PICTURES = (COLOR_SUFFIXES | DEPTH_SUFFIXES) - {".csv"}
_REMEDY = "pack capture folders, BOP scenes, or colour and depth pictures with matching names"
_SMALLER, _PACK_AGAIN = "send it in smaller parts", "pack the captures' folder again"
_LONGEST_NAME, _DEEPEST_FOLDER = 120, 32
_FORBIDDEN = re.compile(r'[<>:"|?*]')  # in names on Windows; a part after ':' would be hidden
_CLUTTER = frozenset({".ds_store", "thumbs.db", "desktop.ini"})
_ENTRY_BYTES = 600  # maximum size of a zip's directory entry, with name and extra fields
_PLAIN = frozenset({zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED})
_GB = 1_000_000_000


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
    text_bytes : int
        Maximum size of a JSON, YAML, XML or text file.
    """

    files: int = 500
    file_bytes: int = 2 * _GB
    total_bytes: int = 4 * _GB
    members: int = 5000
    unpacked_bytes: int = 8 * _GB
    ratio: float = 200.0
    ratio_from_bytes: int = 4_000_000
    text_bytes: int = 2_000_000


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


@dataclass(frozen=True)
class AcceptedSource:
    """Captures of an upload.

    Parameters
    ----------
    path : Path
        The folder or file.
    title : str
        Name of the zip or file, or 'upload' for single files.
    """

    path: Path
    title: str

    def open(self, options: ReadOptions | None = None) -> CaptureSource:
        """Return the captures; names and errors use the sender's file names.

        Parameters
        ----------
        options : ReadOptions, optional
            See `open_source`; given intrinsics replace uploaded ones.

        Raises
        ------
        CucumberVisionError
            See `open_source`.
        """
        try:
            source = open_source(self.path, options)
        except CucumberVisionError as error:
            raise error.at(self.sender_name(error.source)) from None
        return replace(source, refs=lambda: self._refs(source))

    def _refs(self, source: CaptureSource) -> Iterator[CaptureRef]:
        for ref in source:
            location = self.sender_name(ref.location)
            yield replace(ref, load=partial(self._load, ref.load), location=location)

    def _load(self, load: Callable[[], Capture]) -> Capture:
        try:
            capture = load()
        except CucumberVisionError as error:
            raise error.at(self.sender_name(error.source)) from None
        return replace(capture, source=self.sender_name(capture.source))

    def sender_name(self, path: object) -> str:
        """Return the sender's name of a file."""
        text = str(path)
        if not text.startswith(str(self.path)):
            return text or self.title
        inside = text.removeprefix(str(self.path)).lstrip("/ ")
        if self.title == LOOSE and inside:
            return inside
        return f"{self.title}: {inside}" if inside else self.title


@dataclass(frozen=True)
class AcceptedUploads:
    """Result of an upload.

    Parameters
    ----------
    folder : Path
        Folder of the upload; does not exist if nothing was accepted.
    sources : list of AcceptedSource
        Accepted sources of captures.
    refused : list of CucumberVisionError
        Errors of rejected files, with the sender's names.
    ignored : list of str
        Files that are not needed.
    """

    folder: Path
    sources: list[AcceptedSource] = field(default_factory=list)
    refused: list[CucumberVisionError] = field(default_factory=list)
    ignored: list[str] = field(default_factory=list)


def accept_uploads(
    files: Sequence[tuple[str, BinaryIO | Path]], folder: Path, limits: Limits | None = None
) -> AcceptedUploads:
    """Store uploaded files within limits, unpack zips, and find the captures.

    Parameters
    ----------
    files : sequence of (name, stream or Path)
        The sender's name and the content of each file.
    folder : Path
        Parent folder; created if missing. A subfolder is created and kept only if a file was
        accepted.
    limits : Limits, optional
        Limits of the upload.

    Returns
    -------
    AcceptedUploads
        Accepted sources and errors; a broken file does not affect the others.

    Raises
    ------
    UploadError
        If there are too many files, or `folder` is not writable.
    DiskFullError
        If the disk is full; nothing is kept.

    Examples
    --------
    >>> import io, tempfile
    >>> with tempfile.TemporaryDirectory() as tmp:
    ...     got = accept_uploads([("../../x.exe", io.BytesIO(b"MZ"))], Path(tmp) / "in")
    ...     print(got.refused[0])
    x.exe: is not a file type we can read; send PNG, JPEG or TIFF pictures, ...
    """
    limits = limits or Limits()
    if len(files) > limits.files:
        raise UploadError(
            "{files} files were sent, at most {limit} are taken at once",
            remedy="send them in smaller parts, or as a zip",
            files=len(files),
            limit=limits.files,
        )
    batch = folder / f"upload-{uuid.uuid4().hex[:12]}"
    intake = _Intake(AcceptedUploads(batch), limits)
    try:
        with wrap_os_errors("uploads cannot be kept", folder, "choose another folder", UploadError):
            intake.loose.mkdir(parents=True)
            for number, (name, content) in enumerate(files):
                intake.receive(number, name, content)
            intake.sort(intake.loose, LOOSE)
            if not intake.out.sources:
                shutil.rmtree(batch)
            elif not any(intake.loose.iterdir()):
                intake.loose.rmdir()
    except BaseException:
        shutil.rmtree(batch, ignore_errors=True)
        raise
    return intake.out


class _Intake:
    """State of an upload while it is processed."""

    def __init__(self, out: AcceptedUploads, limits: Limits) -> None:
        self.out, self.limits = out, limits
        self.loose = out.folder / LOOSE
        self._bytes_left, self._unpacked_left = limits.total_bytes, limits.unpacked_bytes
        self._members_left = limits.members

    def receive(self, number: int, name: str, content: BinaryIO | Path) -> None:
        """Store one file; a zip is unpacked immediately."""
        title, arrived = clean_name(name), self.out.folder / f"arrived-{number:04d}"
        try:
            if isinstance(content, Path) and not content.is_file():
                raise UploadError("is not a readable file", source=title, remedy="check the path")
            with content.open("rb") if isinstance(content, Path) else nullcontext(content) as file:
                self._copy(file, arrived, title)
            if _is_zip(arrived, title):
                self._unpack(arrived, self.out.folder / f"{number:04d}", title)
                return
            self._check_text(arrived, title)
            if not arrived.stat().st_size:
                raise UploadError("the file is empty", source=title, remedy="copy it again")
            with wrap_os_errors("cannot be kept", title, "rename it", UploadError):
                arrived.rename(self._loose_path(name))
        except DiskFullError:  # no fault of the file: the others cannot be kept, either
            raise
        except CucumberVisionError as error:
            self.out.refused.append(error)
        finally:
            arrived.unlink(missing_ok=True)

    def sort(self, path: Path, title: str) -> None:
        """Find the captures of a folder, and report the files that belong to none."""
        folder, source = list_folder(path), AcceptedSource(path, title)
        kinds, everything = folder.kinds(), {*folder}
        is_used, refused = bool(find_captures(folder)), len(self.out.refused)
        if is_used:
            self.out.sources.append(source)
        unread = sorted(folder)
        used = {PurePosixPath(name).parent for name in everything.difference(unread)}
        for name in map(PurePosixPath, unread):
            suffix, shown_name = name.suffix.lower(), source.sender_name(path / name)
            # A picture beside captures of a zip may be anything; one without them lacks a partner.
            is_beside = title != LOOSE and not (
                suffix in _PICTURES and used.isdisjoint(name.parents)
            )
            if suffix in RECORDING_SUFFIXES or not (suffix in _TEXTS | {".csv"} or is_beside):
                self.out.refused.append(_left_alone(shown_name, suffix))
            else:
                self.out.ignored.append(shown_name)
        if title != LOOSE and not is_used and refused == len(self.out.refused):
            fault = "holds no captures that can be recognised, but {kinds}"
            raise UploadError(fault, source=title, remedy=_REMEDY, kinds=kinds)

    def _check_text(self, path: Path, title: str) -> None:
        is_text = PurePosixPath(title).suffix.lower() in _TEXTS
        if is_text and path.stat().st_size > self.limits.text_bytes:
            fault, size = "has more than {size:g} MB of text", self.limits.text_bytes / 1e6
            raise UploadError(fault, source=title, remedy="send a smaller file", size=size)

    def _loose_path(self, name: str) -> Path:
        parts = [part for part in name.replace("\\", "/").split("/") if part.strip(". ")]
        inside = PurePosixPath(*(clean_name(part) for part in parts[-3:] or [""]))
        path, copy_number = self.loose / inside, 2
        while path.exists():  # files from different folders may have the same name
            path, copy_number = self.loose / f"{copy_number}" / inside, copy_number + 1
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def _copy(self, content: BinaryIO, target: Path, title: str) -> None:
        size = 0
        with target.open("xb") as stream:
            while chunk := content.read(_CHUNK):
                size += len(chunk)
                self._bytes_left -= len(chunk)
                if size > self.limits.file_bytes or self._bytes_left < 0:
                    most_mb = min(self.limits.file_bytes, self.limits.total_bytes) / 1e6
                    fault = "is more than the {size:g} MB that are taken"
                    raise UploadError(fault, source=title, remedy=_SMALLER, size=most_mb)
                _write(stream, chunk, title)

    def _unpack(self, path: Path, folder: Path, title: str) -> None:
        """Unpack a zip; an incomplete zip is rejected completely."""
        try:
            for name, file in self._members(path, folder, title):
                file_title = f"{title}: {name}"
                try:
                    self._check_text(file, file_title)
                    if _is_zip(file, name):
                        fault = "is a zip in a zip"
                        raise UploadError(fault, source=file_title, remedy="unpack it first")
                except CucumberVisionError as error:
                    self.out.refused.append(error)
                    file.unlink()
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        self.sort(folder, title)

    def _members(self, path: Path, folder: Path, source: str) -> Iterator[tuple[str, Path]]:
        """Unpack a zip file by file; yield their names and paths without clutter."""
        folder.mkdir(parents=True)
        most_bytes = max(self.limits.members * _ENTRY_BYTES, 2 * _CHUNK)
        with (
            wrap_reader_errors(source, UploadError, "pack or copy it again"),
            _Bounded(path, most_bytes) as stream,
            zipfile.ZipFile(stream) as archive,
        ):
            members = [
                (member, name)
                for member in archive.infolist()
                if not member.is_dir()
                and not _is_clutter(name := _member_path(member.orig_filename, source))
            ]
            for member, name in members:
                self._check_member(member, clean_name(name.name), source)
            self._members_left -= len(members)
            if self._members_left < 0:
                fault, most = "holds more than {files} files", self.limits.members
                raise UploadError(fault, source=source, remedy=_SMALLER, files=most)
            for member, name in members:
                self._extract(archive, member, folder / name, source)
                yield str(name), folder / name

    def _extract(
        self, archive: zipfile.ZipFile, member: zipfile.ZipInfo, target: Path, source: str
    ) -> None:
        size, title = 0, f"{source}: {target.name}"
        with wrap_os_errors("cannot be kept", title, "pack it with shorter names", UploadError):
            if target.exists():
                raise UploadError(
                    "has two members of one name", source=source, remedy="pack the folder again"
                )
            target.parent.mkdir(parents=True, exist_ok=True)
            unpacked = target.open("xb")
        with unpacked, archive.open(member) as packed:
            while chunk := packed.read(_CHUNK):  # sizes in the directory may be false
                size += len(chunk)
                self._unpacked_left -= len(chunk)
                if self._unpacked_left < 0:
                    raise UploadError(
                        "unpacks to more than is accepted", source=source, remedy=_SMALLER
                    )
                self._check_sizes(size, member.compress_size, target.name, source)
                _write(unpacked, chunk, source)

    def _check_member(self, member: zipfile.ZipInfo, title: str, source: str) -> None:
        if stat.S_IFMT(member.external_attr >> 16) not in {0, stat.S_IFREG}:
            fault = "its member {name!r} is a link or a device"
            remedy = "pack the files themselves"
        elif member.flag_bits & 0x1 or member.compress_type not in _PLAIN:
            fault = "its member {name!r} is locked or packed in an unusual way"
            remedy = "pack it without a password, as a plain zip"
        else:
            return self._check_sizes(member.file_size, member.compress_size, title, source)
        raise UploadError(fault, source=source, remedy=remedy, name=title)

    def _check_sizes(self, size: int, packed: int, title: str, source: str) -> None:
        limits = self.limits
        if size > limits.file_bytes:
            fault = "its member {name!r} has more than {most:g} MB"
            remedy, most = _SMALLER, limits.file_bytes / 1e6
        elif size > limits.ratio_from_bytes and size > limits.ratio * max(packed, 1):
            fault, most = (
                "its member {name!r} unpacks to more than {most:g} times its size",
                limits.ratio,
            )
            remedy = "pack the files again; pictures never shrink that much"
        else:
            return
        raise UploadError(fault, source=source, remedy=remedy, name=title, most=most)


class _Bounded(io.FileIO):
    """A zip that is read in limited pieces, since zipfile reads the whole directory at once."""

    def __init__(self, path: Path, most_bytes: int) -> None:
        super().__init__(path)
        self._size, self._most_bytes = path.stat().st_size, most_bytes

    def read(self, size: int | None = -1) -> bytes:
        wanted = self._size if size is None or size < 0 else size
        if min(wanted, self._size - self.tell()) > self._most_bytes:
            raise zipfile.BadZipFile
        return super().read(size) or b""


def _member_path(name: str, archive: str) -> PurePosixPath:
    """Return the path of a zip member inside the archive.

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
        fault, remedy = "a member's name leads out of the zip ({name!r})", _PACK_AGAIN
        raise UploadError(fault, source=archive, remedy=remedy, name=clean_name(name))
    if len(parts) > _DEEPEST_FOLDER:
        fault, depth = "nests more than {depth} folders", _DEEPEST_FOLDER
        raise UploadError(fault, source=archive, remedy=_PACK_AGAIN, depth=depth)
    return PurePosixPath(*(clean_name(part) for part in parts if part not in ("", ".")))


def _is_clutter(path: PurePosixPath) -> bool:
    """Return whether a file is metadata of an operating system."""
    name = path.name.lower()
    return name in _CLUTTER or name.startswith("._") or "__MACOSX" in path.parts


def _is_zip(path: Path, name: str) -> bool:
    """Return whether a file is a zip by its first bytes, and not an `.npz` by its name."""
    with path.open("rb") as stream:
        head = stream.read(4)
    return head in (b"PK\x03\x04", b"PK\x05\x06") and not name.lower().endswith(".npz")


def _write(stream: BinaryIO, chunk: bytes, source: str) -> None:
    with wrap_os_errors("cannot be kept", source, "make room on the disk", UploadError):
        stream.write(chunk)


def _left_alone(file_title: str, suffix: str) -> CaptureError:
    if suffix in _PICTURES:
        fault = "has no matching picture: a capture is a colour and a depth picture"
        remedy = "send both, named alike but for the words color and depth, and an intrinsics.json"
        return CaptureError(fault, source=file_title, remedy=remedy)
    if suffix in RECORDING_SUFFIXES:
        fault = "is a recording, which is only read on the computer where it lies"
        remedy = (
            "copy it to the computer that measures: `cucumbervision round add FILE` there adds "
            "its captures to the newest round"
        )
    else:
        fault = "is not a file type we can read"
        remedy = "send PNG, JPEG or TIFF pictures, .npy, JSON, or a zip of them"
    return UploadError(fault, source=file_title, remedy=remedy)
