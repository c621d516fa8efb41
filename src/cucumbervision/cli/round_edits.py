"""`cucumbervision round`: stops listed and measured again, deleted and brought back."""

from __future__ import annotations

from datetime import datetime
from typing import TYPE_CHECKING, Annotated

import typer

from cucumbervision.cli.choices import Images, RoundName, StoreName, takes_measure_options
from cucumbervision.cli.round import By, opened_round, settle_round, with_limits

if TYPE_CHECKING:
    from cucumbervision.pipeline.options import MeasureOptions

Round = Annotated[str, typer.Argument(help="Name, key or start of a key.")]


def stops(store: StoreName = "house.db", round_: RoundName = "") -> None:
    """List a round's stops in the order in which they were taken."""
    from cucumbervision.cli.console import columns_table, screen

    with opened_round(store, round_, create=False) as (opened, one):
        found = opened.stops(one.key)
    table = columns_table(None, ("no.", "row", "side"), "at, m", "fruit")
    for head in ("taken", "name", "key"):
        table.add_column(head, overflow="fold")
    for stop in found:
        taken = datetime.fromtimestamp(stop.taken_s).astimezone().strftime("%Y-%m-%d %H:%M:%S")
        at = "" if stop.position_m is None else f"{stop.position_m:.2f}"
        number = "" if stop.step is None else str(stop.step)
        place = number, stop.row or "", stop.side or "", at
        table.add_row(*place, str(stop.fruit), taken, stop.note, stop.key[:8])
    screen().print(table)


def delete_stop(
    stop: Annotated[list[str], typer.Argument(help="Numbers or keys that `round stops` prints.")],
    store: StoreName = "house.db",
    round_: RoundName = "",
    by: By = "",
) -> None:
    """Take stops with all their fruit out of every list; `round undo` brings one back."""
    from cucumbervision.cli.console import screen
    from cucumbervision.rounds.service import find_stop

    with opened_round(store, round_, create=False) as (opened, one):
        for key in [find_stop(opened, one.key, name).key for name in stop]:
            screen().print(f"logged as action {opened.delete_stop(key, by=by)}")
        settle_round(opened, one.key)


def delete(name: Round, store: StoreName = "house.db", by: By = "") -> None:
    """Take a round out of the list of rounds; `round restore` brings it back."""
    from cucumbervision.cli.console import screen
    from cucumbervision.rounds.settling import delete_round
    from cucumbervision.store.waiting import WaitingCaptures, waiting_folder

    with opened_round(store, name, create=False) as (opened, one):
        after = delete_round(opened, one.key, WaitingCaptures(waiting_folder(store)), by=by)
        screen().print(f"deleted; `cucumbervision round restore {one.key[:8]}` brings it back")
        for key in after:
            settle_round(opened, key)


def restore(name: Round, store: StoreName = "house.db", by: By = "") -> None:
    """Bring a deleted round back, its fruit linked to the days before and after as they were."""
    from cucumbervision.cli.console import screen
    from cucumbervision.rounds.service import find_round
    from cucumbervision.store.repository import open_store

    with open_store(store, create=False) as opened:
        key = find_round(opened, name, deleted=True).key
        screen().print(f"logged as action {opened.restore_round(key, by=by)}")
        settle_round(opened, key)


@takes_measure_options("profile", "depth", "intrinsics", "depth_unit", "burst")
def remeasure(
    store: StoreName = "house.db",
    round_: RoundName = "",
    images: Images = None,
    *,
    options: MeasureOptions,
) -> None:
    """Measure a round again from the captures that the store keeps, and merge it.

    Stops stay where they are. Fruit that are found again keep what was decided of them by hand.
    """
    from rich.console import Console

    from cucumbervision.cli.console import progress_bar, screen, show_failures
    from cucumbervision.pipeline.measurer import exit_code
    from cucumbervision.rounds.remeasuring import measure_round_again

    with opened_round(store, round_, images) as (opened, one):
        with progress_bar(Console(stderr=True, highlight=False)) as bar:
            task = bar.add_task("measuring", total=None)
            done, failures = measure_round_again(
                *(opened, one.key, with_limits(options, one)),
                lambda k, of: bar.update(task, completed=k, total=of),
            )
        settle_round(opened, one.key)
    screen().print(f"{done} stops measured again.")
    show_failures(failures)
    raise typer.Exit(exit_code(done, failures))
