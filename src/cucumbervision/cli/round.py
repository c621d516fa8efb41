"""`cucumbervision round`: walk a house, merge what was seen, link days, list, pick."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cucumbervision.cli.choices import EXIT_CODES, RuntimeChoice
from cucumbervision.measurement.result import LengthDefinition

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
    length: Annotated[
        LengthDefinition, typer.Option(help="As in `measure`.")
    ] = LengthDefinition.THREAD,
    confidence: Annotated[float, typer.Option(min=0.0, max=1.0, help="As in `measure`.")] = 0.30,
    input_size: Annotated[str, typer.Option(help="As in `measure`.", metavar="PX[,PX]")] = "",
    calibration: Annotated[Path | None, typer.Option(help="Site's calibration.")] = None,
    runtime: Annotated[RuntimeChoice, typer.Option(help="As in `measure`.")] = RuntimeChoice.auto,
    images: Images = None,
) -> None:
    """Measure captures and save each as a stop; one that is there already is left as it is."""
    from cucumbervision.cli.round_console import add_and_show
    from cucumbervision.perception.yolo import parse_input_sizes
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
        length=length,
        confidence=confidence,
        input_sizes=parse_input_sizes(input_size),
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
    from cucumbervision.cli.round_console import merge_and_show

    merge_and_show(store, round_, across)


@app.command()
def link(
    earlier: Annotated[str, typer.Argument(help="The earlier round: name or key.")],
    store: StoreArg = "house.db",
    round_: RoundName = "",
) -> None:
    """Find the fruit of an earlier round again, though they grew and were moved."""
    from cucumbervision.cli.round_console import link_and_show

    link_and_show(store, earlier, round_)


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
    """Record that two fruit of the table are one; every later merging keeps to it."""
    from cucumbervision.cli.round_console import by_hand

    by_hand(
        store,
        [(round_, first), (round_, second)],
        lambda opened, keys: opened.merge(*keys, by=by),
    )


@app.command()
def unmerge(
    fruit: Annotated[str, typer.Argument(help="A view's key, or a fruit's number for its best.")],
    store: StoreArg = "house.db",
    round_: RoundName = "",
    by: By = "",
) -> None:
    """Record that a view is another fruit than all that it is merged with."""
    from cucumbervision.cli.round_console import by_hand

    by_hand(store, [(round_, fruit)], lambda opened, keys: opened.unmerge(*keys, by=by))


@app.command("link-by-hand")
def link_by_hand(
    earlier: Annotated[str, typer.Argument(help="The earlier round: name or key.")],
    then: Annotated[str, typer.Argument(help="The fruit's number or key in that round.")],
    now: Annotated[str, typer.Argument(help="Its number or key in the later round.")],
    store: StoreArg = "house.db",
    round_: RoundName = "",
    by: By = "",
    apart: Annotated[bool, typer.Option("--apart", help="They are two fruit.")] = False,
) -> None:
    """Record that a fruit is this one of an earlier round; every later linking keeps to it."""
    from cucumbervision.cli.round_console import by_hand

    by_hand(
        store,
        [(earlier, then), (round_, now)],
        lambda opened, keys: (opened.unlink_growth if apart else opened.link_growth)(*keys, by=by),
    )


@app.command()
def pick(
    fruit: Fruit,
    store: StoreArg = "house.db",
    round_: RoundName = "",
    by: By = "",
    undo: Annotated[bool, typer.Option("--undo", help="They were not picked.")] = False,
) -> None:
    """Mark fruit as picked: they leave forecast and pick list."""
    from cucumbervision.cli.round_console import by_hand

    by_hand(
        store,
        [(round_, one) for one in fruit],
        lambda opened, keys: (opened.unpick if undo else opened.pick)(keys, by=by),
    )


@app.command()
def undo(
    action: Annotated[
        int | None, typer.Argument(help="Its number; the round's newest without.")
    ] = None,
    store: StoreArg = "house.db",
    round_: RoundName = "",
    by: By = "",
) -> None:
    """Take back what was done by hand, unless a later action stands on it."""
    from cucumbervision.cli.round_console import undo_action

    undo_action(store, round_, action, by)


@app.command()
def check(
    store: StoreArg = "house.db",
    contents: Annotated[
        bool, typer.Option(help="Read every picture and hold it against its hash.")
    ] = True,
    remove: Annotated[
        bool, typer.Option("--remove", help="Remove pictures that no stop names.")
    ] = False,
    images: Images = None,
) -> None:
    """Check a store: its file, and that every picture is there and whole. Exits 1 if not."""
    from cucumbervision.cli.round_console import check_and_show

    raise typer.Exit(check_and_show(store, images, contents=contents, remove=remove))


@app.command("pick-list")
def pick_list(
    store: StoreArg = "house.db", round_: RoundName = "", profile: Profile = None
) -> None:
    """Print today's ready fruit in walking order."""
    from cucumbervision.cli.round_console import show_picks

    show_picks(store, round_, profile)
