"""`cucumbervision synth`: generate synthetic data sets with exact ground truth."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from cucumbervision_lab.datasets.labels import DataSet


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
        Path | None,
        _folder("Labelled set whose fruit are pasted into the training frames."),
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
