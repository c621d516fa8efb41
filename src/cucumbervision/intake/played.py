"""Recordings among the files of an upload."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cucumbervision.intake.accepted import AcceptedSource, shown_name
from cucumbervision.intake.recordings import play_apart
from cucumbervision.intake.sniff import Kind

if TYPE_CHECKING:
    from cucumbervision.intake.staging import Desk

__all__ = ["sort_recordings"]


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
