"""What every reader gives: captures by name, each loaded on demand; where the bundled ones are."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING
from unicodedata import category

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from typing import TypeAlias

    from cucumbervision.capture.camera_file import CameraFile
    from cucumbervision.capture.frames import Capture
    from cucumbervision.errors import CaptureError

    Listed: TypeAlias = tuple[
        str, int, Callable[[str], Capture], Path, Callable[[], Iterable[Path | bytes]] | None
    ]
    Opener: TypeAlias = Callable[["ReadOptions", CameraFile | None], Iterable[Listed]]


@dataclass(frozen=True)
class ReadOptions:
    """What a user says about a source beyond its path.

    Parameters
    ----------
    intrinsics : Path, optional
        An intrinsics file, used in place of the source's own calibration once the guard has let
        it pass; needed where the source has none.
    depth : Path, optional
        The depth picture, for a pair given as two files.
    depth_unit_m : float, optional
        Metres of one depth step; by default what the source says, else 0.001 for whole numbers
        and 1 for floats.
    burst : int
        Frames fused to one capture, for recordings.

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

    def __post_init__(self) -> None:
        if self.burst < 1 or (self.depth_unit_m is not None and not self.depth_unit_m > 0):
            raise ValueError(
                f"burst is {self.burst} and depth_unit_m is {self.depth_unit_m}; "
                "both must be positive"
            )


@dataclass
class Folder:
    """The names of the files below a path that no reader has taken yet.

    Parameters
    ----------
    path : Path
        The folder.
    files : dict of str to list of str
        Names by the folder that they are in, relative to `path`; '' is the path itself.
    faults : list of CaptureError
        Folders that may not be read.

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
        """Add a file by its name relative to the path, with slashes."""
        at, _, own = name.rpartition("/")
        self.files.setdefault(at, []).append(own)

    def take(self, head: str, *inside: str) -> dict[str, dict[str, list[str]]]:
        """Take a file `head` wherever it is, with all files of the folders that are named in it."""
        found = [at for at, names in self.files.items() if head in names]
        for at in found:
            self.files[at].remove(head)
        return {
            at: {sub: self.files.pop(f"{at}/{sub}".strip("/"), []) for sub in inside}
            for at in found
        }

    def kinds(self) -> str:
        """Return how many files there are of the most frequent kinds, in words."""
        counts = Counter(Path(name).suffix.lower() or "other" for name in self)
        return ", ".join(f"{n} {kind}" for kind, n in counts.most_common(5)) or "no file"

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names relative to the path."""
        return (f"{at}/{own}".lstrip("/") for at, names in self.files.items() for own in names)


@dataclass(frozen=True)
class CaptureRef:
    """One capture of a source, not read yet.

    Parameters
    ----------
    name : str
        Unique within the source and fit for file names.
    frame : int
        The source's own number: BOP image id, recording frame.
    load : callable
        Reads the capture; raises a `CucumberVisionError` if this one is broken, which says
        nothing about the others.
    at : str
        Where it lies: the same for the same capture, however it was reached; empty where there is
        no such place.
    parts : callable, optional
        Lists what it is read from, files and bytes, so that its content can be hashed without
        reading pixels; None where only loading would tell.
    """

    name: str
    frame: int
    load: Callable[[], Capture] = field(repr=False)
    at: str = ""
    parts: Callable[[], Iterable[Path | bytes]] | None = field(default=None, repr=False)


@dataclass(frozen=True)
class CaptureSource:
    """A path that holds captures.

    Parameters
    ----------
    path : Path
        What the user named.
    kind : str
        The reader: 'native', 'bop', 'pair', 'viewer' or 'recording'.
    refs : callable
        Starts an iterator over the captures.
    total : int, optional
        How many there are, for a progress bar; None where only reading would tell.

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

    def __iter__(self) -> Iterator[CaptureRef]:
        """Iterate over the captures, in the source's order."""
        return self.refs()

    @classmethod
    def listed(cls, path: Path, kind: str, parts: Iterable[Listed]) -> CaptureSource:
        """Return the source of captures that are known beforehand.

        Parameters
        ----------
        path : Path
            What the user named.
        kind : str
            The reader.
        parts : iterable of (str, int, callable, Path, callable)
            Each capture's name, which is made fit and unique, its frame, what reads it when it is
            given that name, where it lies, and what it is read from, as in `CaptureRef`.

        Examples
        --------
        >>> parts = [("a b", 1, print, "a b.npz", None), ("A_b", 2, print, "A_b.npz", None)]
        >>> [ref.name for ref in CaptureSource.listed("here", "native", parts)]
        ['a_b', 'A_b-2']
        """
        refs, taken = [], set[str]()
        for text, frame, load, at, files in parts:
            name = unique_name(safe_name(text), taken)
            refs.append(CaptureRef(name, frame, partial(load, name), str(at), files))
        return cls(path, kind, lambda: iter(refs), len(refs))


def fail(error: Exception, name: str = "") -> Capture:  # noqa: ARG001 - called as any loader
    """Raise an error that was kept until its capture's turn."""
    raise error


_LONGEST_NAME = 200  # bytes; leaves room for a number and a suffix


def safe_name(text: str) -> str:
    """Make a name that is fit for a file name on every system: letters of any alphabet stay.

    Examples
    --------
    >>> safe_name("row 3/left:2"), safe_name("Reihe süd/黄瓜")
    ('row_3_left_2', 'Reihe_süd_黄瓜')

    File systems take 255 bytes; a longer name keeps its beginning and gets a hash of the whole, so
    that two of them stay two:

    >>> len(safe_name("x" * 300)), safe_name("x" * 300) == safe_name("x" * 301)
    (200, False)
    """
    # Marks belong to the letters before them: Hindi has half of its vowels as such.
    kept = (c if c.isalnum() or c in ".-" or category(c)[0] == "M" else "_" for c in text)
    name = re.sub("_+", "_", "".join(kept)).strip("._") or "capture"
    if len(name.encode()) <= _LONGEST_NAME:
        return name
    digest = hashlib.sha256(text.encode(errors="surrogatepass")).hexdigest()[:16]
    beginning = name.encode()[: _LONGEST_NAME - 17].decode(errors="ignore")
    return f"{beginning}-{digest}"


def unique_name(name: str, taken: set[str]) -> str:
    """Return a name with a number if it was there before, and take it.

    Letter case makes no difference: some systems have none in file names.

    Examples
    --------
    >>> taken = {"a"}
    >>> unique_name("A", taken), sorted(taken)
    ('A-2', ['a', 'a-2'])
    """
    candidate, n = name, 1
    while candidate.casefold() in taken:
        n += 1
        candidate = f"{name}-{n}"
    taken.add(candidate.casefold())
    return candidate


def example_captures() -> Path:
    """Return the folder of the captures that come with the package.

    Examples
    --------
    >>> sorted(p.name for p in example_captures().iterdir())
    ['simulated-bench', 'simulated-row-a', 'simulated-row-b']
    """
    return Path(__file__).with_name("bundled_captures")
