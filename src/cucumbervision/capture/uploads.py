"""Unpack uploaded files within limits, and find their captures; each unusable file has an error."""

from __future__ import annotations

import os
import re
import shutil
import unicodedata
import uuid
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, Any, BinaryIO

from cucumbervision.capture import readers
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.pictures import COLOR_SUFFIXES, DEPTH_SUFFIXES
from cucumbervision.capture.source import CaptureRef, CaptureSource, ReadOptions, no_device
from cucumbervision.errors import (
    CaptureError,
    CucumberVisionError,
    DiskFullError,
    UploadError,
    wrap_os_errors,
    wrap_reader_errors,
)

LOOSE = "upload"
"""Title of files that were not sent in a zip."""

_TEXTS = frozenset({".json", ".txt", ".yaml", ".yml", ".xml"})
_PICTURES = (COLOR_SUFFIXES | DEPTH_SUFFIXES) - {".csv"}
_REMEDY = "pack capture folders, BOP scenes, or colour and depth pictures with matching names"
_SMALLER, _PACK_AGAIN = "send it in smaller parts", "pack the captures' folder again"
_FORBIDDEN = re.compile(r'[<>:"|?*]')  # in names on Windows; a part after ':' would be hidden
# Longest name of a file; largest entry of a zip's directory, with extra fields.
_MOST_BYTES, _ENTRY_BYTES = 240, 600
_ZIP = (b"PK\x03\x04", b"PK\x05\x06")
_GB = 1_000_000_000


@dataclass(frozen=True)
class Limits:
    """Limits of an upload.

    Parameters
    ----------
    files : int
        Maximum number of files.
    total_bytes : int
        Maximum size of all files.
    members : int
        Maximum number of files in all zips of an upload.
    unpacked_bytes : int
        Maximum unpacked size of all zips.
    text_bytes : int
        Maximum size of a JSON, YAML, XML or text file.
    """

    files: int = 500
    total_bytes: int = 4 * _GB
    members: int = 5000
    unpacked_bytes: int = 8 * _GB
    text_bytes: int = 2_000_000


def clean_name(text: str) -> str:
    """Sanitise a file name from a sender: last path component, valid on Windows, limited length.

    Examples
    --------
    >>> clean_name("../../etc/pass" + chr(0) + "wd" + chr(0x202E) + ".png")
    'passwd.png'
    >>> clean_name("docs/con"), clean_name("row: 3?.png. ")
    ('_con', 'row_ 3_.png')
    >>> clean_name("a" * 300 + ".png")[-7:], len(clean_name("a" * 300))
    ('aaa.png', 240)
    """
    last = text.replace("\\", "/").rstrip("/").rsplit("/", 1)[-1]
    plain = unicodedata.normalize("NFC", last.encode("utf-8", "replace").decode())
    # Control characters, bidirectional formatting characters and unassigned code points.
    printable = "".join(
        c for c in plain if not unicodedata.category(c).startswith(("C", "Zl", "Zp"))
    )
    printable = no_device(" ".join(_FORBIDDEN.sub("_", printable).split()).rstrip(". "))
    printable = printable.encode()[-_MOST_BYTES:].decode(errors="ignore")
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
        with self._sender_names():
            source = readers.open_source(self.path, options)

        def refs() -> Iterator[CaptureRef]:
            for ref in source:
                location = self.sender_name(ref.location)
                yield replace(ref, load=partial(self._load, ref.load), location=location)

        return replace(source, refs=refs)

    def _load(self, load: Callable[[], Capture]) -> Capture:
        with self._sender_names():
            capture = load()
        return replace(capture, source=self.sender_name(capture.source))

    @contextmanager
    def _sender_names(self) -> Iterator[None]:
        try:
            yield
        except CucumberVisionError as error:
            raise error.at(self.sender_name(error.source)) from None

    def sender_name(self, path: object) -> str:
        """Return the sender's name of a file."""
        text = str(path)
        if not text.startswith(str(self.path)):
            return text or self.title
        inside = text.removeprefix(str(self.path)).lstrip("/ ")
        title = "" if self.title == LOOSE and inside else self.title
        return ": ".join(filter(None, (title, inside)))


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
    require_few(files, limits)
    uploads = AcceptedUploads(folder / f"upload-{uuid.uuid4().hex[:12]}", limits)
    try:
        with wrap_os_errors("uploads cannot be kept", folder, "choose another folder", UploadError):
            uploads.folder.mkdir(parents=True)
            for number, (name, content) in enumerate(files):
                uploads.receive(number, name, content)
            if uploads.loose.exists():
                uploads.sort(uploads.loose, LOOSE)
            if not uploads.sources:
                shutil.rmtree(uploads.folder)
    except BaseException:
        shutil.rmtree(uploads.folder, ignore_errors=True)
        raise
    return uploads


