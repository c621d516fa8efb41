"""`cucumbervision synth`: draw labelled pictures with exact truth."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from cucumbervision_lab.datasets.labels import DataSet


def _folder(about: str) -> Any:
    return typer.Option(help=about, exists=True, file_okay=False)


def synth(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the set; resumed if begun.")],
    frames: Annotated[int, typer.Option(min=1, help="How many pictures.")] = 1500,
    seed: Annotated[int, typer.Option(min=0, help="The same seed draws the same set.")] = 1,
    size: Annotated[str, typer.Option(help="Width x height, pixels.", metavar="WxH")] = "1280x720",
    assets: Annotated[
        Path | None, _folder("Folder with textures/, backgrounds/ and hdri/ to draw from.")
    ] = None,
    paste: Annotated[
        Path | None,
        _folder("A labelled set whose fruit are cut out and pasted into the training pictures."),
    ] = None,
    onto: Annotated[
        Path | None,
        _folder("A labelled set: its photos without fruit are pasted onto, nothing is drawn."),
    ] = None,
    depth: Annotated[
        bool, typer.Option("--depth/--no-depth", help="Draw what a D435 reads, and exact depth.")
    ] = True,
    hard: Annotated[
        bool, typer.Option("--hard", help="Smaller, larger, more and more hidden fruit, to learn.")
    ] = False,
    shares: Annotated[
        str, typer.Option(help="How often hanging, bench, crate.", metavar="A,B,C")
    ] = "0.6,0.22,0.18",
    split: Annotated[
        str, typer.Option(help="Put all frames into train, val or test instead of 70:15:15.")
    ] = "",
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = os.cpu_count() or 1,
) -> None:
    """Draw cucumbers on plants, benches and in crates: colour, depth, masks, keypoints, lengths."""
    from cucumbervision_lab.cli.screen import show, ticking
    from cucumbervision_lab.synthesis.generate import generate, parse_options

    options = parse_options(
        frames=frames,
        seed=seed,
        size=size,
        assets=assets,
        paste=paste,
        onto=onto,
        depth=depth,
        hard=hard,
        shares=shares,
        split=split,
    )
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
