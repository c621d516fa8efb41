"""The table of plug-ins: the package's own, and those that installed packages add by entry points.

A package adds a detector, segmenter, method, reader or trait by an entry point in the group
`cucumbervision.detectors`, `.segmenters`, `.methods`, `.readers` or `.traits`. The package's own
are loaded by the same lines of code. A class is called without arguments; anything else is used as
it is. Nothing is imported before it is used.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import (
    EntryPoints,
    PackageNotFoundError,
    entry_points,
    packages_distributions,
    version,
)
from pkgutil import resolve_name
from threading import RLock
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias, TypeVar, cast

from cucumbervision._version import __version__
from cucumbervision.errors import CucumberVisionError, PluginError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cucumbervision.arrays import Pixels
    from cucumbervision.capture.frames import Capture
    from cucumbervision.capture.source import CaptureLister, Folder
    from cucumbervision.fruit.instance import Instance


Kind: TypeAlias = Literal["detectors", "segmenters", "methods", "readers", "traits"]
T = TypeVar("T")

PACKAGE = "cucumbervision"

_OWN: Mapping[Kind, Mapping[str, str]] = {
    "methods": {f"M{k}": f"cucumbervision.methods.paper_methods:M{k}" for k in range(1, 6)}
    | {"M6": "cucumbervision.methods.m6:METHOD"},
    "readers": {
        "native": "cucumbervision.capture.readers.native:find_native",
        "bop": "cucumbervision.capture.readers.bop:find_scenes",
        "viewer": "cucumbervision.capture.readers.viewer:find_snapshots",
        "pair": "cucumbervision.capture.readers.pair:find_pairs",
    },
    "traits": {"skin_yellow_share": "cucumbervision.methods.traits:skin_yellow_share"},
}
"""The package's own, by name: a new one is a file, and a line here. (Networks: `models.toml`.)"""


@dataclass(frozen=True)
class Plugin:
    """One line of the table.

    Parameters
    ----------
    kind : str
        'detectors', 'segmenters', 'methods', 'readers' or 'traits'.
    name : str
        Its name in options, columns and files.
    value : str
        Where it is: 'module:attribute'.
    package, version : str
        The distribution that holds it; the version is empty where none is known.
    """

    kind: Kind
    name: str
    value: str
    package: str = PACKAGE
    version: str = __version__

    @classmethod
    def of(cls, kind: Kind, part: Any, name: str = "") -> Plugin:
        """Return the line of an object that a program passes in Python."""
        plain = part if hasattr(part, "__qualname__") else type(part)
        package = str(plain.__module__).partition(".")[0]
        value = f"{plain.__module__}:{plain.__qualname__}"
        name = name or plain.__qualname__
        if package == PACKAGE:
            return cls(kind, name, value)
        # A distribution may have another name than what is imported of it.
        package = next(iter(packages_distributions().get(package, ())), package)
        try:
            return cls(kind, name, value, package, version(package))
        except PackageNotFoundError:
            return cls(kind, name, value, package, "")

    @property
    def is_own(self) -> bool:
        """Whether the plug-in is part of the package `cucumbervision` itself."""
        return self.package == PACKAGE

    def as_json(self) -> dict[str, str]:
        """Return its description in files."""
        described = {"kind": self.kind.removesuffix("s"), "name": self.name}
        return described | {"package": self.package, "version": self.version, "object": self.value}

    def load(self) -> Any:
        """Return the named object, loaded once.

        Raises
        ------
        PluginError
            If it cannot be imported, or created.
        """
        return _loaded(self)

    def error(self, fault: str, remedy: str = "") -> PluginError:
        """Return an error that names the plug-in and its package."""
        return PluginError(
            f"the {self.kind.removesuffix('s')} {self.name} {fault}",
            source=f"{self.package} {self.version}".strip(),
            remedy=remedy or "mend the package, or uninstall it",
        )

    def call(self, function: Callable[..., T], *arguments: Any) -> T:
        """Call a function of the plug-in.

        Raises
        ------
        PluginError
            Instead of an exception of another package's plug-in. What the package itself raises is
            a defect, or has a name; so has a `CucumberVisionError` of a detector or reader.
        """
        # A detector or reader may say what is wrong with its input.
        says = CucumberVisionError if self.kind in ("detectors", "readers") else PluginError
        try:
            with nullcontext() if self.is_own else _ONE_CALL:
                return function(*arguments)
        except (Exception, SystemExit) as error:
            if self.is_own or isinstance(error, says):
                raise
            raise self.error(f"failed ({type(error).__name__}: {error})") from error