def require_few(files: Sequence[object], limits: Limits) -> None:
    """Refuse more files than are taken at once.

    Raises
    ------
    UploadError
        If there are more.
    """
    if len(files) > limits.files:
        raise UploadError(
            "{files} files were sent, at most {limit} are taken at once",
            remedy="send them in smaller parts, or as a zip",
            files=len(files),
            limit=limits.files,
        )


class AcceptedUploads:
    """Result of an upload.

    Parameters
    ----------
    folder : Path
        Folder of the upload; does not exist if nothing was accepted.
    limits : Limits
        Its limits.

    Attributes
    ----------
    sources : list of AcceptedSource
        Accepted sources of captures.
    refused : list of CucumberVisionError
        Errors of rejected files, with the sender's names.
    ignored : list of str
        Files that are not needed.
    """

    def __init__(self, folder: Path, limits: Limits) -> None:
        self.folder, self.loose, self._limits = folder, folder / LOOSE, limits
        self._left = dict(vars(limits))
        self.sources: list[AcceptedSource] = []
        self.refused: list[CucumberVisionError] = []
        self.ignored: list[str] = []

    def receive(self, number: int, name: str, content: BinaryIO | Path) -> None:
        """Store one file; a zip is unpacked at once."""
        title = clean_name(name)
        try:
            if isinstance(content, Path) and not content.is_file():
                raise UploadError("is not a readable file", source=title, remedy="check the path")
            with content.open("rb") if isinstance(content, Path) else nullcontext(content) as file:
                size, _ = file.seek(0, os.SEEK_END), file.seek(0)
                self._take("total_bytes", size, title)
                head, _ = file.read(4), file.seek(0)
                if head in _ZIP and not title.lower().endswith(".npz"):
                    self._unpack(file, self.folder / f"{number:04d}", title)
                elif not size:
                    raise UploadError("the file is empty", source=title, remedy="copy it again")
                else:
                    _store(file, self._loose_path(name), title)
        except DiskFullError:  # no fault of the file: the others cannot be kept, either
            raise
        except CucumberVisionError as error:
            self.refused.append(error)

    def _take(self, kind: str, size: int, title: str) -> None:
        """Refuse a file that is too large, or for which there is no room left."""
        self._left[kind] -= size
        is_long = PurePosixPath(title).suffix.lower() in _TEXTS and size > self._limits.text_bytes
        if is_long or self._left[kind] < 0:
            most = self._limits.text_bytes if is_long else getattr(self._limits, kind)
            fault = "is more than the {size:g} MB that are taken"
            raise UploadError(fault, source=title, remedy=_SMALLER, size=most / 1e6)

    def sort(self, path: Path, title: str) -> None:
        """Find the captures of a folder, and report the files that belong to none."""
        folder, source = readers.list_folder(path), AcceptedSource(path, title)
        kinds, everything, refused = folder.kinds(), {*folder}, len(self.refused)
        if is_used := bool(readers.find_captures(folder)):
            self.sources.append(source)
        unread = sorted(folder)
        used = {PurePosixPath(name).parent for name in everything.difference(unread)}
        for name in map(PurePosixPath, unread):
            suffix, shown_name = name.suffix.lower(), source.sender_name(path / name)
            # An image beside captures of a zip may be anything; one without them lacks a partner.
            is_lone = suffix in _PICTURES and used.isdisjoint(name.parents)
            is_unknown = title == LOOSE and suffix not in _TEXTS | {".csv"}
            if suffix in readers.RECORDING_SUFFIXES or is_lone or is_unknown:
                self.refused.append(_left_alone(shown_name, suffix))
            else:
                self.ignored.append(shown_name)
        if title != LOOSE and not is_used and refused == len(self.refused):
            fault = "holds no captures that can be recognised, but {kinds}"
            raise UploadError(fault, source=title, remedy=_REMEDY, kinds=kinds)

    def _loose_path(self, name: str) -> Path:
        parts = [part for part in name.replace("\\", "/").split("/") if part.strip(". ")]
        inside = PurePosixPath(*(clean_name(part) for part in parts[-3:] or [""]))
        path, copy_number = self.loose / inside, 2
        while path.exists():  # files from different folders may have the same name
            path, copy_number = self.loose / f"{copy_number}" / inside, copy_number + 1
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def _unpack(self, file: BinaryIO, folder: Path, title: str) -> None:
        """Unpack a zip; an incomplete zip is rejected completely."""
        bounded: Any = _Bounded(file, max(self._limits.members * _ENTRY_BYTES, 2 << 20))
        try:
            with (
                wrap_reader_errors(title, UploadError, "pack or copy it again"),
                zipfile.ZipFile(bounded) as archive,
            ):
                members = [member for member in archive.infolist() if not member.is_dir()]
                names = [_member_path(member.filename, title) for member in members]
                self._left["members"] -= len(members)
                if self._left["members"] < 0:
                    fault, most = "holds more than {files} files", self._limits.members
                    raise UploadError(fault, source=title, remedy=_SMALLER, files=most)
                for member, name in zip(members, names, strict=True):
                    member_title = f"{title}: {name}"
                    try:
                        # Unpacking gives no more bytes than the directory states.
                        self._take("unpacked_bytes", member.file_size, member_title)
                    except UploadError as error:
                        if name.suffix.lower() not in _TEXTS:
                            raise error.at(title) from None
                        self.refused.append(error)
                        continue
                    with archive.open(member) as packed:
                        _store(packed, folder / name, member_title)
            self.sort(folder, title)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise


