"""List the captures of a run's inputs: each once, in order, with a unique name."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, TypeAlias

from cucumbervision.capture.readers import open_source
from cucumbervision.capture.source import CaptureRef, unique_name
from cucumbervision.errors import InstancesError
from cucumbervision.files import is_remote
from cucumbervision.plugins import plugins
from cucumbervision.run.measurer import Boundary, Failure
from cucumbervision.run.options import INSTANCE_SOURCES

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from cucumbervision.capture.frames import Capture
    from cucumbervision.capture.source import CaptureSource, ReadOptions
    from cucumbervision.fruit.label_files import InstanceFile

_log = logging.getLogger(__name__)
_LONGEST_LIST = 300

Opener: TypeAlias = Callable[[Path, "ReadOptions"], "CaptureSource"]


@dataclass(frozen=True)
class Listed:
    """A capture of an input, not read yet.

    Parameters
    ----------
    input : str
        The input as the user gave it.
    ref : CaptureRef
        The capture.
    name : str
        Name in tables and pictures, unique within a run.
    """

    input: str
    ref: CaptureRef
    name: str

    @classmethod
    def of(cls, capture: Capture) -> Listed:
        """Return a capture that is in memory."""
        ref = CaptureRef(capture.name, capture.frame or 0, partial(_itself, capture))
        return cls(capture.source or capture.name, ref, capture.name)

    def portable(self) -> Listed:
        """Return a copy that another process can read.

        A capture without files, such as a frame of a recording, is read here.

        Raises
        ------
        CucumberVisionError
            If it cannot be read.
        """
        if self.ref.parts is not None:
            return self
        return replace(self, ref=replace(self.ref, load=partial(_itself, self.ref.load())))


def _itself(capture: Capture) -> Capture:
    return capture


def list_captures(
    inputs: Iterable[Path], reading: ReadOptions, opener: Opener = open_source
) -> Iterator[Listed | Failure]:
    """List the captures of all inputs; each input is opened when it is reached.

    Parameters
    ----------
    inputs : iterable of Path
        Folders and files that `open_source` can read.
    reading : ReadOptions
        Reading options.
    opener : callable
        Opens each input.

    Yields
    ------
    Listed or Failure
        A capture, or the failure of one or of a whole input.
    """
    for path in inputs:
        yield from list_source(str(path), partial(opener, path, reading))


def list_source(name: str, opener: Callable[[], CaptureSource]) -> Iterator[Listed | Failure]:
    """List the captures of one source, as `list_captures`; `name` is used in failures."""
    failures: list[Failure] = []
    refs = None
    with Boundary(failures, name):
        source = opener()
        if unused := source.unused:
            names = shorten(", ".join(unused), _LONGEST_LIST, placeholder=" …")
            _log.warning("%s: %d pictures belong to no capture: %s", name, len(unused), names)
        refs = iter(source)
    while refs is not None:
        ref = None
        with Boundary(failures, name):
            ref = next(refs, None)
        if ref is None:  # end of the source, or a failure of the source itself
            break
        yield Listed(name, ref, ref.name)
    yield from failures


def read_captures(
    inputs: Iterable[Path], reading: ReadOptions, opener: Opener = open_source
) -> Iterator[Capture | Failure]:
    """Read the captures of all inputs one after the other; a repeated input is read once.

    Parameters
    ----------
    inputs, reading, opener
        As for `list_captures`.

    Yields
    ------
    Capture or Failure
        A capture, or the failure of one or of a whole input.
    """
    for listed in list_captures(distinct(inputs, _log.warning), reading, opener):
        if isinstance(listed, Failure):
            yield listed
            continue
        failures: list[Failure] = []
        with Boundary(failures, listed.input, listed.name):
            yield listed.ref.load()
        yield from failures


def each_once(
    listed: Iterable[Listed | Failure], say: Callable[[str], None]
) -> Iterator[Listed | Failure]:
    """Yield every capture once, with a unique name.

    A capture that cannot be read also reserves its name, so that the names of the others do not
    change when it is repaired.

    Parameters
    ----------
    listed : iterable of Listed or Failure
        Result of `list_captures`.
    say : callable
        Called with a line at the end of an input that repeats earlier captures.
    """
    names, places = set[str](), set[str]()
    repeats, current = 0, ""
    for entry in listed:
        if entry.input != current:
            _say_again(current, repeats, say)
            repeats, current = 0, entry.input
        if isinstance(entry, Failure):
            yield entry
            continue
        place = (
            entry.ref.location
            if "://" in entry.ref.location
            else os.path.realpath(entry.ref.location)
        )
        if entry.ref.location and place in places:
            repeats += 1
            continue
        places.add(place)
        yield Listed(entry.input, entry.ref, unique_name(entry.name, names))
    _say_again(current, repeats, say)


def _say_again(path: str, captures: int, say: Callable[[str], None]) -> None:
    if captures:
        what = "1 capture was" if captures == 1 else f"{captures} captures were"
        say(f"{path}: {what} given before, and measured once")


def distinct(inputs: Iterable[Path], say: Callable[[str], None]) -> list[Path]:
    """Return the inputs without repeated places; `say` is called for each repetition."""
    places: set[str] = set()
    unique_inputs: list[Path] = []
    for path in inputs:
        place = str(path) if is_remote(path) else os.path.realpath(path)
        if place in places:
            say(f"{path} is given twice: it is measured once")
        else:
            places.add(place)
            unique_inputs.append(path)
    return unique_inputs


def count_captures(
    inputs: Sequence[Path], reading: ReadOptions, opener: Opener = open_source
) -> int | None:
    """Return the number of captures in the inputs; None if it is known only after reading."""
    total = 0
    for path in distinct(inputs, lambda _: None):
        source = None
        with Boundary([], str(path)):
            source = opener(path, reading)
        if source is not None and source.total is None:
            return None
        # An input that cannot be opened counts as one step.
        total += 1 if source is None else source.total or 0
    return total


def label_file(instances: str) -> InstanceFile | None:
    """Return the file that `MeasureOptions.instances` names; None for other sources of fruit.

    Raises
    ------
    InstancesError
        If it cannot be read.
    """
    if (
        instances in INSTANCE_SOURCES
        or instances in plugins("detectors")
        or Path(instances).suffix.lower() == ".onnx"
    ):
        return None
    from cucumbervision.fruit.label_files import read_instances

    return read_instances(instances)


def labelled_once(
    file: InstanceFile | None, items: Iterable[Listed | Failure]
) -> Iterator[Listed | Failure]:
    """Yield items; a capture whose entry in the file an earlier one has becomes a failure."""
    used = dict[int, str]()
    for item in items:
        if file is None or isinstance(item, Failure):
            yield item
            continue
        entry = None
        with suppress(InstancesError):  # measuring the capture raises the error
            place = item.ref.location.removesuffix("/capture.json")
            entry = file.find((item.name, place), item.ref.frame)
        if entry is None or used.setdefault(id(entry), item.name) == item.name:
            yield item
            continue
        error = InstancesError(
            f"names {entry.name or entry.number} once, which both {used[id(entry)]} and "
            f"{item.name} are: only the first was measured, maybe with the other's fruit",
            source=file.source,
            remedy="name the pictures with their folders, and measure again",
        )
        yield Failure.of(error, item.input, item.name)


def instance_notes(
    file: InstanceFile, captures: Sequence[tuple[Sequence[str], int | None]]
) -> list[str]:
    """Return notes on captures and on pictures of a file without a counterpart.

    Parameters
    ----------
    file : InstanceFile
        The file.
    captures : sequence of (sequence of str, int or None)
        Names and frame number of each capture, as for `InstanceFile.for_capture`.

    Raises
    ------
    InstancesError
        If the file names none of the captures.
    """
    missing, unused = file.coverage(captures)
    if missing and len(missing) == len(captures):
        raise InstancesError(
            f"names none of the captures ({_shortened(missing)}); it names {_shortened(unused)}",
            source=file.source,
            remedy="name its pictures as the captures are called",
        )
    notes = [f"{file.source}: no fruit given for {', '.join(missing)}"] if missing else []
    if unused and captures:
        notes.append(f"{file.source}: no capture is called {', '.join(unused)}")
    if file.crowds:
        notes.append(
            f"{file.source}: {file.crowds} crowd regions, of several fruit each, are left out"
        )
    return notes


def _shortened(names: Sequence[str], most_names: int = 5) -> str:
    remainder = f" and {len(names) - most_names} more" if len(names) > most_names else ""
    return f"{', '.join(names[:most_names])}{remainder}"
