"""Find the captures in uploaded files, with an error for each unusable file."""

from __future__ import annotations

import shutil
import uuid
from collections.abc import Callable
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
from cucumbervision.capture.source import CaptureRef, CaptureSource, ReadOptions
from cucumbervision.errors import (
    CaptureError,
    CucumberVisionError,
    DiskFullError,
    UploadError,
    wrap_os_errors,
)
from cucumbervision.intake.archives import Budget, Limits, clean_name, is_zip, unpack, write_chunk

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from cucumbervision.capture.frames import Capture

LOOSE = "upload"
"""Title of files that were not sent in a zip."""

_CHUNK = 1 << 20
_TEXTS = frozenset({".json", ".txt", ".yaml", ".yml", ".xml"})
_PICTURES = (COLOR_SUFFIXES | DEPTH_SUFFIXES) - {".csv"}
_REMEDY = "pack capture folders, BOP scenes, or colour and depth pictures with matching names"


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
            raise self._named(error) from None
        return replace(source, refs=lambda: self._refs(source))

    def _refs(self, source: CaptureSource) -> Iterator[CaptureRef]:
        for ref in source:
            yield replace(
                ref, load=partial(self._load, ref.load), location=self.sender_name(ref.location)
            )

    def _load(self, load: Callable[[], Capture]) -> Capture:
        try:
            capture = load()
        except CucumberVisionError as error:
            raise self._named(error) from None
        return replace(capture, source=self.sender_name(capture.source))

    def _named(self, error: CucumberVisionError) -> CucumberVisionError:
        return error.at(self.sender_name(error.source))

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
        self._bytes_left = limits.total_bytes
        self._budget = Budget(limits.members, limits.unpacked_bytes)

    def receive(self, number: int, name: str, content: BinaryIO | Path) -> None:
        """Store one file; a zip is unpacked immediately."""
        title, arrived = clean_name(name), self.out.folder / f"arrived-{number:04d}"
        try:
            self._copy(content, arrived, title)
            if is_zip(arrived, title):
                self._unpack(arrived, self.out.folder / f"{number:04d}", title)
                return
            self._check(arrived, title)
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
        folder = list_folder(path)
        folder_source, before = (
            AcceptedSource(path, title),
            len(self.out.sources) + len(self.out.refused),
        )
        kinds = folder.kinds()
        everything = {PurePosixPath(name) for name in folder}
        if find_captures(folder):
            self.out.sources.append(folder_source)
        unread = {PurePosixPath(name) for name in folder}
        used = {name.parent for name in everything - unread}
        for name in sorted(unread):
            suffix, shown_name = name.suffix.lower(), folder_source.sender_name(path / name)
            is_beside = title != LOOSE and not _needs_partner(name, used)
            if suffix in RECORDING_SUFFIXES or not (suffix in _TEXTS | {".csv"} or is_beside):
                self.out.refused.append(_left_alone(shown_name, suffix))
            else:
                self.out.ignored.append(shown_name)
        if title != LOOSE and before == len(self.out.sources) + len(self.out.refused):
            fault = "holds no captures that can be recognised, but {kinds}"
            raise UploadError(fault, source=title, remedy=_REMEDY, kinds=kinds)

    def _check(self, path: Path, title: str) -> None:
        size, suffix = path.stat().st_size, PurePosixPath(title).suffix.lower()
        if suffix in _TEXTS and size > self.limits.text_bytes:
            raise UploadError(
                "has more than {size:g} MB of text",
                source=title,
                remedy="send a smaller file",
                size=self.limits.text_bytes / 1e6,
            )

    def _loose_path(self, name: str) -> Path:
        parts = [part for part in name.replace("\\", "/").split("/") if part.strip(". ")]
        inside = PurePosixPath(*(clean_name(part) for part in parts[-3:] or [""]))
        path, copy_number = self.loose / inside, 2
        while path.exists():  # files from different folders may have the same name
            path, copy_number = self.loose / f"{copy_number}" / inside, copy_number + 1
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def _copy(self, content: BinaryIO | Path, target: Path, title: str) -> None:
        if isinstance(content, Path):
            if not content.is_file():
                raise UploadError("is not a readable file", source=title, remedy="check the path")
            with content.open("rb") as stream:
                self._copy(stream, target, title)
            return
        size = 0
        with target.open("xb") as stream_out:
            while chunk := content.read(_CHUNK):
                size += len(chunk)
                self._bytes_left -= len(chunk)
                if size > self.limits.file_bytes or self._bytes_left < 0:
                    most_bytes = min(self.limits.file_bytes, self.limits.total_bytes)
                    raise UploadError(
                        "is more than the {size:g} MB that are taken",
                        source=title,
                        remedy="send it in smaller parts",
                        size=most_bytes / 1e6,
                    )
                write_chunk(stream_out, chunk, title)

    def _unpack(self, path: Path, folder: Path, title: str, depth: int = 0) -> None:
        """Unpack a zip and nested zips; an incomplete zip is rejected completely."""
        try:
            for name, file in unpack(path, folder, self.limits, self._budget, source=title):
                file_title = f"{title}: {name}"
                try:
                    if not is_zip(file, name):
                        self._check(file, file_title)
                    elif depth == self.limits.zip_depth:
                        raise UploadError(
                            "is nested too deep in other zips",
                            source=file_title,
                            remedy="unpack it first",
                        )
                    else:
                        inner = file.rename(file.with_name(f" {file.name}"))
                        self._unpack(inner, file, file_title, depth + 1)
                except CucumberVisionError as error:
                    self.out.refused.append(error)
                    file.unlink(missing_ok=True)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        finally:
            path.unlink()
        if depth == 0:
            self.sort(folder, title)


def _needs_partner(name: PurePosixPath, used: set[PurePosixPath]) -> bool:
    """Return whether a file is a picture without a matching one."""
    return name.suffix.lower() in _PICTURES and used.isdisjoint(name.parents)


def _left_alone(file_title: str, suffix: str) -> CaptureError:
    if suffix in _PICTURES:
        return CaptureError(
            "has no matching picture: a capture is a colour and a depth picture",
            source=file_title,
            remedy="send both, named alike but for the words color and depth, and an "
            "intrinsics.json",
        )
    if suffix in RECORDING_SUFFIXES:
        return UploadError(
            "is a recording, which is only read on the computer where it lies",
            source=file_title,
            remedy="copy it to the computer that measures: `cucumbervision round add FILE` there "
            "adds its captures to the newest round",
        )
    return UploadError(
        "is not a file type we can read",
        source=file_title,
        remedy="send PNG, JPEG or TIFF pictures, .npy, JSON, or a zip of them",
    )
