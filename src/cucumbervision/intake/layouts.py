"""Received files laid out as captures that the readers know, under names of our own."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any

from cucumbervision.capture.files import parse_model
from cucumbervision.capture.readers.bop import SCENE_CAMERAS
from cucumbervision.capture.readers.native import FORMAT, MANIFEST, MASKS, Manifest
from cucumbervision.capture.readers.pair import is_8_bit_png, pair_up
from cucumbervision.errors import CaptureError, CucumberVisionError, UploadError
from cucumbervision.intake.file_checks import COLORS, DEPTHS, PICTURES, FileKind, Item
from cucumbervision.intake.recordings import play_in_process
from cucumbervision.intake.staging import Layout, is_intrinsics, shown_name

if TYPE_CHECKING:
    from cucumbervision.intake.limits import Limits
    from cucumbervision.intake.staging import Staging

_EXTRA = frozenset({"rgb", "depth", "gray", "mask", MASKS})
_BURST, _MASKS = 4, 20  # times the pixels of one picture: of a burst's frames, of a frame's masks
_RAW = "_Depth.raw"
_SNAPSHOT = (_RAW, "_Depth_metadata.csv", "_Color.png", "_Color_metadata.csv")


def arrange_uploads(staging: Staging, burst: int) -> None:
    """Make sources of all files of a zip or batch; the result is in `staging.out`.

    Parameters
    ----------
    staging : Staging
        The files; none are left.
    burst : int
        Frames of a recording fused to one capture.
    """
    _recordings(staging, burst)
    _native(staging)
    _bop(staging)
    _snapshots(staging)
    _arrays(staging)
    _pairs(staging)
    _rest(staging)


def _recordings(staging: Staging, burst: int) -> None:
    """Play each recording in a limited process."""
    for item in [i for i in staging.left.values() if i.kind in {FileKind.BAG, FileKind.DB3}]:
        staging.take(item.name)
        recording = item.path.with_name(f"{item.path.name}{item.kind.value}")
        item.path.rename(recording)  # the player goes by the ending
        layout = Layout(staging, "recording")
        layout.folder.rmdir()  # the player makes it
        played = play_in_process(
            recording,
            layout.folder,
            staging.limits.recording,
            burst=burst,
            name=shown_name(item.name.stem),
            title=item.title,
        )
        recording.unlink()
        for error in played.errors:
            staging.out.refuse(item.title, error)
        if played.captures:
            layout.titles = dict.fromkeys(played.captures, item.title)
            layout.files.append(item.title)
            layout.accept(title=item.title)
        else:
            shutil.rmtree(layout.folder)


def _native(staging: Staging) -> None:
    """Make one source of all native captures."""
    layout: Layout | None = None
    for number, item in enumerate(_documents(staging, _is_manifest)):
        try:
            manifest = parse_model(Manifest, item.document, source=item.title)
            colors, depths, masks = _native_parts(staging, item, manifest)
        except CucumberVisionError as error:
            staging.refuse(item, error)
            continue
        layout = layout or Layout(staging, "native")
        own = f"{number:04d}"
        values = manifest.model_dump(mode="json")
        for k, (color, depth) in enumerate(zip(colors, depths, strict=True)):
            for key, part in (("color", color), ("depth", depth)):
                values["frames"][k][key] = f"{key}_{k:06d}{part.kind.value}"
                layout.move(part, f"{own}/{values['frames'][k][key]}")
        for k, mask in enumerate(masks):
            layout.move(mask, f"{own}/{MASKS}/{_image(mask):06d}_{k:06d}.png")
        values["name"] = shown_name(manifest.name or item.name.parent.name or item.name.stem)
        layout.write(item, f"{own}/{MANIFEST}", values)
        layout.titles[layout.folder / own] = item.title
        _ignore_beside(staging, item.name.parent)
    if layout is not None:
        layout.accept()


def _native_parts(
    staging: Staging, item: Item, manifest: Manifest
) -> tuple[list[Item], list[Item], list[Item]]:
    """Return the colour pictures, depth pictures and masks that a manifest names."""
    at = item.name.parent
    named = [at / n.replace("\\", "/") for f in manifest.frames for n in (f.color, f.depth)]
    if len(set(named)) < len(named):
        raise CaptureError(
            "names one picture twice", source=item.title, remedy="name each frame's own pictures"
        )
    for name, wanted in zip(named, [COLORS, DEPTHS] * len(manifest.frames), strict=True):
        found = staging.left.get(name)
        if found is None or found.kind not in wanted:
            raise CaptureError(
                f"names {name.name[:80]!r}, which was not sent or not accepted",
                source=item.title,
                remedy="send the whole capture folder",
            )
    parts = [staging.left[name] for name in named]
    masks = _numbered(staging, at / MASKS)
    _check_pixels(parts[::2], masks, staging.limits, item.title)
    return parts[::2], parts[1::2], masks


def _bop(staging: Staging) -> None:
    """Make one source of all BOP scenes."""
    layout: Layout | None = None
    for number, item in enumerate(_documents(staging, _is_scene)):
        at = item.name.parent
        parts = {kind: _numbered(staging, at / kind) for kind in ("rgb", "depth", MASKS)}
        try:
            _check_scene(staging, item, parts)
        except CucumberVisionError as error:
            staging.refuse(item, error)
            continue
        layout = layout or Layout(staging, "bop")
        own, shown = f"{number:04d}", shown_name(at.name or staging.title)
        for kind, group in parts.items():
            for k, part in enumerate(group):
                image = f"{_image(part):06d}"
                path = layout.move(part, f"{own}/{kind}/{image}_{k:06d}{part.kind.value}")
                layout.names[f"{layout.folder.name}_{own}_{image}"] = f"{shown}_{image}"
                if kind != MASKS:  # what the reader names for a picture that is missing
                    layout.titles.setdefault(path.with_name(f"{image}.png"), part.title)
        layout.write(item, f"{own}/{SCENE_CAMERAS}", item.document)
        layout.titles[layout.folder / own] = item.title
        _ignore_beside(staging, at)
    if layout is not None:
        layout.accept()


def _check_scene(staging: Staging, item: Item, parts: dict[str, list[Item]]) -> None:
    if not parts["rgb"]:
        raise CaptureError(
            "has no pictures in rgb/ beside it", source=item.title, remedy="send the whole scene"
        )
    for image in {_image(part) for part in parts["rgb"]}:
        masks = [mask for mask in parts[MASKS] if _image(mask) == image]
        _check_pixels([], masks, staging.limits, item.title)


def _snapshots(staging: Staging) -> None:
    """Make a source of RealSense Viewer's exports."""
    raws = [n for n, i in staging.left.items() if i.kind is FileKind.RAW and n.name.endswith(_RAW)]
    if not raws:
        return
    layout = Layout(staging, "viewer")
    intrinsics = staging.intrinsics_for(raws[0])
    for number, raw in enumerate(sorted(raws)):
        base, own = raw.name.removesuffix(_RAW), f"snapshot_{number:04d}"
        layout.names[own] = base
        for ending in _SNAPSHOT:
            part = staging.left.get(raw.with_name(base + ending))
            if part is not None:
                layout.move(part, own + ending)
            else:  # what the reader names for a file that is missing
                missing = f"{staging.title}: {base[:80]}{ending}"
                layout.titles[layout.folder / f"{own}{ending}"] = missing
        # A colourised picture of depth has no distances.
        staging.ignore([n for n in [raw.with_name(f"{base}_Depth.png")] if n in staging.left])
    layout.write_intrinsics(intrinsics)
    layout.accept()


