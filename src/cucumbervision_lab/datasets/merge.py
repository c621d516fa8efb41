"""Several data sets to one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from cucumbervision.errors import DataSetError
from cucumbervision_lab.datasets.coco import write_coco

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from cucumbervision_lab.datasets.labels import DataSet

__all__ = ["merge_datasets"]


def merge_datasets(
    datasets: Sequence[DataSet],
    out: Path,
    *,
    link: bool = True,
    progress: Callable[[int], None] | None = None,
) -> DataSet:
    """Write several sets as one in the hub form.

    Classes of the same name become one. A scene's name gets its set's in front where another
    set uses it too, and so does a source that is not stated.

    Parameters
    ----------
    datasets : sequence of DataSet
        At least one.
    out : Path
        None of the sets' folders.
    link : bool
        Pictures become second names of the same files where the disk can; else copies.
    progress : callable, optional
        Called with 1 after each picture.

    Returns
    -------
    DataSet
        As it lies in `out`.

    Raises
    ------
    DataSetError
        If there are no sets, `out` is one of them, or a file is missing.
    """
    if not datasets:
        raise DataSetError("there is nothing to merge", remedy="give data sets' folders")
    if any(out.resolve() == d.folder.resolve() for d in datasets):
        raise DataSetError("is one of the sets to merge", source=out, remedy="give a new folder")
    # Their nearest common folder lets one set name the pictures of all.
    root = _common([d.folder.resolve() for d in datasets])
    names = list(dict.fromkeys(name for d in datasets for name in d.categories))
    taken: set[str] = set()
    pictures = []
    for number, dataset in enumerate(datasets, 1):
        prefix = dataset.folder.resolve().relative_to(root)
        title = dataset.folder.resolve().name
        scenes = {p.scene for p in dataset.pictures if p.scene}
        again = {s: f"{title}-{number}/{s}" if s in taken else s for s in scenes}
        taken |= set(again.values())
        for picture in dataset.pictures:
            depth = picture.depth_file
            pictures.append(
                replace(
                    picture,
                    file=(prefix / picture.file).as_posix(),
                    depth_file=None if depth is None else (prefix / depth).as_posix(),
                    scene=again.get(picture.scene, ""),
                    source=picture.source or title,
                    labels=tuple(
                        replace(x, category=names.index(dataset.categories[x.category]))
                        for x in picture.labels
                    ),
                )
            )
    whole = replace(
        datasets[0], folder=root, pictures=tuple(pictures), categories=tuple(names), refused=()
    )
    return write_coco(whole, out, link=link, progress=progress)


def _common(folders: Sequence[Path]) -> Path:
    common = folders[0]
    while not all(f.is_relative_to(common) for f in folders):
        common = common.parent
    return common
