"""`cucumbervision crop`: make and check a crop pack."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    name="crop",
    help="Crop packs: a folder with profile, networks, cards and truth, for --profile FOLDER.",
    no_args_is_help=True,
)

Pack = Annotated[Path, typer.Argument(help="The crop's folder.", metavar="FOLDER")]


@app.command()
def new(
    folder: Pack,
    like: Annotated[str, typer.Option(help="Profile to begin with.")] = "long-cucumber",
) -> None:
    """Make a folder with a profile to edit."""
    from cucumbervision.crop.profiles import PACK_PROFILE, profile_path
    from cucumbervision.errors import ProfileError
    from cucumbervision.files import write_bytes

    path = folder / PACK_PROFILE
    if path.exists():
        raise ProfileError("is there already", source=path, remedy="edit it, or name another")
    folder.mkdir(parents=True, exist_ok=True)
    write_bytes(path, profile_path(like).read_bytes())
    typer.echo(f"edit {path}, then: cucumbervision crop check {folder}")


@app.command()
def check(folder: Pack) -> None:
    """Read everything in the folder and say what it holds."""
    from cucumbervision.accuracy.truth import read_truth
    from cucumbervision.networks.yolo import YoloDetector
    from cucumbervision.run.options import read_pack

    pack = read_pack(folder)
    limits = pack.profile.acceptance
    typer.echo(f"{pack.profile.title}: {limits.min_cm:g} to {limits.max_cm:g} cm")
    for task, path in (("fruit", pack.segment), ("keypoints", pack.pose)):
        if path is None:
            typer.echo(f"{task}: the package's own network")
            continue
        card = "with its card" if path.with_suffix(".json").is_file() else "without a card"
        typer.echo(f"{task}: {path.name}, {YoloDetector(path).task}, {card}")
    if pack.truth is None:
        typer.echo("truth: none; lengths of this crop were never compared")
    else:
        typer.echo(f"truth: {len(read_truth(pack.truth).lengths)} lengths measured by hand")