def _arrays(staging: Staging) -> None:
    """Make a source of each `.npz` that holds colour and depth."""
    for item in [i for i in staging.left.values() if {"color", "depth"} <= i.arrays]:
        layout = Layout(staging, "pair")
        layout.names["frame"] = item.name.stem
        intrinsics = None if "matrix" in item.arrays else staging.intrinsics_for(item.name)
        path = layout.move(item, "frame.npz")
        layout.write_intrinsics(intrinsics)
        layout.accept(path)


def _pairs(staging: Staging) -> None:
    """Make a source of the pairs of pictures that share an intrinsics file."""
    # By what each is, not by the ending that its sender gave it.
    named = (
        (f"{item.name.with_suffix('')}{item.kind.value}", item)
        for item in sorted(staging.left.values(), key=lambda i: i.name)
    )
    colors, depths = pair_up(named, lambda item: is_8_bit_png(item.path))
    groups: dict[PurePosixPath | None, list[tuple[Item, Item]]] = {}
    for key in sorted(colors.keys() & depths.keys()):
        intrinsics = staging.intrinsics_for(colors[key].name)
        pair = colors[key], depths[key]
        groups.setdefault(intrinsics.name if intrinsics else None, []).append(pair)
    for name, pairs in groups.items():
        layout = Layout(staging, "pair")
        for number, (color, depth) in enumerate(pairs):
            layout.names[f"rgb_{number:04d}"] = str(color.name.with_suffix(""))
            layout.move(color, f"rgb_{number:04d}{color.kind.value}")
            layout.move(depth, f"depth_{number:04d}{depth.kind.value}")
        layout.write_intrinsics(None if name is None else staging.left[name])
        layout.accept()


