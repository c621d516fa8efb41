"""What was accepted of an upload, and the files that are still to be sorted into captures."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from cucumbervision.capture.source import (
    CaptureRef,
    CaptureSource,
    ReadOptions,
    safe_name,
    unique_name,
)
from cucumbervision.errors import CaptureError, CucumberVisionError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from cucumbervision.capture.frames import Capture
    from cucumbervision.intake.file_checks import Item
    from cucumbervision.intake.limits import Limits

_LONGEST = 60
_INTRINSICS = "intrinsics.json"


@dataclass(frozen=True)
class Refused:
    """A file that was not accepted: its sender's name for it, and the named error."""

    name: str
    error: CucumberVisionError


@dataclass(frozen=True)
class AcceptedSource:
    """Captures of an upload, laid out for `capture.readers.open_source`.

    Parameters
    ----------
    path : Path
        The folder or file; every name below it is our own.
    kind : str
        'native', 'bop', 'viewer', 'pair' or 'recording'.
    title : str
        The upload that it came in, by its sender's name.
    files : tuple of str
        What it was made of, by the sender's names.
    names : mapping of str to str
        The sender's name of each capture, by our own.
    titles : mapping of Path to str
        The sender's name of each file.
    intrinsics : Path, optional
        Intrinsics that came with it.
    """

    path: Path
    kind: str
    title: str
    files: tuple[str, ...]
    names: Mapping[str, str] = field(default_factory=dict)
    titles: Mapping[Path, str] = field(default_factory=dict)
    intrinsics: Path | None = None

    def open(self, options: ReadOptions | None = None) -> CaptureSource:
        """Return the captures; they and their errors have the sender's names.

        Parameters
        ----------
        options : ReadOptions, optional
            As for `open_source`; intrinsics that came along are used where it names none.

        Raises
        ------
        CucumberVisionError
            As `open_source`.
        """
        from cucumbervision.capture.readers import open_source

        options = options or ReadOptions()
        if options.intrinsics is None and self.intrinsics is not None:
            options = replace(options, intrinsics=self.intrinsics)
        if self.kind == "recording":  # its depth has the recording's own unit
            options = replace(options, depth_unit_m=None)
        try:
            source = open_source(self.path, options)
        except CucumberVisionError as error:
            raise self._renamed(error, self.title) from None
        return replace(source, refs=lambda: self._refs(source))

    def _refs(self, source: CaptureSource) -> Iterator[CaptureRef]:
        taken: set[str] = set()
        for ref in source:
            name = unique_name(shown_name(self.names.get(ref.name, ref.name)), taken)
            yield CaptureRef(name, ref.frame, self._loader(ref, name))

    def _loader(self, ref: CaptureRef, name: str) -> Callable[[], Capture]:
        shown = f"{self.title}: {self.names.get(ref.name, ref.name)}"

        def load() -> Capture:
            try:
                return replace(ref.load(), name=name, source=shown)
            except CucumberVisionError as error:
                raise self._renamed(error, shown) from None

        return load

    def _renamed(self, error: CucumberVisionError, shown: str) -> CucumberVisionError:
        """Return the error with the sender's name in place of our path."""
        return error.at(self.titles.get(Path(error.source), shown))


@dataclass(frozen=True)
class AcceptedUploads:
    """The outcome of an upload.

    Parameters
    ----------
    folder : Path
        Where all of it lies; does not exist if nothing was accepted.
    sources : list of AcceptedSource
        What can be measured.
    refused : list of Refused
        What cannot, each with its error.
    ignored : list of str
        What is not needed.
    """

    folder: Path
    sources: list[AcceptedSource] = field(default_factory=list)
    refused: list[Refused] = field(default_factory=list)
    ignored: list[str] = field(default_factory=list)

    def refuse(self, title: str, error: CucumberVisionError) -> None:
        """Note a file that is not accepted."""
        self.refused.append(Refused(title, error))


def shown_name(text: str) -> str:
    """Return a capture's name made of its sender's: fit for file names, not too long.

    Examples
    --------
    >>> shown_name("row 3/left rgb")
    'row_3_left_rgb'
    """
    return safe_name(text)[:_LONGEST].strip("._") or "capture"


