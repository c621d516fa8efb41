"""Readers of captures, one per format, selected by file names."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from cucumbervision.capture.camera_file import CameraFile, read_camera_file
from cucumbervision.capture.frames import Capture
from cucumbervision.capture.readers.native import MANIFEST
from cucumbervision.capture.readers.pair import is_half_a_pair, open_pair_file, tum_lists
from cucumbervision.capture.readers.recording import open_recording
from cucumbervision.capture.source import CaptureEntry, CaptureLister, CaptureSource, Folder, fail
from cucumbervision.capture.source import CaptureRef as CaptureRef
from cucumbervision.capture.source import ReadOptions as ReadOptions
from cucumbervision.errors import CaptureError, PluginError, with_reason
from cucumbervision.files import as_path, is_remote, with_retries
from cucumbervision.plugins import Plugin, Reader, plugins

RECORDING_SUFFIXES = frozenset({".bag", ".db3"})

_RECORDS = {"records", "journal"}  # of a run; the latter until 0.1.0
_REMEDY = (
    "give a folder with capture.json, a BOP scene (scene_camera.json), colour and depth pictures "
    "named alike but for the words color and depth, or a .bag or .db3 recording"
)
_PLUG_IN = "convert it, or plug in a reader, as examples/plugins.py does for TUM sequences"


def open_source(
    path: Path | str, options: ReadOptions | None = None, readers: Sequence[Reader] = ()
) -> CaptureSource:
    """Open a source of captures.

    Parameters
    ----------
    path : Path or str
        A path, or a URL that `urls.as_path` knows: a folder in which a reader
        finds captures, one colour image with `options.depth`, or, on this machine, a `.bag` or
        `.db3` recording.
    options : ReadOptions, optional
        Intrinsics, depth image, depth unit and burst length.
    readers : sequence of Reader
        Readers of your own, which see a folder before those of the package. Installed ones of other
        packages see what the package's own readers leave.

    Returns
    -------
    CaptureSource
        The captures, read on demand; files that cannot be opened follow as failing captures.

    Raises
    ------
    CaptureError
        If the path is missing, has no known format, or cannot be read at all.
    """
    path = as_path(path)
    options = options or ReadOptions()
    return with_retries(path, lambda: _open(path, options, readers))


def _open(path: Path, options: ReadOptions, readers: Sequence[Reader]) -> CaptureSource:
    if not path.exists():
        raise CaptureError("does not exist", source=path, remedy="check the path")
    if path.is_file() and path.suffix.lower() in RECORDING_SUFFIXES:
        if is_remote(path):
            fault = "a recording is played from a file of this machine alone"
            raise CaptureError(fault, source=path, remedy="copy it here")
        return open_recording(path, options)
    if path.name == MANIFEST and path.is_file():
        path = path.parent
    if path.suffix.lower() == ".npz":
        raise _no_longer_read("an .npz file", path)
    # On a web server, the listing of a folder is also a file.
    if path.is_file() and (path.suffix or not is_remote(path)):
        return open_pair_file(path, options)
    if not is_remote(path) and not path.is_dir():
        fault, remedy = "is neither a file nor a folder", "name a file or a folder"
        raise CaptureError(fault, source=path, remedy=remedy)
    folder = list_folder(path)
    kinds = folder.kinds()
    openers = find_captures(folder, readers)
    folder.faults += [
        _no_longer_read("a TUM sequence", path / place / name)
        for place, name in tum_lists(folder).items()
    ]
    arrays = [name for name in folder if name.lower().endswith(".npz")]
    if arrays and not openers:
        folder.faults.append(_no_longer_read(f"{len(arrays)} .npz files", path))
    if not openers and not folder.faults:
        fault = "holds no captures that can be recognised, but {kinds}"
        raise CaptureError(fault, source=path, remedy=_REMEDY, kinds=kinds)
    camera = read_camera_file(options.intrinsics) if options.intrinsics else None
    parts: list[CaptureEntry] = []
    faults = folder.faults
    for opener in openers.values():
        try:
            parts += opener(options, camera)
        except CaptureError as error:
            faults.append(error)
    if faults and not parts:
        raise faults[0]
    parts += [(Path(f.source).name, -1, partial(fail, f), Path(f.source), None) for f in faults]
    unused = tuple(name for name in folder if is_half_a_pair(name))
    return replace(CaptureSource.listed(path, "+".join(openers), parts), unused=unused)


def _no_longer_read(what: str, source: Path) -> CaptureError:
    return CaptureError(f"{what}: not read any more", source=source, remedy=_PLUG_IN)


def find_captures(folder: Folder, readers: Sequence[Reader] = ()) -> dict[str, CaptureLister]:
    """Return the openers of a folder's captures by format; `folder` keeps the unused files.

    Each file is used by one reader only. A reader of another package that fails is among the
    folder's faults, and the others go on.
    """
    lines = [(Plugin.of("readers", reader), reader) for reader in readers]
    openers: dict[str, CaptureLister] = {}
    for plugin, reader in (*lines, *((line, None) for line in plugins("readers").values())):
        try:
            find = plugin.load() if reader is None else reader
            opener = plugin.call(find, folder)
        except PluginError as error:
            folder.faults.append(CaptureError(str(error), source=folder.path))
            continue
        if opener is not None:
            openers[plugin.name] = partial(_listed_by, plugin, opener)
    return openers


def _listed_by(
    plugin: Plugin, opener: CaptureLister, options: ReadOptions, camera: CameraFile | None
) -> list[CaptureEntry]:
    try:
        entries = plugin.call(lambda: list(opener(options, camera)))
    except PluginError as error:
        raise CaptureError(str(error)) from error
    return [
        (name, frame, partial(_loaded_by, plugin, load), path, files)
        for name, frame, load, path, files in entries
    ]


def _loaded_by(plugin: Plugin, load: Callable[[str], Capture], name: str) -> Capture:
    """Load a capture, whose provenance names the reader of another package."""
    capture = plugin.call(load, name)
    if plugin.is_own:
        return capture
    return replace(capture, provenance={**capture.provenance, "reader": plugin.as_json()})


def list_folder(path: Path) -> Folder:
    """Return the names of all files below a path; unreadable folders are listed as faults.

    Results that a run wrote into a folder inside are passed over.
    """
    folder = Folder(path)
    if is_remote(path):
        store = path.fs  # type: ignore[attr-defined] # a `upath.UPath`
        root = path.path.rstrip("/")  # type: ignore[attr-defined]
        for name in sorted(store.find(root)):
            folder.add(name.removeprefix(root).lstrip("/"))
        return folder

    def note(error: OSError) -> None:
        fault = with_reason("cannot be read", str(error.strerror))
        folder.faults.append(
            CaptureError(fault, source=error.filename, remedy="check who may read it")
        )

    # Links may lead to visited folders or form a cycle.
    visited = {os.path.realpath(path), *map(str, Path(os.path.realpath(path)).parents)}
    for place, folders, files in os.walk(path, onerror=note, followlinks=True):
        if place != str(path) and "measurements.json" in files and _RECORDS & {*folders}:
            folders.clear()
            continue
        subfolder = Path(place).relative_to(path)
        for name in sorted(files):
            folder.add((subfolder / name).as_posix())
        if not os.access(place, os.X_OK):
            note(PermissionError(errno.EACCES, os.strerror(errno.EACCES), place))
        inside = {os.path.realpath(Path(place, name)): name for name in sorted(folders)[::-1]}
        folders[:] = sorted(name for real, name in inside.items() if real not in visited)
        visited |= inside.keys()
    return folder
