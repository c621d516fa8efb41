"""`cucumbervision models` and `crop`: networks, and a crop's folder with networks of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(name="models", help="List, select and export the networks.", no_args_is_help=True)

Name = Annotated[str, typer.Argument(help="A name that `models list` shows.")]


@app.command("list")
def list_models() -> None:
    """List every network: task, licence, size, origin, and whether it is on this machine.

    The files on this machine are hashed; those that differ from the registry are named at the end.
    """
    from rich.table import Table

    from cucumbervision.cli.console import plain_console
    from cucumbervision.errors import ModelError
    from cucumbervision.networks.registry import load_registry

    registry = load_registry()
    faults: list[ModelError] = []
    table = Table("name", "task", "licence", "size", "from", "state")
    for model in registry.models:
        size = f"{model.size_bytes / 1e6:.0f} MB"
        state = "embedded" if model.embedded else "yours"
        if model in registry.user_models and model == registry.default(model.task):
            state = "in use"
        try:
            registry.resolve(model.name)
        except ModelError as error:
            faults.append(error)
            state = "damaged"
        table.add_row(model.name, model.task, model.licence, size, model.origin, state)
    plain_console().print(table)
    for fault in faults:
        plain_console().print(str(fault), soft_wrap=True)
    raise typer.Exit(1 if faults else 0)


@app.command()
def use(
    path: Annotated[
        Path | None,
        typer.Argument(help="A `train house` run, or a YOLO .onnx.", metavar="RUN_OR_ONNX"),
    ] = None,
    anyway: Annotated[
        bool,
        typer.Option("--anyway", help="Use it even if it was not evaluated, or is not better."),
    ] = False,
    shipped: Annotated[
        bool, typer.Option("--shipped", help="Use the package's own networks again.")
    ] = False,
) -> None:
    """Use a network of your own for measure, detect, rounds and dashboard, if it is better.

    A running dashboard must be restarted.
    """
    from cucumbervision.cli.console import plain_console
    from cucumbervision.errors import ModelError
    from cucumbervision.networks.registry import use_network, use_shipped

    if (path is None) != shipped:
        raise ModelError("name one network", remedy="give RUN_OR_ONNX or --shipped")
    if path is None:
        use_shipped()
        words = "the package's own networks"
    else:
        network = use_network(path, anyway=anyway)
        words = f"{network.name} ({network.task})"
    plain_console().print(f"In use now: {words}", soft_wrap=True)


@app.command()
def export(
    name: Name,
    out: Annotated[Path, typer.Option("--out", help="Folder to write into.", metavar="DIR")],
) -> None:
    """Copy a network's verified ONNX files."""
    from cucumbervision.cli.console import plain_console
    from cucumbervision.networks.registry import load_registry

    for path in load_registry().export(name, out):
        plain_console().print(str(path), soft_wrap=True)


crops = typer.Typer(
    name="crop",
    help="Crop packs: a folder with profile, networks, cards and truth, for --profile FOLDER.",
    no_args_is_help=True,
)

Pack = Annotated[Path, typer.Argument(help="The crop's folder.", metavar="FOLDER")]


@crops.command()
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


@crops.command()
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
