"""Plain pictures to look at: from files, folders and patterns."""

from __future__ import annotations

import glob
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cucumbervision.capture.files import PHOTO_SUFFIXES
from cucumbervision.errors import CaptureError
from cucumbervision.pipeline.results import Failure

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

__all__ = ["Picture", "PictureList", "find_pictures"]


@dataclass(frozen=True)
class Picture:
    """A file to look at.

    Parameters
    ----------
    path : Path
        Where it lies.
    name : str
        What tables call it: its path below the folder that was given, with '/'; no two are alike.
    """

    path: Path
    name: str


@dataclass(frozen=True)
class PictureList:
    """What the inputs hold.

    Parameters
    ----------
    pictures : tuple of Picture
        Each file once, in the inputs' order, sorted within a folder.
    skipped : int
        Files in folders that are no pictures by their ending.
    failures : tuple of Failure
        Inputs that name nothing.
    """

    pictures: tuple[Picture, ...]
    skipped: int
    failures: tuple[Failure, ...]


def find_pictures(inputs: Sequence[str | Path], leave_out: Path | None = None) -> PictureList:
    """List the pictures of files, folders (with those below) and patterns such as 'a/*.jpg'.

    A file that is named is a picture whatever it is called; in folders and patterns the ending
    decides, and hidden files are passed over.

    Parameters
    ----------
    inputs : sequence of str or Path
        What the user named.
    leave_out : Path, optional
        A folder whose files are not taken: that of the results.

    Examples
    --------
    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> for name in ("b.JPG", "a.png", "notes.txt"):
    ...     _ = (folder / name).write_bytes(b"")
    >>> found = find_pictures([folder, folder / "b.JPG"])
    >>> [picture.name for picture in found.pictures], found.skipped
    (['a.png', 'b.JPG'], 1)
    """
    apart = leave_out.resolve() if leave_out is not None else None
    seen: set[Path] = set()
    names: set[str] = set()
    pictures: list[Picture] = []
    failures: list[Failure] = []
    skipped = 0
    for given in inputs:
        files, failure = _files(str(given))
        failures += [failure] if failure else []
        for path, name, named in files:
            whole = path.resolve()
            if whole in seen or (not named and apart is not None and apart in whole.parents):
                continue
            seen.add(whole)
            if not named and path.suffix.lower() not in PHOTO_SUFFIXES:
                skipped += 1
                continue
            pictures.append(Picture(path, _own_name((name, path.as_posix()), whole, names)))
    return PictureList(tuple(pictures), skipped, tuple(failures))


def _files(given: str) -> tuple[Iterable[tuple[Path, str, bool]], Failure | None]:
    """Give each file with its name and whether the user named it, or why there is none."""
    path = Path(given)
    if path.is_dir():
        return _below(path), None
    if path.exists():
        return [(path, path.name, True)], None
    # Some shells leave patterns alone. Path.glob takes no absolute ones.
    matches = [Path(match) for match in sorted(glob.glob(given, recursive=True))]  # noqa: PTH207
    if not matches:
        fault = "no file matches it" if glob.has_magic(given) else "does not exist"
        error = CaptureError(fault, source=given, remedy="check the path")
        return [], Failure(given, "", error.code, str(error))
    return (file for match in matches for file in _matched(match)), None


def _matched(match: Path) -> Iterator[tuple[Path, str, bool]]:
    if match.is_dir():
        yield from _below(match)
    else:
        yield match, match.name, False


def _below(folder: Path) -> Iterator[tuple[Path, str, bool]]:
    for path in sorted(folder.rglob("*")):
        inner = path.relative_to(folder)
        if path.is_file() and not any(part.startswith(".") for part in inner.parts):
            yield path, inner.as_posix(), False


def _own_name(names: tuple[str, ...], whole: Path, taken: set[str]) -> str:
    name = next((name for name in names if name not in taken), whole.as_posix())
    taken.add(name)
    return name
