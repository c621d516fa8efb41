"""What `cucumbervision data` does on screen: progress, tables, and what could not be used."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table
from rich.text import Text

from cucumbervision.cli.console import progress_bar
from cucumbervision_lab.datasets.card import dataset_card
from cucumbervision_lab.datasets.checks import check_folder, open_dataset
from cucumbervision_lab.datasets.coco import write_coco
from cucumbervision_lab.datasets.derive import (
    add_pseudo_masks,
    convert_dataset,
    merge_datasets,
    parse_keep,
    parse_shares,
    write_windows,
)
from cucumbervision_lab.datasets.labels import SPLITS, write_text
from cucumbervision_lab.datasets.splits import find_scenes, scenes_by_name, split_by_scene

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from cucumbervision_lab.datasets.labels import DataSet

__all__ = ["card", "check", "convert", "merge", "pseudo", "split", "windows"]

_WIDE = 500  # one line a finding, for files and pipes


def check(folder: Path, names: str, *, duplicates: bool) -> int:
    """Print a set's faults as a table; give 1 if there are any."""
    with _progress("looking") as tick:
        dataset, findings = check_folder(folder, _list(names), duplicates=duplicates, progress=tick)
    console = _console(_WIDE)
    if findings:
        table = Table("kind", "where", "fault", "remedy")
        table.title, table.title_justify = f"{folder}: what is wrong", "left"
        for column in table.columns:
            column.overflow = "fold"
        for finding in findings:
            cells = (finding.kind, finding.where, finding.fault, finding.remedy)
            table.add_row(*(Text(cell) for cell in cells))
        console.print(table)
    fruit = sum(len(p.labels) for p in dataset.pictures)
    faults = f"{len(findings)} faults" if findings else "no fault"
    console.print(f"{len(dataset.pictures)} pictures, {fruit} labels, {faults}.")
    return 1 if findings else 0


def convert(
    folder: Path,
    out: Path,
    to: str,
    *,
    names: str,
    keep: Sequence[str],
    source: str,
    licence: str,
    link: bool,
    splits: str,
    paint: bool,
) -> int:
    """Write a set in another form and say what came of it; give 1 if something was left out."""
    dataset = open_dataset(folder, _list(names))
    with _progress("writing", len(dataset.pictures)) as tick:
        line = convert_dataset(
            dataset,
            out,
            to,
            keep=parse_keep(keep),
            source=source,
            licence=licence,
            link=link,
            splits=_list(splits),
            paint_ignored=("train",) if paint else (),
            progress=tick,
        )
    _console().print(line, soft_wrap=True, markup=False)
    return _show_refused(dataset)


def split(
    folder: Path,
    out: Path | None,
    names: str,
    shares: str,
    seed: int,
    pattern: str,
    *,
    link: bool,
) -> int:
    """Part a set and print how many pictures and scenes each split has."""
    parts = parse_shares(shares)
    dataset = open_dataset(folder, _list(names))
    if pattern:
        dataset = scenes_by_name(dataset, pattern)
    with _progress("looking", sum(not p.scene for p in dataset.pictures)) as tick:
        dataset = find_scenes(dataset, tick)
    parted = split_by_scene(dataset, parts, seed=seed)
    written = write_coco(parted, out or dataset.folder, link=link)
    table = Table("split", "pictures", "scenes", "fruit", title=f"{written.folder}: splits")
    for name in SPLITS:
        own = parted.in_split(name)
        fruit = sum(not label.ignore for p in own for label in p.labels)
        table.add_row(name, str(len(own)), str(len({p.scene for p in own})), str(fruit))
    _console().print(table)
    return _show_refused(dataset)


def pseudo(
    folder: Path,
    out: Path | None,
    names: str,
    model: str,
    prompt: str,
    runtime: str,
    *,
    link: bool,
) -> int:
    """Draw masks and say how many; give 1 if something could not be used."""
    from cucumbervision.perception.sam import Segmenter

    dataset = open_dataset(folder, _list(names))
    segmenter = Segmenter(model, runtime, prompt)
    with _progress("drawing", len(dataset.pictures)) as tick:
        drawn = add_pseudo_masks(dataset, segmenter, progress=tick)
    written = write_coco(drawn.dataset, out or dataset.folder, link=link)
    console = _console()
    console.print(
        f"{drawn.drawn} masks drawn, {len(drawn.refused)} did not fit their box and are to be "
        f"ignored, in {written.folder}",
        soft_wrap=True,
        markup=False,
    )
    for file, fault in drawn.refused:
        console.print(f"  {file}: {fault}", soft_wrap=True, markup=False)
    return _show_refused(dataset)


def windows(folder: Path, out: Path, side: int, names: str, splits: str, seed: int) -> int:
    """Cut windows around fruit and say how many; give 1 if something was left out."""
    dataset = open_dataset(folder, _list(names))
    with _progress("cutting", len(dataset.pictures)) as tick:
        cut = write_windows(dataset, out, side, splits=_list(splits), seed=seed, progress=tick)
    fruit = sum(not label.ignore for picture in cut.pictures for label in picture.labels)
    line = f"{len(cut.pictures)} windows with {fruit} fruit are in {out}"
    _console().print(line, soft_wrap=True, markup=False)
    return _show_refused(dataset)


def merge(out: Path, folders: Sequence[Path], *, link: bool) -> int:
    """Merge sets; give 1 if something could not be used."""
    sets = [open_dataset(folder) for folder in folders]
    with _progress("writing", sum(len(d.pictures) for d in sets)) as tick:
        merged = merge_datasets(sets, out, link=link, progress=tick)
    _console().print(
        f"{len(merged.pictures)} pictures of {len(sets)} sets are in {merged.folder}",
        soft_wrap=True,
        markup=False,
    )
    return max(_show_refused(dataset) for dataset in sets)


def card(folder: Path, out: Path | None, names: str, title: str) -> int:
    """Print or write a set's card; give 1 if something could not be used."""
    dataset = open_dataset(folder, _list(names))
    text = dataset_card(dataset, title)
    if out is None:
        _console().print(text, soft_wrap=True, markup=False)
    else:
        write_text(out, text)
    return _show_refused(dataset)


def _list(names: str) -> list[str]:
    return [name.strip() for name in names.split(",") if name.strip()]


def _console(width: int = 120) -> Console:
    # A file or a pipe has no width of its own; 80 columns would cut the table.
    return Console(highlight=False, width=None if Console().is_terminal else width)


@contextmanager
def _progress(what: str, total: int | None = None) -> Iterator[Callable[[int], None]]:
    with progress_bar(Console(stderr=True, highlight=False)) as bar:
        task = bar.add_task(what, total=total)
        yield lambda count: bar.advance(task, count)


def _show_refused(dataset: DataSet) -> int:
    if not dataset.refused:
        return 0
    console = Console(stderr=True, highlight=False)
    console.print(f"{len(dataset.refused)} could not be used and are left out:")
    for error in dataset.refused:
        console.print(f"  {error}", soft_wrap=True, markup=False)
    return 1
