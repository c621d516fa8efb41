"""Viewer exports, colour and depth pairs, and arrays with both, under names of our own."""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from cucumbervision.capture.readers.pair import pair_role
from cucumbervision.errors import CaptureError
from cucumbervision.intake.accepted import AcceptedSource
from cucumbervision.intake.items import COLORS, DEPTHS
from cucumbervision.intake.sniff import PICTURES, Kind
from cucumbervision.intake.staging import is_intrinsics, write_json

if TYPE_CHECKING:
    from cucumbervision.intake.items import Item
    from cucumbervision.intake.staging import Desk

__all__ = ["sort_arrays", "sort_pairs", "sort_rest", "sort_snapshots"]

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
