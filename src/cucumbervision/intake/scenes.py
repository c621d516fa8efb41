"""Native capture folders and BOP scenes, laid out anew under names of our own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from cucumbervision.capture.files import parse_model
from cucumbervision.capture.readers.native import FORMAT, MANIFEST, MASKS, Manifest
from cucumbervision.errors import CaptureError, CucumberVisionError, UploadError
from cucumbervision.intake.accepted import AcceptedSource, shown_name
from cucumbervision.intake.items import COLORS, DEPTHS, Item
from cucumbervision.intake.sniff import Kind
from cucumbervision.intake.staging import write_json

if TYPE_CHECKING:
    from cucumbervision.intake.limits import Limits
    from cucumbervision.intake.staging import Desk

__all__ = ["sort_native", "sort_scenes"]

_SCENE = "scene_camera.json"
_EXTRA = frozenset({"rgb", "depth", "gray", "mask", MASKS})
_BURST, _MASKS = 4, 20  # times the pixels of one picture: of a burst's frames, of a frame's masks


def sort_native(desk: Desk) -> None:
    """Make one source of all native captures on the desk."""
    manifests = [
        item
        for item in desk.left.values()
        if isinstance(item.document, dict) and item.document.get("format") == FORMAT
    ]
    folder: Path | None = None
    titles: dict[Path, str] = {}
    files: list[str] = []
    for number, item in enumerate(manifests):
        try:
            manifest = parse_model(Manifest, item.document, source=item.title)
            parts = _native_parts(desk, item, manifest)
        except CucumberVisionError as error:
            desk.refuse(item, error)
            continue
        folder = folder or desk.new_folder("native")
        own = folder / f"{number:04d}"
        titles |= _write_native(own, item, manifest, *parts)
        files += [item.title, *(part.title for group in parts for part in group)]
        _leave_out(desk, item.name.parent)
        desk.take(item.name)
    if folder is not None:
        desk.out.sources.append(
            AcceptedSource(folder, "native", desk.title, tuple(files), titles=titles)
        )


def _native_parts(
    desk: Desk, item: Item, manifest: Manifest
) -> tuple[list[Item], list[Item], list[Item]]:
    """Take the colour pictures, depth pictures and masks that a manifest names."""
    at = item.name.parent
    named = [at / n.replace("\\", "/") for f in manifest.frames for n in (f.color, f.depth)]
    if len(set(named)) < len(named):
        raise CaptureError(
            "names one picture twice", source=item.title, remedy="name each frame's own pictures"
        )
    for name, wanted in zip(named, [COLORS, DEPTHS] * len(manifest.frames), strict=True):
        found = desk.left.get(name)
        if found is None or found.kind not in wanted:
            raise CaptureError(
                f"names {name.name[:80]!r}, which was not sent or not taken",
                source=item.title,
                remedy="send the whole capture folder",
            )
    parts = [desk.left[name] for name in named]
    masks = [mask for mask in desk.inside(at / MASKS) if mask.kind in COLORS and _image(mask) >= 0]
    _check_pixels(parts[::2], masks, desk.limits, item.title)
    for part in (*parts, *masks):
        desk.take(part.name)
    return parts[::2], parts[1::2], masks


def _write_native(
    own: Path,
    item: Item,
    manifest: Manifest,
    colors: Sequence[Item],
    depths: Sequence[Item],
    masks: Sequence[Item],
) -> dict[Path, str]:
    (own / MASKS).mkdir(parents=True)
    values = manifest.model_dump(mode="json")
    titles = {own / MANIFEST: item.title, own: item.title}
    for k, (color, depth) in enumerate(zip(colors, depths, strict=True)):
        for key, part in (("color", color), ("depth", depth)):
            name = f"{key}_{k:06d}{part.kind.value}"
            values["frames"][k][key] = name
            titles[_move(part, own / name)] = part.title
    for k, mask in enumerate(masks):
        path = own / MASKS / f"{_image(mask):06d}_{k:06d}.png"
        titles[_move(mask, path)] = mask.title
    values["name"] = shown_name(manifest.name or item.name.parent.name or item.name.stem)
    write_json(own / MANIFEST, values)
    return titles


def sort_scenes(desk: Desk) -> None:
    """Make one source of all BOP scenes on the desk."""
    found = [
        item
        for item in desk.left.values()
        if isinstance(item.document, dict) and item.name.name.lower() == _SCENE
    ]
    folder: Path | None = None
    names: dict[str, str] = {}
    titles: dict[Path, str] = {}
    files: list[str] = []
    for number, item in enumerate(found):
        try:
            parts = _scene_parts(desk, item)
        except CucumberVisionError as error:
            desk.refuse(item, error)
            continue
        folder = folder or desk.new_folder("bop")
        own = folder / f"{number:04d}"
        titles |= _write_scene(own, item, parts)
        shown = shown_name(item.name.parent.name or desk.title)
        images = {_image(part) for group in parts.values() for part in group}
        names |= {f"{folder.name}_{own.name}_{k:06d}": f"{shown}_{k:06d}" for k in images}
        files += [item.title, *(part.title for group in parts.values() for part in group)]
        _leave_out(desk, item.name.parent)
        desk.take(item.name)
    if folder is not None:
        desk.out.sources.append(
            AcceptedSource(folder, "bop", desk.title, tuple(files), names, titles)
        )


def _scene_parts(desk: Desk, item: Item) -> dict[str, list[Item]]:
    at = item.name.parent
    kinds = {"rgb": COLORS, "depth": COLORS, MASKS: COLORS}
    parts = {
        kind: [p for p in desk.inside(at / kind) if p.kind in allowed and _image(p) >= 0]
        for kind, allowed in kinds.items()
    }
    if not parts["rgb"]:
        raise CaptureError(
            "has no pictures in rgb/ beside it", source=item.title, remedy="send the whole scene"
        )
    for image in {_image(part) for part in parts["rgb"]}:
        masks = [mask for mask in parts[MASKS] if _image(mask) == image]
        _check_pixels([], masks, desk.limits, item.title)
    for group in parts.values():
        for part in group:
            desk.take(part.name)
    return parts


def _write_scene(own: Path, item: Item, parts: dict[str, list[Item]]) -> dict[Path, str]:
    titles = {own / _SCENE: item.title, own: item.title}
    for kind, group in parts.items():
        (own / kind).mkdir(parents=True)
        for k, part in enumerate(group):
            path = own / kind / f"{_image(part):06d}_{k:06d}{part.kind.value}"
            titles[_move(part, path)] = part.title
            if kind != MASKS:  # what the reader names for a picture that is missing
                titles.setdefault(own / kind / f"{_image(part):06d}.png", part.title)
    write_json(own / _SCENE, item.document)
    return titles


def _image(part: Item) -> int:
    """Give the number that a picture's name begins with; -1 where it is none."""
    number = part.name.stem.split("_")[0]
    return int(number) if number.isascii() and number.isdecimal() and len(number) < 10 else -1