def _rest(staging: Staging) -> None:
    """Refuse pictures without a partner; texts and what a zip has besides are not needed."""
    used = {title for source in staging.out.sources for title in source.files}
    for item in list(staging.left.values()):
        is_picture = item.kind in PICTURES | {FileKind.NPY, FileKind.NPZ}
        if item.title in used:
            staging.take(item.name)
        elif is_intrinsics(item.document) or (staging.is_archive and not is_picture):
            staging.ignore([item.name])
        else:
            message, remedy = (
                (
                    "has no partner: a capture is a colour and a depth picture",
                    "send both, named alike but for the words color and depth, and an "
                    "intrinsics.json",
                )
                if is_picture
                else ("belongs to no capture", "send it with its pictures, or leave it out")
            )
            staging.refuse(item, CaptureError(message, source=item.title, remedy=remedy))


def _is_manifest(item: Item) -> bool:
    return isinstance(item.document, dict) and item.document.get("format") == FORMAT


def _is_scene(item: Item) -> bool:
    return isinstance(item.document, dict) and item.name.name.lower() == SCENE_CAMERAS


def _documents(staging: Staging, wanted: Any) -> list[Item]:
    return [item for item in staging.left.values() if wanted(item)]


def _numbered(staging: Staging, folder: PurePosixPath) -> list[Item]:
    """Return the pictures in a folder whose names begin with a number."""
    return [p for p in staging.inside(folder) if p.kind in COLORS and _image(p) >= 0]


def _image(part: Item) -> int:
    """Return the number that a picture's name begins with; -1 where it is none."""
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


def _ignore_beside(staging: Staging, folder: PurePosixPath) -> None:
    """Ignore pictures and texts that lie beside a capture and are not needed."""
    if not staging.is_archive and folder == PurePosixPath("."):
        return  # loose files have no folders to tell them apart by
    heads = {n for n, item in staging.left.items() if _is_manifest(item) or _is_scene(item)}
    others = {name.parent for name in heads} - {folder}
    staging.ignore(
        name
        for name, item in list(staging.left.items())
        if (name.parent == folder or (name.parent.parent == folder and name.parent.name in _EXTRA))
        and item.kind in COLORS | {FileKind.JSON, FileKind.CSV}
        and name.parent not in others
        and name not in heads
    )