def _store(content: IO[bytes], target: Path, title: str) -> None:
    remedy = "make room on the disk, or shorten the name"
    with wrap_os_errors("cannot be kept", title, remedy, UploadError):
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("xb") as stream:
            shutil.copyfileobj(content, stream)


class _Bounded:
    """A file that is read in limited pieces, since zipfile reads the whole directory at once."""

    def __init__(self, file: BinaryIO, most_bytes: int) -> None:
        self._file, self._most_bytes = file, most_bytes

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def read(self, size: int = -1) -> bytes:
        if size > self._most_bytes:
            raise zipfile.BadZipFile
        return self._file.read(size)


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
    parts = name.replace("\\", "/").split("/")
    if not parts[0] or ".." in parts:
        fault = "a member's name leads out of the zip ({name!r})"
        raise UploadError(fault, source=archive, remedy=_PACK_AGAIN, name=clean_name(name))
    return PurePosixPath(*(clean_name(part) for part in parts if part not in ("", ".")))


def _left_alone(file_title: str, suffix: str) -> CaptureError:
    if suffix in _PICTURES:
        fault = "has no matching picture: a capture is a colour and a depth picture"
        remedy = "send both, named alike but for the words color and depth, and an intrinsics.json"
        return CaptureError(fault, source=file_title, remedy=remedy)
    fault = "is not a file type we can read"
    remedy = "send PNG, JPEG or TIFF pictures, .npy, JSON, or a zip of them"
    if suffix in readers.RECORDING_SUFFIXES:
        fault = "is a recording, which is only read on the computer where it lies"
        remedy = (
            "copy it to the computer that measures: `cucumbervision round add FILE` there adds "
            "its captures to the newest round"
        )
    return UploadError(fault, source=file_title, remedy=remedy)