def _check_pixels(
    colors: Sequence[Item], masks: Sequence[Item], limits: Limits, title: str
) -> None:
    for what, group, times in (("frames", colors, _BURST), ("masks", masks, _MASKS)):
        if sum(part.pixels for part in group) > times * limits.pixels:
            most = times * limits.pixels / 1e6
            raise UploadError(
                f"its {what} have more than {most:g} million pixels together",
                source=title,
                remedy="send fewer or smaller pictures",
            )


def _leave_out(desk: Desk, folder: PurePosixPath) -> None:
    """Ignore pictures and texts that lie beside a capture and are not needed."""
    if not desk.is_archive and folder == PurePosixPath("."):
        return  # loose files have no folders to tell them apart by
    heads = {name.parent for name, item in desk.left.items() if _is_head(item)} - {folder}
    desk.ignore(
        name
        for name, item in list(desk.left.items())
        if (name.parent == folder or (name.parent.parent == folder and name.parent.name in _EXTRA))
        and (item.kind in COLORS or item.kind in {Kind.JSON, Kind.CSV})
        and name.parent not in heads
        and not _is_head(item)
    )


def _is_head(item: Item) -> bool:
    document: Any = item.document
    return isinstance(document, dict) and (
        document.get("format") == FORMAT or item.name.name.lower() == _SCENE
    )


def _move(part: Item, path: Path) -> Path:
    part.path.rename(path)
    return path
