"""`cucumbervision round`: walk a house, merge what was seen, link days, list, pick."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cucumbervision.cli.choices import EXIT_CODES, LengthChoice, RuntimeChoice

__all__ = ["app"]

app = typer.Typer(
    name="round",
    help="Rounds of a house: stops, fruit counted once, growth between days, picking.",
    no_args_is_help=True,
)

StoreArg = Annotated[
    str,
    typer.Option(
        "--store", envvar="CUCUMBERVISION_STORE", help="SQLite file, or postgresql://… address."
    ),
]
Images = Annotated[
    Path | None, typer.Option(help="Folder of the pictures; needed with PostgreSQL.")
]
RoundName = Annotated[
    str, typer.Option("--round", "-r", help="Name, key or start of a key; the newest without.")
]
Fruit = Annotated[list[str], typer.Argument(help="Numbers or keys that `round show` prints.")]
By = Annotated[str, typer.Option("--by", help="Who says so; goes into the log.")]
Profile = Annotated[
    str | None, typer.Option(help="Crop profile for classes; by default the round's own.")
]


@app.command()
def new(
    name: Annotated[str, typer.Argument(help="What to call the round.")] = "",
    store: StoreArg = "house.db",
    house: Annotated[str, typer.Option(help="The greenhouse.")] = "",
    profile: Annotated[str, typer.Option(help="Crop profile.")] = "long-cucumber",
    note: Annotated[str, typer.Option(help="Whatever should be remembered.")] = "",
    images: Images = None,
) -> None:
    """Begin a round and print its key."""
    from cucumbervision.agronomy.profiles import load_profile
    from cucumbervision.store.records import RoundRecord
    from cucumbervision.store.repository import open_store

    load_profile(profile)
    record = RoundRecord(name=name, house=house, profile=profile, note=note)
    with open_store(store, images=images) as opened:
        opened.save_round(record)
    typer.echo(record.key)


@app.command(epilog=EXIT_CODES)
def add(
    captures: Annotated[list[Path], typer.Argument(help="Whatever `measure` reads.")],
    store: StoreArg = "house.db",
    round_: RoundName = "",
    row: Annotated[str | None, typer.Option(help="Row of the house.")] = None,
    side: Annotated[str | None, typer.Option(help="Side of the row, such as left.")] = None,
    position: Annotated[
        float | None, typer.Option(help="Of the first capture along the row, metres.")
    ] = None,
    spacing: Annotated[
        float, typer.Option(help="From one capture to the next, metres; negative backwards.")
    ] = 0.4,
    position_sd: Annotated[
        float, typer.Option(min=0.001, max=5.0, help="How sure positions are, metres.")
    ] = 0.03,
    higher_to: Annotated[
        str | None,
        typer.Option(help="right or left: where in the picture positions get higher."),
    ] = None,
    poses: Annotated[
        Path | None, typer.Option(help="Pose file (CSV or JSON) by the captures' names.")
    ] = None,
    instances: Annotated[str, typer.Option(help="As in `measure`.")] = "auto",
    length: Annotated[LengthChoice, typer.Option(help="As in `measure`.")] = LengthChoice.thread,
    confidence: Annotated[float, typer.Option(min=0.0, max=1.0, help="As in `measure`.")] = 0.30,
    calibration: Annotated[Path | None, typer.Option(help="Site's calibration.")] = None,
    runtime: Annotated[RuntimeChoice, typer.Option(help="As in `measure`.")] = RuntimeChoice.auto,
    images: Images = None,
) -> None:
    """Measure captures and save each as a stop; one that is there already is left as it is."""
    from cucumbervision.cli.round_console import add_and_show
    from cucumbervision.measurement.result import LengthDefinition
    from cucumbervision.pipeline.options import MeasureOptions
    from cucumbervision.rounds.adding import Place
    from cucumbervision.rounds.poses import read_poses

    if higher_to not in (None, "left", "right"):
        raise typer.BadParameter("give right or left", param_hint="--higher-to")
    sign = {None: None, "right": 1, "left": -1}[higher_to]
    given = {} if poses is None else read_poses(poses)
    place = Place(row, side, position, spacing, position_sd, sign, given)
    options = MeasureOptions(
        instances=instances,
        length=LengthDefinition(length.value),
        confidence=confidence,
        runtime=runtime.value,
        calibration=calibration,
    )
    raise typer.Exit(add_and_show(store, images, round_, captures, options, place))


@app.command("merge")
def merge(
    store: StoreArg = "house.db",
    round_: RoundName = "",
    across: Annotated[
        float | None, typer.Option(help="Between the cameras of two aisles, metres, if known.")
    ] = None,
) -> None:
    """Find which fruit were seen from several stops; what was decided by hand stands."""
    from cucumbervision.cli.round_console import show_rows
    from cucumbervision.rounds.merge import MergeSettings
    from cucumbervision.rounds.service import find_round, merge_round
    from cucumbervision.store.repository import open_store

    settings = MergeSettings()
    if across is not None:
        settings = MergeSettings(across_m=across, across_sd_m=0.05)
    with open_store(store) as opened:
        show_rows(merge_round(opened, find_round(opened, round_).key, settings))


@app.command()
def link(
    earlier: Annotated[str, typer.Argument(help="The earlier round: name or key.")],
    store: StoreArg = "house.db",
    round_: RoundName = "",
) -> None:
    """Find the fruit of an earlier round again, though they grew and were moved."""
    from cucumbervision.cli.round_console import show_links
    from cucumbervision.rounds.service import find_round, link_rounds
    from cucumbervision.store.repository import open_store

    with open_store(store) as opened:
        keys = find_round(opened, earlier).key, find_round(opened, round_).key
        show_links(link_rounds(opened, *keys))


@app.command()
def show(
    store: StoreArg = "house.db",
    round_: RoundName = "",
    profile: Profile = None,
    limit: Annotated[int, typer.Option(min=0, help="Most lines; 0 for all.")] = 60,
) -> None:
    """Show a round's fruit by row and position."""
    from cucumbervision.cli.round_console import show_round

    show_round(store, round_, profile, limit)


