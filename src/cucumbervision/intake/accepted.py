"""What was accepted and what was not."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from cucumbervision.capture.source import (
    CaptureRef,
    CaptureSource,
    ReadOptions,
    safe_name,
    unique_name,
)
from cucumbervision.errors import CucumberVisionError, MissingExtraError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from cucumbervision.capture.frames import Capture

__all__ = ["AcceptedSource", "AcceptedUploads", "Refused", "shown_name"]

_LONGEST = 60


@dataclass(frozen=True)
class Refused:
    """A file that was not taken: what its sender calls it, and the named error."""

    name: str
    error: CucumberVisionError


@dataclass(frozen=True)
class AcceptedSource:
    """Captures that came in, laid out for `capture.readers.open_source`.

    Parameters
    ----------
    path : Path
        The folder or file; every name below it is our own.
    kind : str
        'native', 'bop', 'viewer', 'pair' or 'recording'.
    title : str
        The upload that it came in, as its sender calls it.
    files : tuple of str
        What it was made of, as its sender calls it.
    names : mapping of str to str
        What each of its captures was called by its sender, by its own name.
    titles : mapping of Path to str
        What each file was called.
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
        """Open the captures; they and their errors go by the sender's names.

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
            raise self._retold(error, self.title) from None
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
                raise self._retold(error, shown) from None

        return load

    def _retold(self, error: CucumberVisionError, shown: str) -> CucumberVisionError:
        """Give the error with the sender's name in place of our path."""
        if isinstance(error, MissingExtraError):
            return error
        title = self.titles.get(Path(error.source), shown)
        return type(error)(error.message, source=title, remedy=error.remedy)


@dataclass(frozen=True)
class AcceptedUploads:
    """What became of an upload.

    Parameters
    ----------
    folder : Path
        Where all of it lies; not there if nothing was accepted.
    sources : tuple of AcceptedSource
        What can be measured.
    refused : tuple of Refused
        What cannot, each with its error.
    ignored : tuple of str
        What is not needed.
    """

    folder: Path
    sources: tuple[AcceptedSource, ...] = ()
    refused: tuple[Refused, ...] = ()
    ignored: tuple[str, ...] = ()


def shown_name(text: str) -> str:
    """Make a capture's name of what its sender calls it: fit for file names, not too long.

    Examples
    --------
    >>> shown_name("row 3/left rgb")
    'row_3_left_rgb'
    """
    return safe_name(text)[:_LONGEST].strip("._") or "capture"
