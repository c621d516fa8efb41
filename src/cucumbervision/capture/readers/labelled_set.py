"""Labelled sets with depth, as `synth` writes them: `annotations.json` with a camera a picture.

The labels are not read: `--instances SET/annotations.json` takes them as masks.
"""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, Field

from cucumbervision.capture.camera_file import CameraModel
from cucumbervision.capture.pictures import read_color, read_depth
from cucumbervision.capture.readers.common import frame_capture
from cucumbervision.capture.source import fail, safe_name
from cucumbervision.errors import CaptureError, IntrinsicsError
from cucumbervision.files import parse_model, read_json

if TYPE_CHECKING:
    from collections.abc import Iterator

    from cucumbervision.capture.camera_file import CameraFile
    from cucumbervision.capture.frames import Capture
    from cucumbervision.capture.source import CaptureEntry, CaptureLister, Folder, ReadOptions

ANNOTATIONS = "annotations.json"


class _Picture(BaseModel):
    file_name: str
    depth_file: str
    depth_unit_m: Annotated[float, Field(gt=0)] = 0.001
    camera: CameraModel


def find_sets(folder: Folder) -> CaptureLister | None:
    """Find sets whose pictures have depth and a camera, and mark their pictures as used."""
    pictures: list[tuple[str, Any]] = []
    for place, names in folder.files.items():
        if ANNOTATIONS in names and _within(place, "depth") in folder.files:
            entries = _entries(folder.path / place / ANNOTATIONS)
            pictures += [(place, entry) for entry in entries]
    # What the set names elsewhere, such as ../x.png, is no file of this folder.
    listed_files = set(folder)
    taken = {_within(place, entry[key]) for place, entry in pictures for key in _FILES}
    for place, names in folder.files.items():
        names[:] = [name for name in names if _within(place, name) not in taken]
    return partial(_open_sets, folder.path, pictures, listed_files) if pictures else None


_FILES = ("file_name", "depth_file")


def _within(place: str, name: str) -> str:
    """Return the path of a file below the folder that is read; `place` is '' for itself."""
    return f"{place}/{name}".lstrip("/")


def _entries(path: Path) -> list[dict[str, Any]]:
    """Return the pictures of a set that have depth and a camera; none of another file."""
    try:
        content = read_json(path)
    except CaptureError:  # whoever needs this file says what is wrong with it
        return []
    images = content.get("images") if isinstance(content, dict) else None
    return [
        image
        for image in (images if isinstance(images, list) else [])
        if isinstance(image, dict)
        and image.get("camera")
        and all(isinstance(image.get(key), str) for key in _FILES)
    ]


def _open_sets(
    path: Path,
    pictures: list[tuple[str, Any]],
    listed_files: set[str],
    options: ReadOptions,
    camera_file: CameraFile | None,
) -> Iterator[CaptureEntry]:
    for frame, (place, entry) in enumerate(pictures):
        folder, files = path / place, [_within(place, entry[key]) for key in _FILES]
        color = path / files[0]
        prefix = "_".join((path.resolve().name, *Path(place).parts))
        name = safe_name(f"{prefix}_{Path(entry['file_name']).stem}")
        missing = next((file for file in files if file not in listed_files), None)
        if missing is not None:
            fault = CaptureError(
                f"is not there, which {ANNOTATIONS} names",
                source=path / missing,
                remedy="copy the set again",
            )
            yield name, frame, partial(fail, fault), color, None
            continue
        load = partial(_load, folder, entry, frame, camera_file, options)
        parts = [json.dumps(entry).encode(), *(path / file for file in files)]
        cameras = [] if camera_file is None else [camera_file.path]
        yield name, frame, load, color, partial(list, [*parts, *cameras])


def _load(
    folder: Path,
    entry: dict[str, Any],
    frame: int,
    camera_file: CameraFile | None,
    options: ReadOptions,
    name: str,
) -> Capture:
    picture = parse_model(_Picture, entry, source=folder / ANNOTATIONS, error=IntrinsicsError)
    color, depth = folder / picture.file_name, folder / picture.depth_file
    return frame_capture(
        read_color(color),
        partial(read_depth, depth),
        picture.camera.intrinsics,
        camera_file,
        options.depth_unit_m or picture.depth_unit_m,
        options,
        source=color,
        depth_source=depth,
        name=name,
        frame=frame,
        simulated=entry.get("source") == "synth",
        provenance={"reader": "set"},
    )
