"""Sources of captures that are loaded on demand, and the bundled examples."""

from __future__ import annotations

import hashlib
import re
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Self, TypeAlias
from unicodedata import category, normalize

from cucumbervision.capture.camera_file import CameraFile
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.intrinsics import DepthAlong, Stream
from cucumbervision.errors import CaptureError
from cucumbervision.files import as_path

CaptureEntry: TypeAlias = tuple[
    str, int, Callable[[str], Capture], Path, Callable[[], Iterable[Path | bytes]] | None
]
CaptureLister: TypeAlias = Callable[["ReadOptions", CameraFile | None], Iterable[CaptureEntry]]


@dataclass(frozen=True)
class ReadOptions:
    """Options for reading a source.

    Parameters
    ----------
    intrinsics : Path, optional
        Intrinsics file that replaces the intrinsics of the source if it passes the check; required
        if the source has none.
    depth : Path, optional
        Depth image, for a pair given as two files.
    depth_unit_m : float, optional
        Metres per depth step; by default that of the source, otherwise 0.001 for integers and 1 for
        floats.
    depth_along : DepthAlong, optional
        Whether depth is along the optical axis, or along each pixel's ray; by default as the
        camera file states, otherwise along the axis.
    aligned_to : Stream, optional
        The camera whose pixels both images have: 'depth' for colour that was aligned to depth;
        'color' for depth that may have fewer pixels than colour, over the same field of view. By
        default as the camera file states, otherwise depth aligned to colour at its size.
    burst : int
        Number of frames per capture, for recordings.

    Examples
    --------
    >>> ReadOptions(burst=0)
    Traceback (most recent call last):
    ...
    ValueError: burst is 0 and depth_unit_m is None; both must be positive
    """

    intrinsics: Path | None = None
    depth: Path | None = None
    depth_unit_m: float | None = None
    burst: int = 5
    depth_along: DepthAlong | None = None
    aligned_to: Stream | None = None

    def with_camera(self, camera: CameraFile | None) -> ReadOptions:
        """Return the options, completed by what a camera file states."""
        names = ("depth_unit_m", "depth_along", "aligned_to") if camera else ()
        stated = {name: getattr(self, name) or getattr(camera, name) for name in names}
        return replace(self, **stated)

    def __post_init__(self) -> None:
        for name in ("intrinsics", "depth"):
            if isinstance(place := getattr(self, name), str):
                object.__setattr__(self, name, as_path(place))
        if self.burst < 1 or (self.depth_unit_m is not None and not self.depth_unit_m > 0):
            raise ValueError(
                f"burst is {self.burst} and depth_unit_m is {self.depth_unit_m}; "
                "both must be positive"
            )


# Files that macOS, Windows and network storage add: copies of attributes, thumbnails.
_SYSTEM_NAMES = frozenset(
    {*("__MACOSX", ".DS_Store", ".Spotlight-V100", ".Trashes"), *("@eaDir", "Thumbs.db")}
)


