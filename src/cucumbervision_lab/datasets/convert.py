"""One form into another, as a user asks for it in words."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from cucumbervision.errors import DataSetError
from cucumbervision_lab.datasets.bop import write_bop
from cucumbervision_lab.datasets.classes import keep_classes
from cucumbervision_lab.datasets.coco import write_coco
from cucumbervision_lab.datasets.labels import SPLITS
from cucumbervision_lab.datasets.yolo import write_yolo

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from cucumbervision_lab.datasets.labels import DataSet

__all__ = ["FORMS", "convert_dataset", "parse_keep", "parse_shares"]

FORMS = ("coco", "yolo-seg", "yolo-pose", "yolo-detect", "bop")
_TASKS = {"yolo-seg": "segment", "yolo-pose": "pose", "yolo-detect": "detect"}


def parse_keep(words: Sequence[str]) -> dict[int | str, str]:
    """Read 'old=new' pairs of classes.

    Raises
    ------
    DataSetError
        If a word has no '='.

    Examples
    --------
    >>> parse_keep(["0=cucumber", "zucchini=cucumber"])
    {'0': 'cucumber', 'zucchini': 'cucumber'}
    """
    kept: dict[int | str, str] = {}
    for word in words:
        old, sign, new = word.partition("=")
        if not (sign and old.strip() and new.strip()):
            raise DataSetError(f"{word!r} is no class to keep", remedy="give OLD=NEW")
        kept[old.strip()] = new.strip()
    return kept


def parse_shares(text: str) -> tuple[float, ...]:
    """Read shares of train, val and test, in whatever unit.

    Raises
    ------
    DataSetError
        If they are not three numbers of which something is left.

    Examples
    --------
    >>> parse_shares("70:15:15")
    (0.7, 0.15, 0.15)
    """
    try:
        parts = [float(part) for part in text.split(":")]
    except ValueError:
        parts = []
    if len(parts) != 3 or not 0 < sum(parts) < float("inf") or min(parts) < 0:
        raise DataSetError(f"{text!r} are no shares", remedy="give three, as in 70:15:15")
    return tuple(part / sum(parts) for part in parts)


def convert_dataset(
    dataset: DataSet,
    out: Path,
    form: str,
    *,
    keep: Mapping[int | str, str] | None = None,
    source: str = "",
    licence: str = "",
    link: bool = True,
    splits: Sequence[str] = SPLITS,
    paint_ignored: Sequence[str] = ("train",),
    progress: Callable[[int], None] | None = None,
) -> str:
    """Write a set in another form.

    Parameters
    ----------
    dataset : DataSet
    out : Path
        A new folder.
    form : str
        One of `FORMS`.
    keep : mapping of int or str to str, optional
        As in `keep_classes`; all classes without it.
    source, licence : str
        Of pictures that state none.
    link, splits, paint_ignored, progress
        As in `write_yolo`.

    Returns
    -------
    str
        What was written, in one line.

    Raises
    ------
    DataSetError
        If there is no such form, or what `write_coco`, `write_yolo` and `write_bop` raise.
    """
    if form not in FORMS:
        raise DataSetError(
            f"no form is called {form!r}", remedy=f"choose one of {', '.join(FORMS)}"
        )
    if out.resolve() == dataset.folder.resolve():
        raise DataSetError("is the set itself", source=out, remedy="give a new folder")
    pictures = tuple(
        replace(p, source=p.source or source, licence=p.licence or licence)
        for p in dataset.pictures
    )
    dataset = replace(dataset, pictures=pictures)
    if keep:
        dataset = keep_classes(dataset, keep)
    if form == "coco":
        written = write_coco(dataset, out, link=link, progress=progress)
        labels = sum(len(p.labels) for p in written.pictures)
        return f"{len(written.pictures)} pictures, {labels} labels in {out}"
    if form == "bop":
        scenes = write_bop(dataset, out, link=link, progress=progress)
        return f"{len(dataset.pictures)} pictures in {len(scenes)} scenes in {out}"
    done = write_yolo(
        dataset,
        out,
        _TASKS[form],
        splits=splits,
        link=link,
        paint_ignored=paint_ignored,
        progress=progress,
    )
    parts = ", ".join(f"{count} {split}" for split, count in done.pictures.items())
    return (
        f"{parts}, {done.labels} labels, {done.painted} pictures painted over in part, "
        f"{done.filled_holes} holes filled; give Ultralytics {done.data_yaml}"
    )
