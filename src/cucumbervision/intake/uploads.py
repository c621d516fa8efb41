"""From uploaded files to captures that can be opened, with a named error for each that cannot."""

from __future__ import annotations

import shutil
import uuid
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, BinaryIO

from cucumbervision.errors import CucumberVisionError, UploadError
from cucumbervision.intake.archives import Budget, clean_name, unpack, write_chunk
from cucumbervision.intake.file_checks import HEAD_BYTES, FileKind, check_item, file_kind
from cucumbervision.intake.layouts import arrange_uploads
from cucumbervision.intake.limits import Limits
from cucumbervision.intake.staging import AcceptedUploads, Staging

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from cucumbervision.intake.file_checks import Item

_CHUNK = 1 << 20


def accept_uploads(
    files: Sequence[tuple[str, BinaryIO | Path]],
    folder: Path,
    limits: Limits | None = None,
    *,
    burst: int = 5,
    report: Callable[[int, str], None] | None = None,
) -> AcceptedUploads:
    """Check uploaded files, and lay out their captures for `open_source`.

    Parameters
    ----------
    files : sequence of (name, stream or Path)
        What each file is called by its sender, and its content. Names are only shown and matched
        (colour to depth), never used as paths.
    folder : Path
        Made if it is missing. A folder of our own naming is made in it and kept if anything was
        accepted; nothing else remains, whatever happens.
    limits : Limits, optional
        How much is taken.
    burst : int
        Frames of a recording fused to one capture.
    report : callable, optional
        Called with the number of each file, from 0, and its name before it is checked.

    Returns
    -------
    AcceptedUploads
        One broken file costs the others nothing.

    Raises
    ------
    UploadError
        If there are too many files, or `folder` cannot be written.

    Examples
    --------
    >>> import io, tempfile
    >>> with tempfile.TemporaryDirectory() as tmp:
    ...     got = accept_uploads([("../../x.png", io.BytesIO(b"MZ"))], Path(tmp) / "in")
    ...     print(got.refused[0].error)
    x.png: is of no kind that is accepted; send PNG, JPEG or TIFF pictures, ...
    """
    limits = limits or Limits()
    if len(files) > limits.files:
        raise UploadError(
            f"{len(files)} files were sent, at most {limits.files} are taken at once",
            remedy="send them in smaller parts, or as a zip",
        )
    batch = folder / f"upload-{uuid.uuid4().hex[:12]}"
    intake = _Intake(batch, limits, burst)
    try:
        intake.stage.mkdir(parents=True)
        for number, (name, content) in enumerate(files):
            if report is not None:
                report(number, clean_name(name))
            intake.receive(number, name, content)
        intake.sort("upload", intake.loose, is_archive=False)
        shutil.rmtree(intake.stage)
        if not intake.out.sources:
            batch.rmdir()
    except OSError as error:
        shutil.rmtree(batch, ignore_errors=True)
        raise UploadError(
            f"uploads cannot be kept ({error.strerror or error})",
            source=folder,
            remedy="make room on the disk, or choose another folder",
        ) from None
    except BaseException:
        shutil.rmtree(batch, ignore_errors=True)
        raise
    return intake.out


class _Intake:
    """One upload on its way in."""

    def __init__(self, batch: Path, limits: Limits, burst: int) -> None:
        self.batch, self.limits, self._burst = batch, limits, burst
        self.stage = batch / "arriving"
        self.out = AcceptedUploads(batch)
        self.loose: list[Item] = []
        self._bytes_left = limits.total_bytes
        self._budget = Budget(limits.members, limits.unpacked_bytes)
        self._archives = 0

    def receive(self, number: int, name: str, content: BinaryIO | Path) -> None:
        """Keep a copy of one file and check it; a zip is unpacked and sorted at once."""
        title, own = clean_name(name), self.stage / f"{number:04d}"
        try:
            self._copy(content, own, title)
            if _kind(own, name) is FileKind.ZIP:
                self._unpack(own, title, depth=0)
            else:
                self.loose.append(check_item(self._loose_name(name), title, own, self.limits))
        except CucumberVisionError as error:
            self.out.refuse(title, error)
            own.unlink(missing_ok=True)

    def sort(self, title: str, items: Sequence[Item], *, is_archive: bool) -> None:
        """Make sources of the files of one zip or batch."""
        staging = Staging(title, items, self.batch, self.limits, self.out, is_archive=is_archive)
        arrange_uploads(staging, self._burst)

    def _copy(self, content: BinaryIO | Path, own: Path, title: str) -> None:
        if isinstance(content, Path):
            if not content.is_file():
                raise UploadError("is not a readable file", source=title, remedy="check the path")
            with content.open("rb") as stream:
                self._copy(stream, own, title)
            return
        size = 0
        with own.open("xb") as kept:
            while chunk := content.read(_CHUNK):
                size += len(chunk)
                self._bytes_left -= len(chunk)
                if size > self.limits.file_bytes or self._bytes_left < 0:
                    most = min(self.limits.file_bytes, self.limits.total_bytes)
                    raise UploadError(
                        f"is more than the {most / 1e6:g} MB that are taken",
                        source=title,
                        remedy="send it in smaller parts",
                    )
                write_chunk(kept, chunk, title)

    def _unpack(self, path: Path, title: str, depth: int) -> None:
        self._archives += 1
        inside = self.stage / f"zip-{self._archives:04d}"
        known = len(self.out.sources) + len(self.out.refused)
        try:
            items = list(self._members(path, inside, title, depth))
            self.sort(title, items, is_archive=True)
        finally:
            path.unlink()
            shutil.rmtree(inside, ignore_errors=True)
        if len(self.out.sources) + len(self.out.refused) == known:
            raise UploadError(
                "holds no captures that can be recognised",
                source=title,
                remedy="pack capture folders, BOP scenes, or colour and depth pictures with "
                "matching names",
            )

    def _members(self, path: Path, inside: Path, title: str, depth: int) -> Iterator[Item]:
        for member in unpack(path, inside, self.limits, self._budget, source=title):
            shown = f"{title}: {clean_name(member.name.name)}"
            try:
                kind = _kind(member.path, member.name.name)
                if kind is FileKind.ZIP:
                    if depth >= self.limits.zip_depth:
                        raise UploadError(
                            "is a zip too deep in others", source=shown, remedy="unpack it first"
                        )
                    self._unpack(member.path, shown, depth + 1)
                elif kind is None:
                    self.out.ignored.append(shown)
                else:
                    yield check_item(member.name, shown, member.path, self.limits)
            except CucumberVisionError as error:
                self.out.refuse(shown, error)

    def _loose_name(self, name: str) -> PurePosixPath:
        parts = [part for part in name.replace("\\", "/").split("/") if part.strip(". ")]
        path = PurePosixPath(*(clean_name(part) for part in parts[-3:] or ["unnamed"]))
        taken = {item.name for item in self.loose}
        again = 2
        unique = path
        while unique in taken:  # color.png and depth.png may each be sent twice, from two folders
            unique, again = PurePosixPath(f"{again}") / path, again + 1
        return unique


def _kind(path: Path, name: str) -> FileKind | None:
    with path.open("rb") as stream:
        return file_kind(stream.read(HEAD_BYTES), name)
