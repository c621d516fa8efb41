"""`cucumbervision data` and `synth`: check, convert, split, merge, export and draw data sets."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cucumbervision_lab.cli import show, ticking

if TYPE_CHECKING:
    from cucumbervision_lab.data.labels import DataSet


app = typer.Typer(
    name="data",
    help="Check, convert, split, label, merge and export data sets.",
    no_args_is_help=True,
)

Folder = Annotated[
    Path, typer.Argument(help="Folder or file of a COCO or YOLO data set.", metavar="SET")
]
Names = Annotated[
    str, typer.Option(help="Comma-separated class names, if the set has none.", metavar="A,B")
]
Out = Annotated[Path, typer.Argument(help="New output folder.", metavar="OUT")]
OutOrSame = Annotated[
    Path | None,
    typer.Option("--out", "-o", help="New output folder; by default the set is changed in place."),
]


@app.command()
def check(folder: Folder, names: Names = "") -> None:
    """List all faults of a data set; the exit code is 1 if there are any."""
    from cucumbervision_lab.data.checks import check_dataset

    dataset = _open(folder, names)
    with ticking("looking") as tick:
        findings = check_dataset(dataset, progress=tick)
    show(*findings)
    fruit = sum(len(p.labels) for p in dataset.pictures)
    faults = f"{len(findings)} faults" if findings else "no fault"
    show(f"{len(dataset.pictures)} pictures, {fruit} labels, {faults}.")
    raise typer.Exit(1 if findings else 0)


@app.command()
def convert(
    folder: Folder,
    out: Annotated[Path, typer.Argument(help="New folder.", metavar="OUT")],
    to: Annotated[
        str, typer.Option(help="Format: coco, yolo-seg, yolo-pose or yolo-detect.")
    ] = "coco",
    names: Names = "",
    keep: Annotated[
        list[str] | None,
        typer.Option(
            help="Class to keep by index or name, and its new name; others become background. "
            "May be repeated.",
            metavar="OLD=NEW",
        ),
    ] = None,
    source: Annotated[str, typer.Option(help="Source of pictures without one.")] = "",
    licence: Annotated[str, typer.Option(help="Licence of pictures without one.")] = "",
    splits: Annotated[
        str, typer.Option(help="Comma-separated splits to write (YOLO).", metavar="A,B")
    ] = "train,val,test",
) -> None:
    """Convert a data set to another format."""
    from cucumbervision_lab.data.derive import convert_dataset, parse_keep

    dataset = _open(folder, names)
    with ticking("writing", len(dataset.pictures)) as tick:
        line = convert_dataset(
            dataset,
            out,
            to,
            keep=parse_keep(keep or ()),
            source=source,
            licence=licence,
            splits=_list(splits),
            progress=tick,
        )
    show(line)
    _finish(dataset)


@app.command()
def split(
    folder: Folder,
    out: OutOrSame = None,
    shares: Annotated[str, typer.Option(help="Shares of train, val and test.")] = "70:15:15",
    seed: Annotated[int, typer.Option(help="Random seed.")] = 0,
    scene_pattern: Annotated[
        str, typer.Option(help="Regular expression for scene names in file names.", metavar="REGEX")
    ] = "",
) -> None:
    """Split a data set into train, val and test by scene.

    Pictures without a scene are grouped by similarity, so that near-duplicates stay together.
    """
    from rich.table import Table

    from cucumbervision.cli.console import screen
    from cucumbervision_lab.data.coco import write_coco
    from cucumbervision_lab.data.labels import SPLITS
    from cucumbervision_lab.data.splits import (
        find_scenes,
        parse_shares,
        scenes_by_name,
        split_by_scene,
    )

    parts = parse_shares(shares)
    dataset = _open(folder)
    if scene_pattern:
        dataset = scenes_by_name(dataset, scene_pattern)
    with ticking("looking", sum(not p.scene for p in dataset.pictures)) as tick:
        dataset = find_scenes(dataset, tick)
    parted = split_by_scene(dataset, parts, seed=seed)
    written = write_coco(parted, out or dataset.folder)
    table = Table("split", "pictures", "scenes", "fruit", title=f"{written.folder}: splits")
    for name in SPLITS:
        subset = parted.in_split(name)
        fruit = sum(not label.ignore for p in subset for label in p.labels)
        table.add_row(name, str(len(subset)), str(len({p.scene for p in subset})), str(fruit))
    screen().print(table)
    _finish(dataset)


@app.command()
def pseudo(folder: Folder, out: OutOrSame = None) -> None:
    """Add masks by SAM to labels with boxes only, as pseudo-labels; the test split is skipped."""
    from cucumbervision.networks.find import open_segmenter
    from cucumbervision_lab.data.coco import write_coco
    from cucumbervision_lab.data.derive import add_pseudo_masks

    dataset = _open(folder)
    segmenter = open_segmenter()
    with ticking("drawing", len(dataset.pictures)) as tick:
        drawn, refused = add_pseudo_masks(dataset, segmenter, progress=tick)
    written = write_coco(drawn, out or dataset.folder)
    before, after = (sum(x.pseudo for p in d.pictures for x in p.labels) for d in (dataset, drawn))
    show(
        f"{after - before} masks drawn, {len(refused)} did not fit their box and are to be "
        f"ignored, in {written.folder}",
        *(f"  {file}: {fault}" for file, fault in refused),
    )
    _finish(dataset)


@app.command()
def merge(
    out: Out,
    folders: Annotated[list[Path], typer.Argument(help="Sets to merge.", metavar="SET...")],
) -> None:
    """Merge data sets; source and licence of each picture are kept."""
    from cucumbervision_lab.data.derive import merge_datasets

    sets = [_open(folder) for folder in folders]
    with ticking("writing", sum(len(d.pictures) for d in sets)) as tick:
        merged = merge_datasets(sets, out, progress=tick)
    show(f"{len(merged.pictures)} pictures of {len(sets)} sets are in {merged.folder}")
    _finish(*sets)


@app.command("from-photos")
def from_photos(
    folder: Annotated[
        Path, typer.Argument(help="Folder of the audited photos, searched recursively.")
    ],
    out: Out,
) -> None:
    """Write the audited photos, except those of test scenes, as a labelled set with masks."""
    from cucumbervision_lab.train.network import photo_set

    made = photo_set(folder, out)
    show(f"{len(made.pictures)} photos are in {out}")


@app.command("from-store")
def from_store(
    store: Annotated[str, typer.Argument(help="SQLite file or postgresql:// URL.")],
    out: Annotated[Path, typer.Argument(help="Folder to write into.", metavar="OUT")],
    licence: Annotated[
        str, typer.Option(help="Licence of the pictures, recorded in the set.")
    ] = "",
) -> None:
    """Export reviewed detections as a data set for fine-tuning the detector.

    Accepted, corrected and added fruit become labels, rejected ones background, others are ignored.
    Whole metres of a row are held out; the choice stays the same when the set grows.
    """
    from rich.table import Table

    from cucumbervision.cli.console import screen
    from cucumbervision_greenhouse.store.repository import open_store
    from cucumbervision_lab.data.derive import dataset_from_store

    with open_store(store, create=False) as opened:
        dataset, judged, lost = dataset_from_store(opened, out, licence=licence)
    columns = ("accepted", "corrected", "added", "rejected", "unjudged")
    table = Table("split", "pictures", *columns, title=f"{out}: what was judged")
    for split, judgement in judged.items():
        counts = [str(judgement[column]) for column in columns]
        table.add_row(split, str(len(dataset.in_split(split))), *counts)
    screen().print(table)
    if lost:
        show(f"{lost} reviewed captures skipped: their pictures were not kept")


def _list(names: str) -> list[str]:
    return [name.strip() for name in names.split(",") if name.strip()]


def _open(folder: Path, names: str = "") -> DataSet:
    from cucumbervision_lab.data.checks import open_dataset

    return open_dataset(folder, _list(names))


def _finish(*sets: DataSet) -> None:
    """List skipped entries and exit with code 1 if there are any."""
    for dataset in sets:
        if dataset.refused:
            show(f"{len(dataset.refused)} invalid entries skipped:", error=True)
            show(*(f"  {error}" for error in dataset.refused), error=True)
    raise typer.Exit(1 if any(dataset.refused for dataset in sets) else 0)


def _folder(text: str) -> Any:
    return typer.Option(help=text, exists=True, file_okay=False)


def synth(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the set; rerun to resume.")],
    frames: Annotated[int, typer.Option(min=1, help="Number of frames.")] = 1500,
    seed: Annotated[int, typer.Option(min=0, help="Random seed.")] = 1,
    size: Annotated[str, typer.Option(help="Width x height, pixels.", metavar="WxH")] = "1280x720",
    assets: Annotated[
        Path | None, _folder("Folder of picture assets: textures/, backgrounds/ and hdri/.")
    ] = None,
    paste: Annotated[
        Path | None, _folder("Labelled set whose fruit are pasted onto photos; needs --onto.")
    ] = None,
    onto: Annotated[
        Path | None,
        _folder("Labelled set whose photos without fruit replace the synthetic frames."),
    ] = None,
    depth: Annotated[
        bool,
        typer.Option("--depth/--no-depth", help="Also write simulated D435 depth and exact depth."),
    ] = True,
    hard: Annotated[
        bool, typer.Option("--hard", help="Generate more difficult scenes, for training.")
    ] = False,
    shares: Annotated[
        str, typer.Option(help="Weights of hanging, bench and crate scenes.", metavar="A,B,C")
    ] = "0.6,0.22,0.18",
    split: Annotated[
        str, typer.Option(help="Split of all frames: train, val or test; default: 70:15:15.")
    ] = "",
    workers: Annotated[int, typer.Option(min=1, help="Number of processes.")] = os.cpu_count() or 1,
) -> None:
    """Generate synthetic cucumbers with colour, depth, masks, keypoints and lengths."""
    from cucumbervision_lab.data.splits import parse_shares
    from cucumbervision_lab.scenes.generate import FrameOptions, SynthOptions, generate, parse_size

    frame = FrameOptions(*parse_size(size), parse_shares(shares, ","), depth, hard=hard)
    options = SynthOptions(frames, seed, frame, assets, split, paste, onto)
    with ticking("drawing", options.frames) as tick:
        data = generate(options, out, workers, tick)
    show(_contents(data, out))


def _contents(data: DataSet, out: Path) -> str:
    fruit = sum(len(picture.labels) for picture in data.pictures)
    ignored = sum(label.ignore for picture in data.pictures for label in picture.labels)
    parts = ", ".join(f"{len(data.in_split(s))} {s}" for s in ("train", "val", "test"))
    return (
        f"{len(data.pictures)} pictures ({parts}) with {fruit} cucumbers, {ignored} of them too "
        f"hidden or too small to count, are in {out}/"
    )
