"""`cucumbervision round` and `export`: create, fill, merge, link, list, check and export rounds."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import cucumbervision_greenhouse as greenhouse
from cucumbervision.cli import choices
from cucumbervision_greenhouse import rounds
from cucumbervision_greenhouse.exports import ExportFormat

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from cucumbervision.crop.profiles import CropProfile
    from cucumbervision.run.batch import LoopOptions
    from cucumbervision.run.options import MeasureOptions
    from cucumbervision_greenhouse import Round, Store
    from cucumbervision_greenhouse.rounds.adding import Added


app = typer.Typer(
    name="round",
    help="Rounds of a house: stops, fruit counted once, growth between days, picking.",
    no_args_is_help=True,
)


@contextmanager
def opened_round(where: str, name: str) -> Iterator[tuple[Store, Round]]:
    """Open a store and find a round in it; close the store at the end."""
    with greenhouse.open_store(where, create=False) as store:
        yield store, rounds.find_round(store, name)


def _show(
    title: str | None,
    text_heads: Sequence[str],
    right_heads: Sequence[str],
    lines: Iterable[Iterable[object]],
    *last_heads: str,
) -> None:
    """Print a table; its last columns are folded where they are too wide."""
    from cucumbervision.cli.console import columns_table, screen

    table = columns_table(title, text_heads, *right_heads)
    for head in last_heads:
        table.add_column(head, overflow="fold")
    for line in lines:
        table.add_row(*map(str, line))
    screen().print(table)


def chosen_profile(name: str | None, round_summary: Round) -> CropProfile | None:
    """Return the crop profile that is named, or else the round's own; None without either."""
    from cucumbervision.crop.profiles import load_profile

    profile = name or round_summary.profile
    return load_profile(profile) if profile else None


@app.command()
def new(
    name: Annotated[str, typer.Argument(help="Name of the round.")] = "",
    store: choices.StoreName = "house.db",
    house: Annotated[str, typer.Option(help="The greenhouse.")] = "",
    profile: Annotated[str, typer.Option(help="Crop profile.")] = "long-cucumber",
) -> None:
    """Create a round and print its key."""
    from cucumbervision.crop.profiles import load_profile

    load_profile(profile)
    record = greenhouse.Round(name=name, house=house, profile=profile)
    with greenhouse.open_store(store) as opened:
        opened.save_round(record)
        saved = opened.round(record.key)
    if saved is not None and saved.house != house.strip():
        typer.echo(f"the round is in the house '{saved.house}', known by that name", err=True)
    typer.echo(record.key)


@app.command(epilog=choices.EXIT_CODES)
@choices.takes("options", choices.measure_options, {"profile", "depth"} | choices.OF_CAMERA_FILE)
@choices.takes("loop", choices.loop_options)
def add(
    captures: Annotated[list[Path], typer.Argument(help="Inputs as for `measure`.")],
    store: choices.StoreName = "house.db",
    round_: choices.RoundName = "",
    row: Annotated[str | None, typer.Option(help="Row of the house.")] = None,
    side: Annotated[str | None, typer.Option(help="Side of the row, such as left.")] = None,
    position: Annotated[
        float | None, typer.Option(help="Position of the first capture along the row, metres.")
    ] = None,
    spacing: Annotated[
        float,
        typer.Option(help="Distance between captures, metres; negative for walking backwards."),
    ] = 0.4,
    position_sd: Annotated[
        float, typer.Option(min=0.001, max=5.0, help="Standard deviation of positions, metres.")
    ] = 0.03,
    higher_to: Annotated[
        str | None,
        typer.Option(help="right or left: direction of increasing positions in the picture."),
    ] = None,
    poses: Annotated[
        Path | None, typer.Option(help="Pose file (CSV or JSON) by the captures' names.")
    ] = None,
    *,
    options: MeasureOptions,
    loop: LoopOptions,
) -> None:
    """Measure captures and save each as a stop.

    A capture that the round has already stays as it is; `round remeasure` measures a round again.
    """
    from rich.console import Console

    from cucumbervision.cli.console import progress_bar, screen, stopping_gently
    from cucumbervision.run.batch import count_captures

    lines = {} if poses is None else rounds.read_poses(poses)
    place = rounds.Place(row, side, position, spacing, position_sd, _sign(higher_to), lines)
    with (
        opened_round(store, round_) as (opened, round_summary),
        progress_bar(Console(stderr=True, highlight=False)) as bar,
        stopping_gently() as is_cancelled,
    ):
        total = count_captures(captures, options.reading)
        step = partial(bar.advance, bar.add_task("measuring", total=total))
        options = with_limits(options, round_summary)
        loop = replace(loop, is_cancelled=is_cancelled)
        stops = rounds.add_captures(
            opened, round_summary.key, captures, options, place, lambda _: step(), loop
        )
        doubts = rounds.round_doubts(opened.detections(round_summary.key))
    if unused := sorted(place.poses.keys() - {stop.name for stop in stops}):
        line = f"{poses}: no capture is called {', '.join(unused)}"
        screen().print(line, soft_wrap=True, markup=False)
    exit_status = _show_added(stops, interrupted=is_cancelled())
    for line in doubts:
        screen().print(f"Check the data of this round: {line}", soft_wrap=True, markup=False)
    raise typer.Exit(exit_status)


