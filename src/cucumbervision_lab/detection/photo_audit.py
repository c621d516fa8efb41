"""The real photos' labels, audited by eye: what must be found in each, and what counts neither way.

`audit/photos_audit.json` holds numbers only; the photos themselves never come with the project.
A photo is known again by its bytes, so that a folder may be laid out at will. The file's own notes
say how the boxes were drawn and why each scene is in its split.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cucumbervision.errors import DataSetError
from cucumbervision_lab.datasets.labels import DataSet, Label, LabelledPicture

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

__all__ = ["Audit", "AuditedBox", "AuditedPhoto", "Kind", "audited", "load_audit"]

_FILE = Path(__file__).parent / "audit" / "photos_audit.json"
_PICTURES = {".jpg", ".jpeg", ".png"}
_HASH_DIGITS = 12
_EDGE_PX = 2.0
_MOST = 0.5


class Kind(StrEnum):
    """What a box of the audit holds."""

    CUCUMBER = "cucumber"
    ZUCCHINI = "zucchini"
    IGNORE = "ignore"


@dataclass(frozen=True)
class AuditedBox:
    """One fruit, or one region to ignore.

    Parameters
    ----------
    box : tuple of float
        x1, y1, x2, y2 of the edges in pixels; (0, 0) is the centre of the top-left pixel.
    kind : Kind
        A whole cucumber or courgette (about 70 % of it visible at least) must be found, the
        courgette as a cucumber; a detection in an ignored region is neither right nor wrong.
    stem : str, optional
        Side or corner of the box at which the stalk end lies: 'left', 'up-right', ...; None where
        it cannot be told.
    """

    box: tuple[float, float, float, float]
    kind: Kind
    stem: str | None = None

    @property
    def area_px(self) -> float:
        """Area in square pixels."""
        x1, y1, x2, y2 = self.box
        return (x2 - x1) * (y2 - y1)


@dataclass(frozen=True)
class AuditedPhoto:
    """One photo and what it shows.

    Parameters
    ----------
    name : str
        The file's name when it was audited; for messages only.
    sha1 : str
        First twelve digits of the SHA-1 of the file's bytes, by which it is known again.
    collection : str
        The set it belongs to: 'ingredients_ccby4', 'fruitveg_web', 'canopy', 'leaves'.
    scene : str
        What it shares with its near-duplicates.
    setting : str
        Where the whole fruit lies: 'board', 'plate', 'hand', 'cart', 'crate', 'heap', 'plant',
        'ground', 'white'; 'parts' where all fruit is ignored; 'none' where there is none.
    split : str
        'train' or 'test'; one for a whole scene.
    width, height : int
        In pixels.
    boxes : tuple of AuditedBox
        None of them: a picture without fruit.
    """

    name: str
    sha1: str
    collection: str
    scene: str
    setting: str
    split: str
    width: int
    height: int
    boxes: tuple[AuditedBox, ...] = ()

    @property
    def whole(self) -> tuple[AuditedBox, ...]:
        """The fruit that must be found."""
        return tuple(box for box in self.boxes if box.kind is not Kind.IGNORE)

    @property
    def fully_labelled(self) -> bool:
        """Whether no region over half of the picture is ignored.

        What is not must not be trained on as it is: unlabelled fruit would count as background.
        """
        most = _MOST * self.width * self.height
        return all(b.kind is not Kind.IGNORE or b.area_px <= most for b in self.boxes)


@dataclass(frozen=True)
class Audit:
    """All audited photos.

    Parameters
    ----------
    photos : tuple of AuditedPhoto
        Ordered by collection and name.
    sources, licences : mapping of str to str
        Of each collection.
    """

    photos: tuple[AuditedPhoto, ...]
    sources: Mapping[str, str]
    licences: Mapping[str, str]

    def in_split(self, split: str) -> tuple[AuditedPhoto, ...]:
        """Return the photos of one split, or all for ''."""
        return tuple(photo for photo in self.photos if split in ("", photo.split))


def load_audit() -> Audit:
    """Read the audit that comes with the package.

    Examples
    --------
    >>> test = load_audit().in_split("test")
    >>> sum(len(photo.whole) for photo in test), len({p.scene for p in test if p.whole})
    (86, 28)
    """
    data = json.loads(_FILE.read_text(encoding="utf-8"))
    return Audit(
        photos=tuple(_photo(entry) for entry in data["photos"]),
        sources={name: entry["source"] for name, entry in data["sets"].items()},
        licences={name: entry["licence"] for name, entry in data["sets"].items()},
    )


def audited(folder: Path, split: str = "", audit: Audit | None = None) -> DataSet:
    """Return the audited photos of a folder with their boxes.

    Parameters
    ----------
    folder : Path
        Searched with all its subfolders for JPEG and PNG files.
    split : str
        'train', 'test', or '' for both.
    audit : Audit, optional
        The packaged one if none is given.

    Returns
    -------
    DataSet
        Box-only labels of one category; whole courgettes are in it too. `Label.extras` has
        'kind' and 'stem', `LabelledPicture.extras` 'setting', 'collection' and
        'fully_labelled'. Photos that are missing, changed or never audited are in `refused`.

    Raises
    ------
    DataSetError
        If none of them is there.
    """
    known = load_audit() if audit is None else audit
    wanted = {photo.sha1: photo for photo in known.in_split(split)}
    hashes = {path: _sha1(path) for path in _picture_files(folder)}
    files: dict[str, Path] = {}
    for path, sha1 in hashes.items():
        files.setdefault(sha1, path)
    found = {sha1: files[sha1] for sha1 in wanted if sha1 in files}
    if not found:
        raise DataSetError(
            "none of the audited photos is here",
            source=folder,
            remedy="give the folder that the photos were unpacked to",
        )
    return DataSet(
        folder=folder,
        pictures=tuple(_picture(wanted[s], path, folder, known) for s, path in found.items()),
        refused=(*_missing(wanted.values(), found, folder), *_strangers(known, hashes, found)),
    )


def _photo(entry: Mapping[str, Any]) -> AuditedPhoto:
    """Read one photo; the file counts from the picture's corner, we from a pixel's centre."""
    boxes = (
        AuditedBox(tuple(v - 0.5 for v in b["box"]), Kind(b["class"]), b.get("stem"))
        for b in entry["boxes"]
    )
    width, height = entry["size"]
    names = ("name", "sha1", "scene", "setting", "split")
    return AuditedPhoto(
        collection=entry["set"],
        width=width,
        height=height,
        boxes=tuple(boxes),
        **{name: entry[name] for name in names},
    )


def _picture_files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.suffix.lower() in _PICTURES and p.is_file())


def _sha1(path: Path) -> str:
    return hashlib.sha1(path.read_bytes(), usedforsecurity=False).hexdigest()[:_HASH_DIGITS]


def _picture(photo: AuditedPhoto, path: Path, folder: Path, audit: Audit) -> LabelledPicture:
    return LabelledPicture(
        file=path.relative_to(folder).as_posix(),
        width=photo.width,
        height=photo.height,
        labels=tuple(_label(box, photo) for box in photo.boxes),
        scene=photo.scene,
        split=photo.split,
        source=audit.sources[photo.collection],
        licence=audit.licences[photo.collection],
        extras={
            "setting": photo.setting,
            "collection": photo.collection,
            "fully_labelled": photo.fully_labelled,
        },
    )


def _label(box: AuditedBox, photo: AuditedPhoto) -> Label:
    """Return the box as a label; fruit at the picture's edge runs on beyond it."""
    x1, y1, x2, y2 = box.box
    inside = min(x1, y1, photo.width - 1 - x2, photo.height - 1 - y2) + 0.5
    return Label(
        np.array(box.box, np.float64),
        cut_off=inside < _EDGE_PX,
        ignore=box.kind is Kind.IGNORE,
        extras={"kind": str(box.kind), "stem": box.stem},
    )


def _missing(
    wanted: Iterable[AuditedPhoto], found: Mapping[str, Path], folder: Path
) -> list[DataSetError]:
    """Say once a collection how many photos are not there."""
    photos = list(wanted)
    total = Counter(photo.collection for photo in photos)
    lost = Counter(photo.collection for photo in photos if photo.sha1 not in found)
    return [
        DataSetError(
            f"{count} of {total[name]} audited photos of {name} are not here", source=folder
        )
        for name, count in lost.items()
    ]


def _strangers(
    audit: Audit, hashes: Mapping[Path, str], found: Mapping[str, Path]
) -> list[DataSetError]:
    """Name the files beside audited ones that are none of them."""
    names = {photo.name for photo in audit.photos}
    known = {photo.sha1 for photo in audit.photos}
    beside = {path.parent for path in found.values()}
    return [
        DataSetError(
            "its bytes are not those that were audited" if path.name in names else "never audited",
            source=path,
            remedy="fetch it again" if path.name in names else "it is left out",
        )
        for path, sha1 in hashes.items()
        if sha1 not in known and path.parent in beside
    ]
