"""What rounds look like on screen."""

from __future__ import annotations

from datetime import datetime
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from cucumbervision.cli.console import progress_bar, show_failures
from cucumbervision.pipeline.measurer import exit_code
from cucumbervision.pipeline.run import count_captures
from cucumbervision.rounds.adding import add_captures
from cucumbervision.rounds.from_store import read_round
from cucumbervision.rounds.merge import MergeSettings
from cucumbervision.rounds.service import (
    find_fruit,
    find_round,
    fruit_table,
    link_rounds,
    merge_round,
)
from cucumbervision.store.images import check_store
from cucumbervision.store.repository import open_store

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from cucumbervision.agronomy.profiles import CropProfile
    from cucumbervision.pipeline.options import MeasureOptions
    from cucumbervision.rounds.adding import Place
    from cucumbervision.rounds.service import RoundFruit
    from cucumbervision.store.repository import Store

__all__ = [
    "add_and_show",
    "by_hand",
    "check_and_show",
    "link_and_show",
    "merge_and_show",
    "show_picks",
    "show_round",
    "show_rounds",
    "undo_action",
]


def _console() -> Console:
    # A file or a pipe has no width of its own; 80 columns would cut the table.
    return Console(highlight=False, width=None if Console().is_terminal else 120)


def _table(title: str | None, left: Sequence[str], *right: str) -> Table:
    table = Table(*left, title=title, title_justify="left")
    for head in right:
        table.add_column(head, justify="right")
    return table


def add_and_show(
    where: str,
    images: Path | None,
    name: str,
    inputs: Sequence[Path],
    options: MeasureOptions,
    place: Place,
) -> int:
    """Add captures, show progress, and return the exit code."""
    errors = Console(stderr=True, highlight=False)
    with open_store(where, images=images) as store, progress_bar(errors) as bar:
        key = find_round(store, name).key
        task = bar.add_task("measuring", total=count_captures(inputs, options.reading))
        done = add_captures(store, key, inputs, options, place, lambda _: bar.advance(task))
    new = [one for one in done if one.new]
    failures = [one.failure for one in done if one.failure]
    there = len(done) - len(new) - len(failures)
    fruit = sum(one.fruit for one in new)
    console = _console()
    console.print(f"{len(new)} stops added with {fruit} fruit; {there} were there already.")
    show_failures(failures)
    return exit_code(len(done) - len(failures), failures)


def merge_and_show(where: str, name: str, across_m: float | None) -> None:
    """Merge a round and show what was found; `across_m` lies between the two aisles' cameras."""
    settings = MergeSettings()
    if across_m is not None:
        settings = MergeSettings(across_m=across_m, across_sd_m=0.05)
    with open_store(where) as store:
        rows = merge_round(store, find_round(store, name).key, settings)
    table = _table("Merged rows", ("row",), "stops", "views", "fruit", "expected", "stops known to")
    for row in rows:
        table.add_row(
            row.row,
            str(row.stops),
            str(row.views),
            str(row.fruit),
            f"{row.expected:.0f} ± {row.expected_sd:.0f}",
            "" if row.stop_sd_m is None else f"{100 * row.stop_sd_m:.1f} cm",
        )
    console = _console()
    console.print(table)
    for row in rows:
        if row.unplaced:
            console.print(
                f"row {row.row}: {row.unplaced} fruit without position or depth stand alone"
            )
        for side in row.mirrored:
            console.print(
                f"row {row.row}, side {side}: positions seem to get higher the other way; "
                "add its captures to a new round with --higher-to"
            )


def link_and_show(where: str, earlier: str, later: str) -> None:
    """Link the fruit of two rounds and show what was found."""
    with open_store(where) as store:
        rows = link_rounds(store, find_round(store, earlier).key, find_round(store, later).key)
    table = _table(
        "Fruit found again", ("row",), "earlier", "later", "linked", "sure", "moved along"
    )
    for row in rows:
        moved = f"{100 * row.shift_m:.0f} ± {100 * row.shift_sd_m:.0f} cm"
        counts = (row.earlier, row.later, row.links, row.sure)
        table.add_row(row.row, *(str(count) for count in counts), moved)
    _console().print(table)


def _profile(given: str | None, of_round: str) -> CropProfile | None:
    from cucumbervision.agronomy.profiles import load_profile

    name = given or of_round
    return load_profile(name) if name else None