# Captures are measured two at once, and another package's part may hold one at a time.
_ONE_CALL = RLock()


@lru_cache
def _loaded(plugin: Plugin) -> Any:
    try:
        part = resolve_name(plugin.value)
        return part() if isinstance(part, type) else part
    except (Exception, SystemExit) as error:
        if plugin.is_own:
            raise
        raise plugin.error(f"cannot be loaded ({type(error).__name__}: {error})") from error


# Python 3.11 has another class for all of them, which selects alike.
_installed: Any = lru_cache(maxsize=1)(entry_points)


def installed(group: str) -> EntryPoints:
    """Return the entry points of a group; the installed packages are searched once for all."""
    return cast("EntryPoints", _installed().select(group=group))


def plugins(kind: Kind) -> dict[str, Plugin]:
    """Return the table of one kind by name, the package's own first.

    A name that is taken, by this package or by one before it in the alphabet, is left out, and is
    among the `faults`.

    Examples
    --------
    >>> list(plugins("methods"))[:6]
    ['M1', 'M2', 'M3', 'M4', 'M5', 'M6']
    >>> plugins("traits")["skin_yellow_share"].package
    'cucumbervision'
    """
    return _table(kind)[0]


def own(kind: Kind) -> dict[str, Plugin]:
    """Return the package's own of one kind; no installed package is looked at."""
    return {name: Plugin(kind, name, value) for name, value in _OWN.get(kind, {}).items()}


def faults(kind: Kind) -> tuple[PluginError, ...]:
    """Return why entry points of one kind were left out."""
    return _table(kind)[1]


@lru_cache
def _table(kind: Kind) -> tuple[dict[str, Plugin], tuple[PluginError, ...]]:
    table = own(kind)
    taken = {name.casefold() for name in table}
    left_out = []
    added = []
    for point in installed(f"{PACKAGE}.{kind}"):
        names = (point.dist.name, point.dist.version) if point.dist else ("", "")
        added.append(Plugin(kind, point.name, point.value, *names))
    for plugin in sorted(added, key=lambda plugin: (plugin.name, plugin.package)):
        if plugin.name.casefold() in taken:
            left_out.append(plugin.error("has a name that is taken, and is left out"))
            continue
        taken.add(plugin.name.casefold())
        table[plugin.name] = plugin
    return table, tuple(left_out)


def forget() -> None:
    """Look for installed packages again: one was installed while the program runs."""
    for memory in (_installed, _table, _loaded):
        memory.cache_clear()


class Detector(Protocol):
    """Finds the fruit of a capture: a function, or an object that can be called."""

    def __call__(self, capture: Capture, /) -> Sequence[Instance]:
        """Return the fruit of a capture.

        Parameters
        ----------
        capture : Capture
            `color` is uint8, shape (H, W, 3), red first; `depth_m` float32, shape (H, W), metres,
            0 where nothing was read.

        Returns
        -------
        sequence of Instance
            Each with its box: edges x1, y1, x2, y2 in pixels, where pixel (0, 0) is the centre of
            the upper left one. Masks are bool, shape (H, W); an instance without one is segmented.
        """
        ...


class Segmenter(Protocol):
    """Draws the masks of fruit.

    One that people may also point with has a method `mask_at(color_rgb, u_px, v_px)`, which
    returns the mask of the object at a pixel, bool, shape (H, W).
    """

    def segment(self, color_rgb: Pixels, instances: Sequence[Instance], /) -> Sequence[Instance]:
        """Return the instances with masks, in the same order.

        Parameters
        ----------
        color_rgb : ndarray of uint8, shape (H, W, 3)
            The image, red first.
        instances : sequence of Instance
            The fruit, by their boxes.

        Returns
        -------
        sequence of Instance
            With `mask`, bool, shape (H, W); or with None and the reason as `mask_failure`.
        """
        ...


class Reader(Protocol):
    """Finds captures of one format in a folder."""

    def __call__(self, folder: Folder, /) -> CaptureLister | None:
        """Take the format's files out of a folder, and return what opens them.

        Parameters
        ----------
        folder : Folder
            Names of the files that no reader has taken yet; `take` removes those of this format.

        Returns
        -------
        callable or None
            Called with `ReadOptions` and the given intrinsics; returns for each capture its name,
            number, loader, place and files. None where the folder holds none of the format.
        """
        ...