@dataclass
class Folder:
    """Names of the files below a path that no reader has used yet.

    Parameters
    ----------
    path : Path
        The folder.
    files : dict of str to list of str
        Names by folder relative to `path`; '' is the path itself.
    faults : list of CaptureError
        Errors of unreadable folders.

    Examples
    --------
    >>> folder = Folder(Path("set"))
    >>> for name in ("1/capture.json", "1/color.png", "1/mask_visib/a.png", "rgb.png"):
    ...     folder.add(name)
    >>> folder.take("capture.json", "", "mask_visib")
    {'1': {'': ['color.png'], 'mask_visib': ['a.png']}}
    >>> list(folder), folder.kinds()
    (['rgb.png'], '1 .png')
    """

    path: Path
    files: dict[str, list[str]] = field(default_factory=dict)
    faults: list[CaptureError] = field(default_factory=list)

    def add(self, name: str) -> None:
        """Add a file by its name relative to the path, unless it is a system file.

        Examples
        --------
        >>> folder = Folder(Path("stick"))
        >>> for name in ("a/color_1.png", "a/._color_1.png", "__MACOSX/a/color_1.png"):
        ...     folder.add(name)
        >>> list(folder)
        ['a/color_1.png']
        """
        if any(part.startswith("._") or part in _SYSTEM_NAMES for part in name.split("/")):
            return
        folder, _, file_name = name.rpartition("/")
        self.files.setdefault(folder, []).append(file_name)

    def take(self, head: str, *inside: str) -> dict[str, dict[str, list[str]]]:
        """Remove and return all files `head`, with the files of the subfolders `inside`."""
        folders = [folder for folder, names in self.files.items() if head in names]
        for folder in folders:
            self.files[folder].remove(head)
        return {
            folder: {sub: self.files.pop(f"{folder}/{sub}".strip("/"), []) for sub in inside}
            for folder in folders
        }

    def kinds(self) -> str:
        """Return the number of files of the most frequent types as text."""
        counts = Counter(Path(name).suffix.lower() or "other" for name in self)
        return ", ".join(f"{n} {kind}" for kind, n in counts.most_common(5)) or "no file"

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names relative to the path."""
        return (
            f"{folder}/{file_name}".lstrip("/")
            for folder, names in self.files.items()
            for file_name in names
        )


@dataclass(frozen=True)
class CaptureRef:
    """A capture of a source that is loaded on demand.

    Parameters
    ----------
    name : str
        Name, unique within the source and valid in file names.
    frame : int
        Number in the source: BOP image id, recording frame.
    load : callable
        Loads the capture; raises a `CucumberVisionError` if it is broken.
    location : str
        Canonical location of the capture, empty if there is none.
    parts : callable, optional
        Lists the files and bytes of the capture, for hashing without decoding; None if unknown
        without loading.
    input : str
        The input of a run that contains it, as the user gave it.
    """

    name: str
    frame: int
    load: Callable[[], Capture] = field(repr=False)
    location: str = ""
    parts: Callable[[], Iterable[Path | bytes]] | None = field(default=None, repr=False)
    input: str = ""

    @classmethod
    def of(cls, capture: Capture, **further_fields: Any) -> Self:
        """Return a capture that is in memory."""
        load, given = partial(_itself, capture), capture.source or capture.name
        number, source = capture.frame or 0, capture.source
        return cls(capture.name, number, load, source, input=given, **further_fields)


def _itself(capture: Capture) -> Capture:
    return capture


@dataclass(frozen=True)
class CaptureSource:
    """A source of captures.

    Parameters
    ----------
    path : Path
        Path given by the user.
    kind : str
        Format: 'native', 'bop', 'viewer', 'pair' or 'recording'.
    refs : callable
        Returns an iterator over the captures.
    total : int, optional
        Number of captures, for a progress bar; None if unknown without reading.
    unused : tuple of str
        Images that are colour or depth by their names and belong to no capture.

    Examples
    --------
    >>> source = CaptureSource("here", "native", lambda: iter(()), total=0)
    >>> list(source), source.total
    ([], 0)
    """

    path: Path
    kind: str
    refs: Callable[[], Iterator[CaptureRef]] = field(repr=False)
    total: int | None = None
    unused: tuple[str, ...] = ()

    def __iter__(self) -> Iterator[CaptureRef]:
        """Iterate over the captures in the order of the source."""
        return self.refs()

    @classmethod
    def listed(cls, path: Path, kind: str, parts: Iterable[CaptureEntry]) -> CaptureSource:
        """Create a source of captures that are known in advance.

        Parameters
        ----------
        path : Path
            Path given by the user.
        kind : str
            Format.
        parts : iterable of (str, int, callable, Path, callable)
            Name (made valid and unique), frame, loader that takes the name, location and parts of
            each capture; see `CaptureRef`.

        Examples
        --------
        >>> parts = [("a b", 1, print, "a b.png", None), ("A_b", 2, print, "A_b.png", None)]
        >>> [ref.name for ref in CaptureSource.listed("here", "native", parts)]
        ['a_b', 'A_b-2']
        """
        refs, taken = [], set[str]()
        for text, frame, load, address, files in parts:
            name = unique_name(safe_name(text), taken)
            refs.append(CaptureRef(name, frame, partial(load, name), str(address), files))
        return cls(path, kind, lambda: iter(refs), len(refs))


def fail(error: Exception, name: str = "") -> Capture:  # noqa: ARG001 - called as any loader
    """Raise an error; the loader of a capture that was found to be unreadable when listed."""
    raise error


_LONGEST_NAME = 200  # bytes; leaves space for a number and a suffix
_DEVICE = re.compile(r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9¹²³]) *(\.|$)", re.IGNORECASE)


def no_device(name: str) -> str:
    """Return a file name that is not a device on Windows, where `nul.png` discards all data.

    Examples
    --------
    >>> no_device("nul.png"), no_device("Com1"), no_device("console.png")
    ('_nul.png', '_Com1', 'console.png')
    """
    return f"_{name}" if _DEVICE.match(name) else name


def safe_name(text: str) -> str:
    """Return a name that is valid in file names on every system; keeps letters of any script.

    Examples
    --------
    >>> safe_name("row 3/left:2"), safe_name("Reihe süd/黄瓜")
    ('row_3_left_2', 'Reihe_süd_黄瓜')

    File systems take 255 bytes; a longer name keeps its beginning and gets a hash of the whole, so
    that two of them stay two:

    >>> len(safe_name("x" * 300)), safe_name("x" * 300) == safe_name("x" * 301)
    (200, False)
    """
    # Keep combining marks, which are vowels in Hindi.
    letters = (
        c if c.isalnum() or c in ".-" or category(c)[0] == "M" else "_"
        for c in normalize("NFC", text)
    )
    name = no_device("".join(letters).strip(".") or "capture")
    if len(name.encode()) <= _LONGEST_NAME:
        return name
    digest = hashlib.sha256(text.encode(errors="surrogatepass")).hexdigest()[:16]
    beginning = name.encode()[: _LONGEST_NAME - 17].decode(errors="ignore")
    return f"{beginning}-{digest}"


def unique_name(name: str, taken: set[str]) -> str:
    """Return a unique name by appending a number if necessary, and add it to `taken`.

    Case-insensitive, because some file systems are.

    Examples
    --------
    >>> taken = {"a"}
    >>> unique_name("A", taken), sorted(taken)
    ('A-2', ['a', 'a-2'])
    """

    def numbered(number: int) -> str:
        return name if number == 1 else f"{name}-{number}"

    # Thousands of captures may have one name: the search for a free number takes few steps.
    high = 1
    while numbered(high).casefold() in taken:
        high *= 2
    numbers = range(high + 1)
    free = bisect_left(
        numbers, True, high // 2 + 1, high, key=lambda n: numbered(n).casefold() not in taken
    )
    taken.add(numbered(free).casefold())
    return numbered(free)


def example_captures() -> Path:
    """Return the folder of the bundled captures.

    Examples
    --------
    >>> sorted(p.name for p in example_captures().iterdir())
    ['simulated-bench', 'simulated-row-a', 'simulated-row-b']
    """
    return Path(__file__).with_name("bundled_captures")