def _sign(higher_to: str | None) -> int | None:
    if higher_to not in (None, "left", "right"):
        raise typer.BadParameter("give right or left", param_hint="--higher-to")
    return {None: None, "right": 1, "left": -1}[higher_to]


def with_limits(options: MeasureOptions, round_summary: Round) -> MeasureOptions:
    """Return the options with the lengths that the round's crop can have."""
    profile = chosen_profile(None, round_summary)
    return options if profile is None else options.for_crop(profile)


def _show_added(done: Sequence[Added], *, interrupted: bool) -> int:
    """Print the outcome of the captures, and return the exit code."""
    from cucumbervision.cli.console import screen, show_failures
    from cucumbervision.run.measurer import exit_code

    new = [added for added in done if added.new]
    failures = [added.failure for added in done if added.failure]
    present = len(done) - len(new) - len(failures)
    fruit = sum(added.fruit for added in new)
    screen().print(f"{len(new)} stops added with {fruit} fruit; {present} were there already.")
    if deleted := sum(added.deleted for added in done):
        screen().print(f"{deleted} of these were deleted: undo the deletion to restore them.")
    show_failures(failures)
    return 130 if interrupted else exit_code(len(done) - len(failures), failures)


@app.command(epilog=choices.EXIT_CODES)
@choices.takes(
    "options",
    choices.measure_options,
    {"profile", "depth", "intrinsics", "burst"} | choices.OF_CAMERA_FILE,
)
@choices.takes("loop", choices.loop_options)
def remeasure(
    store: choices.StoreName = "house.db",
    round_: choices.RoundName = "",
    *,
    options: MeasureOptions,
    loop: LoopOptions,
) -> None:
    """Measure a round again from the captures that the store keeps, into a new version of it.

    The new round takes the old one's place: name, stops, and decisions by hand about fruit. The old
    one is deleted, and can be restored in the dashboard.
    """
    from rich.console import Console

    from cucumbervision.cli.console import progress_bar, screen, show_failures
    from cucumbervision.run.measurer import exit_code

    with opened_round(store, round_) as (opened, round_summary):
        with progress_bar(Console(stderr=True, highlight=False)) as bar:
            task = bar.add_task("measuring", total=None)
            key, failures = rounds.measure_round_again(
                *(opened, round_summary, with_limits(options, round_summary)),
                lambda k, total: bar.update(task, completed=k, total=total),
                loop,
            )
        fault = rounds.settle(opened, key, chosen_profile(None, rounds.find_round(opened, key)))
    if fault:
        screen().print(fault, soft_wrap=True, markup=False)
    kept = "nothing was changed" if failures else f"the new round is {key}"
    screen().print(f"{round_summary.stops} stops measured again; {kept}.")
    show_failures(failures)
    raise typer.Exit(exit_code(0 if failures else 1, failures))


@app.command("merge")
def merge(store: choices.StoreName = "house.db", round_: choices.RoundName = "") -> None:
    """Merge views of the same fruit from several stops; manual decisions are kept."""
    from cucumbervision.cli.console import screen

    with opened_round(store, round_) as (opened, round_summary):
        mirrored = rounds.merge_round(opened, round_summary.key)
        rows = rounds.row_counts(rounds.read_round(opened, round_summary.key))
    lines = []
    for row in rows:
        sd_m = row["stop_sd_m"]
        counts = [row[name] for name in ("row", "stops", "views", "fruit")]
        lines.append([*counts, "" if sd_m is None else f"{100 * sd_m:.1f} cm"])
    _show("Merged rows", ("row",), ("stops", "views", "fruit", "stops known to"), lines)
    console = screen()
    for row in rows:
        name, unplaced = f"row {row['row']}", row["unplaced"]
        if unplaced:
            console.print(f"{name}: {unplaced} fruit without position or depth are not merged")
        for side in mirrored.get(row["row"], ()):
            words = "add its captures to a new round with --higher-to"
            console.print(f"{name}, side {side}: positions seem to be reversed; {words}")