class Staging:
    """The files of one zip or batch that belong to no capture yet.

    Parameters
    ----------
    title : str
        Name of the zip or batch.
    items : iterable of Item
        Its files; of two with one name the first stays.
    folder : Path
        Where sources are laid out.
    limits : Limits
        How many pixels one capture may have.
    out : Sorted
        Where results are noted.
    is_archive : bool
        Whether it is a zip, in which files beside captures are nothing unusual.
    """

    def __init__(
        self,
        title: str,
        items: Iterable[Item],
        folder: Path,
        limits: Limits,
        out: AcceptedUploads,
        *,
        is_archive: bool = False,
    ) -> None:
        self.is_archive = is_archive
        self.title, self.folder, self.limits, self.out = title, folder, limits, out
        self.left: dict[PurePosixPath, Item] = {}
        for item in items:
            if item.name in self.left:
                twice = "was sent twice", "send it once, or rename it"
                out.refuse(item.title, CaptureError(twice[0], source=item.title, remedy=twice[1]))
            else:
                self.left[item.name] = item

    def take(self, name: PurePosixPath) -> Item | None:
        """Remove a file and return it, so that nothing else uses it; None if it is not there."""
        return self.left.pop(name, None)

    def inside(self, folder: PurePosixPath) -> list[Item]:
        """Return what is left directly in a folder, by name."""
        return [self.left[name] for name in sorted(self.left) if name.parent == folder]

    def refuse(self, item: Item, error: CucumberVisionError) -> None:
        """Remove a file and note why it is not accepted."""
        self.left.pop(item.name, None)
        self.out.refuse(item.title, error)

    def ignore(self, names: Iterable[PurePosixPath]) -> None:
        """Remove files that are not needed."""
        for name in list(names):
            self.out.ignored.append(self.left.pop(name).title)

    def intrinsics_for(self, name: PurePosixPath) -> Item | None:
        """Return the intrinsics file that is nearest to a file: in its folder, or above."""
        found = [item for item in self.left.values() if is_intrinsics(item.document)]
        for folder in name.parents:
            here = sorted((i for i in found if i.name.parent == folder), key=lambda i: i.name)
            named = [i for i in here if i.name.name.lower() == _INTRINSICS]
            if here:
                return (named or here)[0]
        return None


class Layout:
    """A source on its way: files of the staging moved into a new folder, under names of our own.

    Parameters
    ----------
    staging : Staging
        Where its files come from.
    kind : str
        As in `AcceptedSource`.
    """

    def __init__(self, staging: Staging, kind: str) -> None:
        self.staging, self.kind = staging, kind
        self.folder = staging.folder / f"{len(list(staging.folder.iterdir())):02d}-{kind}"
        self.folder.mkdir()
        self.names: dict[str, str] = {}
        self.titles: dict[Path, str] = {}
        self.files: list[str] = []
        self.intrinsics: Path | None = None

    def move(self, item: Item, name: str) -> Path:
        """Move a file to its place in the folder, and take it from the staging."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        item.path.rename(path)
        self._note(item, path)
        return path

    def write(self, item: Item, name: str, document: Any) -> Path:
        """Write a document read from a sender's file as a file of our own."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(document, indent=1), encoding="utf-8")
        self._note(item, path)
        return path

    def write_intrinsics(self, item: Item | None) -> None:
        """Write the intrinsics that came with the files; they stay for others in the staging."""
        if item is not None:
            self.intrinsics = self.write(item, _INTRINSICS, item.document)
            self.staging.left[item.name] = item

    def accept(self, path: Path | None = None, title: str = "") -> None:
        """Note the source as accepted; `path` where it is not the whole folder.

        Its title is the zip's or batch's unless another is given.
        """
        self.staging.out.sources.append(
            AcceptedSource(
                path or self.folder,
                self.kind,
                title or self.staging.title,
                tuple(self.files),
                self.names,
                self.titles,
                self.intrinsics,
            )
        )

    def _note(self, item: Item, path: Path) -> None:
        self.titles[path] = item.title
        self.files.append(item.title)
        self.staging.take(item.name)


def is_intrinsics(document: Any) -> bool:
    """Return whether a JSON document looks like an intrinsics file.

    Examples
    --------
    >>> is_intrinsics({"stream": "color", "fx": 900.0}), is_intrinsics({"0": {"cam_K": []}})
    (True, False)
    """
    return isinstance(document, dict) and ("fx" in document or "matrix" in document)
