"""The table on which the files of one zip or batch are sorted into captures."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any

from cucumbervision.errors import CaptureError, CucumberVisionError
from cucumbervision.intake.accepted import AcceptedSource, Refused

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from cucumbervision.intake.items import Item
    from cucumbervision.intake.limits import Limits

__all__ = ["Desk", "Sorted", "write_json"]


@dataclass
class Sorted:
    """What comes out of the sorting, over all zips and batches of an upload."""

    sources: list[AcceptedSource] = field(default_factory=list)
    refused: list[Refused] = field(default_factory=list)
    ignored: list[str] = field(default_factory=list)

    def refuse(self, title: str, error: CucumberVisionError) -> None:
        """Note a file that is not taken."""
        self.refused.append(Refused(title, error))


class Desk:
    """The files of one zip or batch that belong to nothing yet.

    Parameters
    ----------
    title : str
        What the zip or batch is called.
    items : iterable of Item
        Its files; of two with one name the first stays.
    folder : Path
        Where sources are laid out.
    limits : Limits
        How many pixels one capture may have.
    out : Sorted
        Where results are noted.
    is_archive : bool
        Whether it is a zip, in which files beside captures are nothing unusual.
    """

    def __init__(
        self,
        title: str,
        items: Iterable[Item],
        folder: Path,
        limits: Limits,
        out: Sorted,
        *,
        is_archive: bool = False,
    ) -> None:
        self.is_archive = is_archive
        self.title, self.folder, self.limits, self.out = title, folder, limits, out
        self.left: dict[PurePosixPath, Item] = {}
        for item in items:
            if item.name in self.left:
                out.refuse(item.title, _twice(item.title))
            else:
                self.left[item.name] = item

    def new_folder(self, kind: str) -> Path:
        """Make the folder of a new source."""
        folder = self.folder / f"{len(list(self.folder.iterdir())):02d}-{kind}"
        folder.mkdir()
        return folder

    def take(self, name: PurePosixPath) -> Item | None:
        """Take a file from the table, so that nothing else uses it; None if it is not there."""
        return self.left.pop(name, None)

    def inside(self, folder: PurePosixPath) -> list[Item]:
        """Give what is left directly in a folder, by name."""
        return [self.left[name] for name in sorted(self.left) if name.parent == folder]

    def refuse(self, item: Item, error: CucumberVisionError) -> None:
        """Take a file from the table and note why it is not taken."""
        self.left.pop(item.name, None)
        self.out.refuse(item.title, error)

    def ignore(self, names: Iterable[PurePosixPath]) -> None:
        """Take files from the table that are not needed."""
        for name in list(names):
            self.out.ignored.append(self.left.pop(name).title)

    def intrinsics_for(self, name: PurePosixPath) -> Item | None:
        """Find the intrinsics file that is nearest to a file: in its folder, or above."""
        found = [item for item in self.left.values() if is_intrinsics(item.document)]
        for folder in name.parents:
            here = sorted((i for i in found if i.name.parent == folder), key=lambda i: i.name)
            named = [i for i in here if i.name.name.lower() == "intrinsics.json"]
            if here:
                return (named or here)[0]
        return None


def is_intrinsics(document: Any) -> bool:
    """Say whether a JSON document looks like an intrinsics file.

    Examples
    --------
    >>> is_intrinsics({"stream": "color", "fx": 900.0}), is_intrinsics({"0": {"cam_K": []}})
    (True, False)
    """
    return isinstance(document, dict) and ("fx" in document or "matrix" in document)


def write_json(path: Path, document: Any) -> Path:
    """Write a document that was read from a stranger's file as a file of our own."""
    path.write_text(json.dumps(document, indent=1), encoding="utf-8")
    return path


def _twice(title: str) -> CaptureError:
    return CaptureError("was sent twice", source=title, remedy="send it once, or rename it")