def show_round(where: str, name: str, given: str | None, limit: int) -> None:
    """Show a round's fruit."""
    with open_store(where) as store:
        view = find_round(store, name)
        lines = fruit_table(read_round(store, view.key))
    profile = _profile(given, view.record.profile)
    title = f"{view.record.name or view.key}: {len(lines)} fruit, lengths in cm"
    right = ("at, m", "length", "90 % interval", "all views", "seen")
    table = _table(title, ("no.", "row", "side"), *right)
    for head in ("class", "remarks", "key"):
        table.add_column(head, overflow="fold")
    shown = lines[:limit] if limit else lines
    for line in shown:
        table.add_row(*_cells(line, profile))
    if len(shown) < len(lines):
        table.caption = f"and {len(lines) - len(shown)} more; --limit 0 shows all"
    _console().print(table)


def _cells(line: RoundFruit, profile: CropProfile | None) -> list[str]:
    view, record = line.view, line.view.record
    low, high = record.interval_low_m, record.interval_high_m
    name = ""
    if profile is not None:
        from cucumbervision.rounds.forecasting import grade_of

        name = grade_of(record, profile).name
    remarks = [record.flags]
    if view.picked_s is not None:
        remarks.insert(0, "picked")
    if record.length_m is None:
        remarks.insert(0, f"not measured: {record.reason}")
    all_views = ""
    if line.combined_m is not None and line.combined_sd_m is not None and line.seen > 1:
        all_views = f"{100 * line.combined_m:.1f} ± {100 * line.combined_sd_m:.1f}"
    return [
        str(line.number),
        view.row or "",
        view.side or "",
        "" if view.along_m is None else f"{view.along_m:.2f}",
        "" if record.length_m is None else f"{100 * record.length_m:.1f}",
        "" if low is None or high is None else f"{100 * low:.1f} – {100 * high:.1f}",
        all_views,
        str(line.seen),
        name,
        " ".join(part for part in remarks if part),
        view.key[:8],
    ]


def show_rounds(where: str) -> None:
    """Return rounds."""
    with open_store(where) as store:
        rounds = store.rounds()
    table = _table(None, ("key", "name", "house", "began", "profile"), "stops", "views")
    for one in rounds:
        began = datetime.fromtimestamp(one.record.started_s).astimezone()
        text = began.strftime("%Y-%m-%d %H:%M")
        record = one.record
        counts = str(one.stops), str(one.fruit)
        table.add_row(one.key[:8], record.name, record.house, text, record.profile, *counts)
    _console().print(table)


def show_picks(where: str, name: str, given: str | None) -> None:
    """Show today's ready fruit."""
    from cucumbervision.agronomy.picking import pick_list
    from cucumbervision.agronomy.profiles import load_profile
    from cucumbervision.rounds.forecasting import forecast_for

    with open_store(where) as store:
        view = find_round(store, name)
        profile = load_profile(given or view.record.profile or "long-cucumber")
        picks = pick_list(forecast_for(store, view.key, profile, days=0))
        numbers = {line.view.key: line.number for line in fruit_table(read_round(store, view.key))}
    left = ("no.", "row", "side")
    table = _table(f"{len(picks)} to pick", left, "at, m", "length, cm", "ready")
    table.add_column("class")
    for pick in picks:
        fruit = pick.fruit
        table.add_row(
            str(numbers.get(fruit.fruit_id, "")),
            fruit.row,
            fruit.side,
            f"{fruit.position_m:.2f}",
            f"{100 * fruit.length_m:.1f}",
            f"{100 * pick.ready:.0f} %",
            pick.name,
        )
    _console().print(table)


def by_hand(
    where: str,
    fruit: Sequence[tuple[str, str]],
    action: Callable[[Store, list[str]], int],
) -> None:
    """Do something by hand to fruit that are named by their rounds and numbers or keys."""
    with open_store(where) as store:
        keys = [find_fruit(store, find_round(store, name).key, one).key for name, one in fruit]
        _console().print(f"logged as action {action(store, keys)}")


def undo_action(where: str, name: str, number: int | None, by: str) -> None:
    """Take back an action of a round: the newest, or the one of this number."""
    with open_store(where) as store:
        done = store.undo(find_round(store, name).key, number=number, by=by)
        _console().print(f"logged as action {done}")


def check_and_show(where: str, images: Path | None, *, contents: bool, remove: bool) -> int:
    """Check a store, show what was found, and return the exit code."""
    with open_store(where, images=images, create=False) as store:
        found = check_store(store, contents=contents, remove=remove)
    console = _console()
    console.print(f"{found.pictures} pictures, {len(found.orphans)} files that no stop names")
    for path in found.removed:
        console.print(f"removed: {path}", soft_wrap=True, markup=False)
    problems = [f"missing: {path}" for path in found.missing]
    problems += [f"damaged: {path}" for path in found.damaged]
    for problem in (*problems, *found.faults):
        console.print(problem, soft_wrap=True, markup=False)
    console.print("sound" if found.sound else "copy what is missing or damaged from a backup")
    return 0 if found.sound else 1
