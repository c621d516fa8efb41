"""`cucumbervision data`: check, convert, split, label, cut, merge and describe pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cucumbervision.cli.choices import PromptChoice, RuntimeChoice

__all__ = ["app"]

app = typer.Typer(
    name="data",
    help="Check, convert, split, label, cut, merge and describe sets of labelled pictures.",
    no_args_is_help=True,
)

Folder = Annotated[
    Path, typer.Argument(help="A folder or file of COCO or YOLO labels.", metavar="SET")
]
Names = Annotated[
    str, typer.Option(help="Classes, by commas, where the set does not name them.", metavar="A,B")
]
Copy = Annotated[bool, typer.Option("--copy", help="Copy pictures instead of linking them.")]
OutOrSame = Annotated[
    Path | None,
    typer.Option("--out", "-o", help="New hub folder; without it the set itself is rewritten."),
]


@app.command()
def check(
    folder: Folder,
    names: Names = "",
    no_duplicates: Annotated[
        bool, typer.Option("--no-duplicates", help="Do not look for copies across splits.")
    ] = False,
) -> None:
    """List everything that is wrong with a set; exit code 1 if anything is."""
    from cucumbervision_lab.cli import data_console

    raise typer.Exit(data_console.check(folder, names, duplicates=not no_duplicates))


@app.command()
def convert(
    folder: Folder,
    out: Annotated[Path, typer.Argument(help="New folder.", metavar="OUT")],
    to: Annotated[
        str,
        typer.Option(help="coco (the hub form), yolo-seg, yolo-pose, yolo-detect or bop."),
    ] = "coco",
    names: Names = "",
    keep: Annotated[
        list[str] | None,
        typer.Option(
            help="Class to keep and what it becomes, by number or name; others become background. "
            "May be repeated.",
            metavar="OLD=NEW",
        ),
    ] = None,
    source: Annotated[str, typer.Option(help="Whose pictures, where none is stated.")] = "",
    licence: Annotated[str, typer.Option(help="Their licence, where none is stated.")] = "",
    copy: Copy = False,
    splits: Annotated[
        str, typer.Option(help="YOLO: which splits to write, by commas.", metavar="A,B")
    ] = "train,val,test",
    no_paint: Annotated[
        bool,
        typer.Option("--no-paint", help="YOLO: leave regions to ignore visible in train too."),
    ] = False,
) -> None:
    """Write a set in another form.

    YOLO has no 'ignore': such regions are painted over with grey noise in the written train
    pictures, and only there.
    """
    from cucumbervision_lab.cli import data_console

    raise typer.Exit(
        data_console.convert(
            folder,
            out,
            to,
            names=names,
            keep=keep or (),
            source=source,
            licence=licence,
            link=not copy,
            splits=splits,
            paint=not no_paint,
        )
    )


@app.command()
def split(
    folder: Folder,
    out: OutOrSame = None,
    names: Names = "",
    shares: Annotated[str, typer.Option(help="Of train, val and test.")] = "70:15:15",
    seed: Annotated[int, typer.Option(help="Orders scenes of one size.")] = 0,
    scene_pattern: Annotated[
        str, typer.Option(help="Scenes by what this finds in the file names.", metavar="REGEX")
    ] = "",
    copy: Copy = False,
) -> None:
    """Part a set into train, val and test that share no scene.

    Scenes that nobody has named are found: near-duplicates belong together.
    """
    from cucumbervision_lab.cli import data_console

    raise typer.Exit(
        data_console.split(folder, out, names, shares, seed, scene_pattern, link=not copy)
    )


@app.command()
def pseudo(
    folder: Folder,
    out: OutOrSame = None,
    names: Names = "",
    model: Annotated[str, typer.Option(help="mobile-sam or sam-vit-b.")] = "mobile-sam",
    prompt: Annotated[
        PromptChoice, typer.Option(help="What SAM is told of a fruit.")
    ] = PromptChoice.both,
    runtime: Annotated[RuntimeChoice, typer.Option(help="What runs it.")] = RuntimeChoice.auto,
    copy: Copy = False,
) -> None:
    """Draw masks by SAM where there are only boxes, marked as pseudo-labels; never in test."""
    from cucumbervision_lab.cli import data_console

    raise typer.Exit(
        data_console.pseudo(folder, out, names, model, prompt.value, runtime.value, link=not copy)
    )


@app.command()
def windows(
    folder: Folder,
    out: Annotated[Path, typer.Argument(help="New hub folder.", metavar="OUT")],
    side: Annotated[
        int, typer.Option(min=32, help="Side of a window, pixels; larger where a fruit is.")
    ] = 480,
    names: Names = "",
    splits: Annotated[str, typer.Option(help="Whose pictures to cut, by commas.")] = "train",
    seed: Annotated[int, typer.Option(min=0, help="The same seed cuts the same windows.")] = 0,
) -> None:
    """Cut windows around fruit: small pictures to train on, as large as they are in large ones."""
    from cucumbervision_lab.cli import data_console

    raise typer.Exit(data_console.windows(folder, out, side, names, splits, seed))


@app.command()
def merge(
    out: Annotated[Path, typer.Argument(help="New hub folder.", metavar="OUT")],
    folders: Annotated[list[Path], typer.Argument(help="Sets to merge.", metavar="SET...")],
    copy: Copy = False,
) -> None:
    """Write several sets as one; whose picture each is stays known."""
    from cucumbervision_lab.cli import data_console

    raise typer.Exit(data_console.merge(out, folders, link=not copy))


@app.command()
def card(
    folder: Folder,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="File to write; else to the screen.")
    ] = None,
    names: Names = "",
    title: Annotated[str, typer.Option(help="The page's head.")] = "Data set",
) -> None:
    """Describe a set in Markdown: counts, sources, licences, sizes, how much is hidden."""
    from cucumbervision_lab.cli import data_console

    raise typer.Exit(data_console.card(folder, out, names, title))
