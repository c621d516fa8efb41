"""One reader a source, found by what the path holds."""

from __future__ import annotations

import errno
import os
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path

from cucumbervision.capture.readers.bop import SCENE_CAMERAS, open_bop
from cucumbervision.capture.readers.native import MANIFEST, open_native
from cucumbervision.capture.readers.pair import find_pairs, open_pair_file, open_pairs
from cucumbervision.capture.readers.recording import open_recording
from cucumbervision.capture.readers.viewer import find_snapshots, open_viewer
from cucumbervision.capture.source import CaptureRef, CaptureSource, ReadOptions, fail, safe_name
from cucumbervision.capture.urls import as_path, is_remote, with_retries
from cucumbervision.errors import CaptureError

__all__ = ["RECORDING_SUFFIXES", "CaptureRef", "CaptureSource", "ReadOptions", "open_source"]

RECORDING_SUFFIXES = frozenset({".bag", ".db3"})


def open_source(path: Path | str, options: ReadOptions | None = None) -> CaptureSource:
    """Open whatever holds captures.

    Parameters
    ----------
    path : Path or str
        A path, or a URL that `capture.urls.as_path` knows: a native capture folder (`capture.json`)
        or a folder of them, a BOP scene (`scene_camera.json`) or a folder of scenes, RealSense
        Viewer's exports (`*_Depth.raw`), a folder of colour and depth pictures with matching names,
        one colour picture with `options.depth`, an `.npz` with colour and depth, or, on this
        machine, a `.bag` or `.db3` recording.
    options : ReadOptions, optional
        What the user says beyond the path.

    Returns
    -------
    CaptureSource
        The captures, not read yet; after them, as captures that fail, the folders below the path
        that may not be looked into.

    Raises
    ------
    CaptureError
        If the path is missing, holds nothing that a reader knows, or nothing of it can be read.
    """
    path = as_path(path)
    options = options or ReadOptions()
    source = with_retries(path, lambda: _open_or_error(path, options))
    if isinstance(source, CaptureError):
        raise source
    return source


def _open_or_error(path: Path, options: ReadOptions) -> CaptureSource | CaptureError:
    # What a reader refuses is an answer, which is not asked for again.
    try:
        return _open(path, options)
    except CaptureError as error:
        return error


def _open(path: Path, options: ReadOptions) -> CaptureSource:
    if not path.exists():
        raise CaptureError("does not exist", source=path, remedy="check the path")
    if path.is_file() and path.suffix.lower() in RECORDING_SUFFIXES:
        if is_remote(path):
            raise CaptureError(
                "a recording is played from a file of this machine alone",
                source=path,
                remedy="copy it here",
            )
        return open_recording(path, options)
    if path.name == MANIFEST and path.is_file():
        return open_source(path.parent, options)
    # On a web server a folder's list is a file, too.
    if path.is_file() and (path.suffix or not is_remote(path)):
        return open_pair_file(path, options)
    closed: list[CaptureError] = []
    if folders := _folders_with(path, MANIFEST, closed):
        return _with_faults(open_native(path, folders, options), closed)
    if scenes := _folders_with(path, SCENE_CAMERAS):
        return _with_faults(open_bop(path, scenes, options), closed)
    if closed:
        raise closed[0]
    if snapshots := find_snapshots(path):
        return open_viewer(path, snapshots, options)
    if pairs := find_pairs(path):
        return open_pairs(path, pairs, options)
    raise CaptureError(
        "holds no captures that can be recognised",
        source=path,
        remedy="name a capture folder (capture.json), a BOP scene (scene_camera.json), colour and "
        "depth pictures with matching names, or a .bag or .db3 recording",
    )


def _folders_with(path: Path, name: str, closed: list[CaptureError] | None = None) -> list[Path]:
    """Return the folder itself, or every one below it that holds such a file, in order.

    Folders that may not be read are noted in `closed`.
    """

    def note(error: OSError) -> None:
        if closed is not None:
            fault = f"cannot be read ({error.strerror})"
            closed.append(
                CaptureError(fault, source=error.filename, remedy="check who may read it")
            )

    if (path / name).is_file():
        return [path]
    if is_remote(path):
        return sorted(found.parent for found in path.rglob(name))
    found = []
    for folder, _, files in os.walk(path, onerror=note):
        if name in files:
            found.append(Path(folder))
        elif not os.access(folder, os.X_OK):
            note(PermissionError(errno.EACCES, os.strerror(errno.EACCES), folder))
    return sorted(found)


def _with_faults(source: CaptureSource, faults: list[CaptureError]) -> CaptureSource:
    """Add what could not be opened as captures that fail, after those that can."""
    if not faults:
        return source
    names = (safe_name(Path(fault.source).name) for fault in faults)
    refs = [CaptureRef(n, -1, partial(fail, f)) for n, f in zip(names, faults, strict=True)]
    total = None if source.total is None else source.total + len(refs)
    return replace(source, refs=lambda: chain(source.refs(), refs), total=total)