@app.command("list")
def list_(store: StoreArg = "house.db") -> None:
    """List the rounds, the newest first."""
    from cucumbervision.cli.round_console import show_rounds

    show_rounds(store)


@app.command("merge-by-hand")
def merge_by_hand(
    first: Annotated[str, typer.Argument(help="A fruit's number or key.")],
    second: Annotated[str, typer.Argument(help="The other's.")],
    store: StoreArg = "house.db",
    round_: RoundName = "",
    by: By = "",
) -> None:
    """Say that two fruit of the table are one; every later merging keeps to it."""
    from cucumbervision.rounds.service import find_fruit, find_round
    from cucumbervision.store.repository import open_store

    with open_store(store) as opened:
        key = find_round(opened, round_).key
        pair = [find_fruit(opened, key, name).key for name in (first, second)]
        typer.echo(f"logged as action {opened.merge(*pair, by=by)}")


@app.command()
def unmerge(
    fruit: Annotated[str, typer.Argument(help="A view's key, or a fruit's number for its best.")],
    store: StoreArg = "house.db",
    round_: RoundName = "",
    by: By = "",
) -> None:
    """Say that a view is another fruit than all that it is merged with."""
    from cucumbervision.rounds.service import find_fruit, find_round
    from cucumbervision.store.repository import open_store

    with open_store(store) as opened:
        one = find_fruit(opened, find_round(opened, round_).key, fruit)
        typer.echo(f"logged as action {opened.unmerge(one.key, by=by)}")


@app.command()
def pick(
    fruit: Fruit,
    store: StoreArg = "house.db",
    round_: RoundName = "",
    by: By = "",
    undo: Annotated[bool, typer.Option("--undo", help="They were not picked.")] = False,
) -> None:
    """Mark fruit as picked: they leave forecast and pick list."""
    from cucumbervision.rounds.service import find_fruit, find_round
    from cucumbervision.store.repository import open_store

    with open_store(store) as opened:
        key = find_round(opened, round_).key
        keys = [find_fruit(opened, key, name).key for name in fruit]
        number = opened.unpick(keys, by=by) if undo else opened.pick(keys, by=by)
        typer.echo(f"logged as action {number}")


@app.command("pick-list")
def pick_list(
    store: StoreArg = "house.db", round_: RoundName = "", profile: Profile = None
) -> None:
    """Print today's ready fruit in walking order."""
    from cucumbervision.cli.round_console import show_picks

    show_picks(store, round_, profile)