@app.command()
def link(
    earlier: Annotated[str, typer.Argument(help="Name or key of the earlier round.")],
    store: choices.StoreName = "house.db",
    round_: choices.RoundName = "",
) -> None:
    """Link fruit to those of an earlier round, which may have grown and moved."""
    with opened_round(store, earlier) as (opened, before):
        later = rounds.find_round(opened, round_)
        rows = rounds.link_rounds(opened, before.key, later.key, chosen_profile(None, later))
    lines = []
    for row in rows:
        counts = [row[name] for name in ("row", "earlier", "later", "links", "sure")]
        moved = f"{100 * row['shift_m']:.0f} ± {100 * row['shift_sd_m']:.0f} cm"
        lines.append([*counts, moved])
    heads = ("earlier", "later", "linked", "sure", "moved along")
    _show("Fruit found again", ("row",), heads, lines)


@app.command()
def show(
    store: choices.StoreName = "house.db",
    round_: choices.RoundName = "",
    profile: choices.Profile = None,
) -> None:
    """Show a round's fruit by row and position."""
    from cucumbervision.crop.grades import grade
    from cucumbervision.methods.flags import flag_remarks
    from cucumbervision_greenhouse.rounds.fruit_table import fruit_table

    def cm(low: float | None, high: float | None = None) -> str:
        return " – ".join(f"{100 * x:.1f}" for x in (low, high) if x is not None)

    with opened_round(store, round_) as (opened, round_summary):
        table = fruit_table(rounds.read_round(opened, round_summary.key))
    crop = chosen_profile(profile, round_summary)
    lines = []
    for fruit in table:
        unmeasured = f"not measured: {fruit.reason}" if fruit.length is None else ""
        picked = "" if fruit.picked_s is None else "picked"
        lines.append(
            (
                *(fruit.number, fruit.row or "", fruit.side or ""),
                "" if fruit.along_m is None else f"{fruit.along_m:.2f}",
                f"{'≥ ' if fruit.at_least else ''}{cm(fruit.length_m)}",
                "" if fruit.at_least else cm(fruit.interval_low_m, fruit.interval_high_m),
                fruit.views,
                "" if crop is None else grade(fruit, crop).words,
                "; ".join(filter(None, (unmeasured, picked, flag_remarks(fruit.flags)))),
                fruit.key[:8],
            )
        )
    title = f"{round_summary.name or round_summary.key}: {len(table)} fruit, lengths in cm"
    right = ("at, m", "length", "90 % interval", "seen")
    _show(title, ("no.", "row", "side"), right, lines, "class", "remarks", "key")


@app.command("list")
def list_(store: choices.StoreName = "house.db") -> None:
    """List the rounds, newest first."""
    with greenhouse.open_store(store, create=False) as opened:
        walks = opened.rounds()
    lines = []
    for walk in walks:
        walked = datetime.fromtimestamp(walk.walked_s).astimezone().strftime("%Y-%m-%d %H:%M")
        names = (walk.key[:8], walk.name, walk.house, walked, walk.profile)
        lines.append((*names, walk.stops, walk.fruit))
    _show(None, ("key", "name", "house", "walked", "profile"), ("stops", "views"), lines)


@app.command()
def check(
    store: choices.StoreName = "house.db",
    remove: Annotated[
        bool, typer.Option("--remove", help="Remove pictures that no stop refers to.")
    ] = False,
) -> None:
    """Verify a store: its file, all hashes and all images. Exits with 1 if something is wrong."""
    from cucumbervision.cli.console import screen
    from cucumbervision_greenhouse.store.check import check_store

    with greenhouse.open_store(store, create=False) as opened:
        report = check_store(opened, remove=remove)
    console = screen()
    console.print(f"{report.pictures} pictures, {len(report.orphans)} files that no stop names")
    kinds = ("removed", "missing", "damaged")
    lines = [f"{kind}: {path}" for kind in kinds for path in getattr(report, kind)]
    for line in (*lines, *report.faults):
        console.print(line, soft_wrap=True, markup=False)
    console.print("sound" if report.sound else "copy what is missing or damaged from a backup")
    raise typer.Exit(0 if report.sound else 1)


def export(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the files.")],
    round_: Annotated[
        str,
        typer.Argument(metavar="[ROUND]", help="Name, key or start of a key; default: the newest."),
    ] = "",
    store: choices.StoreName = "house.db",
    formats: Annotated[
        list[ExportFormat] | None,
        typer.Option("--format", "-f", help="Repeat for several; default: csv, xlsx, json."),
    ] = None,
    profile: choices.Profile = None,
) -> None:
    """Export a round: summary, fruit, stops, forecast, pick list, provenance."""
    from cucumbervision_greenhouse.exports.build import round_tables
    from cucumbervision_greenhouse.exports.writers import write_exports

    usual = [ExportFormat.CSV, ExportFormat.XLSX, ExportFormat.JSON]
    with opened_round(store, round_) as (opened, round_summary):
        tables = round_tables(
            opened,
            round_summary.key,
            chosen_profile(profile, round_summary),
            profile_name=profile or round_summary.profile,
        )
        for path in write_exports(tables, out, formats or usual):
            typer.echo(path)
    if tables.note:
        typer.echo(f"no forecast: {tables.note}", err=True)
