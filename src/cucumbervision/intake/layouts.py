"""Received files laid out as captures that the readers know, under names of our own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from cucumbervision.capture.files import parse_model
from cucumbervision.capture.readers.native import FORMAT, MANIFEST, MASKS, Manifest
from cucumbervision.capture.readers.pair import pair_role
from cucumbervision.errors import CaptureError, CucumberVisionError, UploadError
from cucumbervision.intake.file_checks import COLORS, DEPTHS, PICTURES, Item, Kind
from cucumbervision.intake.recordings import play_apart
from cucumbervision.intake.staging import AcceptedSource, is_intrinsics, shown_name, write_json

if TYPE_CHECKING:
    from cucumbervision.intake.file_checks import Item
    from cucumbervision.intake.limits import Limits
    from cucumbervision.intake.staging import Desk

__all__ = [
    "sort_arrays",
    "sort_native",
    "sort_pairs",
    "sort_recordings",
    "sort_rest",
    "sort_scenes",
    "sort_snapshots",
]

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


_INTRINSICS = "intrinsics.json"

_RAW, _TABLE, _COLOR = "_Depth.raw", "_Depth_metadata.csv", "_Color.png"

_SNAPSHOT = (_RAW, _TABLE, _COLOR, "_Color_metadata.csv")


def sort_snapshots(desk: Desk) -> None:
    """Make a source of RealSense Viewer's exports."""
    raws = [n for n, i in desk.left.items() if i.kind is Kind.RAW and n.name.endswith(_RAW)]
    if not raws:
        return
    folder = desk.new_folder("viewer")
    document = desk.intrinsics_for(raws[0])
    names: dict[str, str] = {}
    titles: dict[Path, str] = {}
    for number, raw in enumerate(sorted(raws)):
        base = raw.name.removesuffix(_RAW)
        own = f"snapshot_{number:04d}"
        names[own] = base
        for ending in _SNAPSHOT:
            part = desk.take(raw.with_name(base + ending))
            titles[folder / f"{own}{ending}"] = (
                part.title if part else f"{desk.title}: {base[:80]}{ending}"
            )
            if part is not None:
                part.path.rename(folder / f"{own}{ending}")
        # A colourised picture of depth has no distances.
        desk.ignore([n for n in [raw.with_name(f"{base}_Depth.png")] if n in desk.left])
    if document is not None:
        titles[write_json(folder / _INTRINSICS, document.document)] = document.title
    desk.out.sources.append(
        AcceptedSource(
            folder,
            "viewer",
            desk.title,
            tuple(titles.values()),
            names,
            titles,
            folder / _INTRINSICS if document else None,
        )
    )


def sort_arrays(desk: Desk) -> None:
    """Make a source of each `.npz` that holds colour and depth."""
    for item in [i for i in desk.left.values() if {"color", "depth"} <= i.arrays]:
        document = None if "matrix" in item.arrays else desk.intrinsics_for(item.name)
        folder = desk.new_folder("pair")
        own = folder / "frame.npz"
        item.path.rename(own)
        desk.take(item.name)
        titles = {own: item.title}
        if document is not None:
            titles[write_json(folder / _INTRINSICS, document.document)] = document.title
        desk.out.sources.append(
            AcceptedSource(
                own,
                "pair",
                desk.title,
                tuple(titles.values()),
                {"frame": item.name.stem},
                titles,
                folder / _INTRINSICS if document else None,
            )
        )


def sort_pairs(desk: Desk) -> None:
    """Make a source of the pairs that share an intrinsics file; pictures left alone are refused."""
    colors: dict[str, Item] = {}
    depths: dict[str, Item] = {}
    for item in sorted(desk.left.values(), key=lambda i: i.name):
        # By what it is, not by the ending that its sender gave it.
        role, key = pair_role(f"{item.name.with_suffix('')}{item.kind.value}")
        if role == "depth" and item.kind in DEPTHS:
            if key not in depths or _is_8_bit_png(depths[key].path):
                depths[key] = item
        elif role == "color" and item.kind in COLORS:
            colors.setdefault(key, item)
    groups: dict[PurePosixPath | None, list[tuple[Item, Item]]] = {}
    for key in sorted(colors.keys() & depths.keys()):
        document = desk.intrinsics_for(colors[key].name)
        groups.setdefault(document.name if document else None, []).append(
            (colors[key], depths[key])
        )
    for name, pairs in groups.items():
        _write_pairs(desk, None if name is None else desk.left[name], pairs)


def _write_pairs(desk: Desk, document: Item | None, pairs: list[tuple[Item, Item]]) -> None:
    folder = desk.new_folder("pair")
    names: dict[str, str] = {}
    titles: dict[Path, str] = {}
    for number, (color, depth) in enumerate(pairs):
        names[f"rgb_{number:04d}"] = str(color.name.with_suffix(""))
        for part, word in ((color, "rgb"), (depth, "depth")):
            own = folder / f"{word}_{number:04d}{part.kind.value}"
            part.path.rename(own)
            titles[own] = part.title
            desk.take(part.name)
    if document is not None:
        titles[write_json(folder / _INTRINSICS, document.document)] = document.title
    desk.out.sources.append(
        AcceptedSource(folder, "pair", desk.title, tuple(titles.values()), names, titles)
    )


def sort_rest(desk: Desk) -> None:
    """Refuse pictures that were left alone; texts and what a zip has besides are not needed."""
    used = {title for source in desk.out.sources for title in source.files}
    for item in list(desk.left.values()):
        if item.title in used:
            desk.take(item.name)
        elif is_intrinsics(item.document) or (
            desk.is_archive and item.kind not in PICTURES | {Kind.NPY, Kind.NPZ}
        ):
            desk.ignore([item.name])
        elif item.kind in PICTURES | {Kind.NPY, Kind.NPZ}:
            desk.refuse(
                item,
                CaptureError(
                    "has no partner: a capture is a colour and a depth picture",
                    source=item.title,
                    remedy="send both, named alike but for the words color and depth, and an "
                    "intrinsics.json",
                ),
            )
        else:
            desk.refuse(
                item,
                CaptureError(
                    "belongs to no capture",
                    source=item.title,
                    remedy="send it with its pictures, or leave it out",
                ),
            )


def _is_8_bit_png(path: Path) -> bool:
    with path.open("rb") as stream:
        head = stream.read(25)
    return head.startswith(b"\x89PNG") and head[-1] == 8


def sort_recordings(desk: Desk, burst: int) -> None:
    """Make a source of each recording, played in a limited process; `burst` frames a capture."""
    for item in [i for i in desk.left.values() if i.kind in {Kind.BAG, Kind.DB3}]:
        desk.take(item.name)
        recording = item.path.with_name(f"{item.path.name}{item.kind.value}")
        item.path.rename(recording)  # the player goes by the ending
        folder = desk.new_folder("recording")
        folder.rmdir()
        played = play_apart(
            recording,
            folder,
            desk.limits.recording,
            burst=burst,
            name=shown_name(item.name.stem),
            title=item.title,
        )
        recording.unlink()
        for error in played.errors:
            desk.out.refuse(item.title, error)
        if not played.captures:
            for left in folder.iterdir():
                left.unlink()
            folder.rmdir()
            continue
        titles = dict.fromkeys(played.captures, item.title)
        desk.out.sources.append(
            AcceptedSource(folder, "recording", item.title, (item.title,), titles=titles)
        )
