"""A round from the store: its rows as arrays, and its fruit, each once, with all its views."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from statistics import fmean, stdev
from typing import Any

import numpy as np

from cucumbervision.errors import RoundError
from cucumbervision.methods.matching import ALONG, DEPTH, UP, pooled_length
from cucumbervision.methods.result import INTERVAL_Z, UNKNOWN_SD, LengthDefinition
from cucumbervision.methods.table import AVAILABLE
from cucumbervision.run.fields import Cell, table_row
from cucumbervision.run.tables import Summary
from cucumbervision_greenhouse.forecast.forecast import natural_key
from cucumbervision_greenhouse.rounds.row_views import Ints, RowStops, RowViews
from cucumbervision_greenhouse.rounds.walking import MIDDLE_SD_M, offset_of, stored_pose
from cucumbervision_greenhouse.store.records import FruitRow, Round, StopRecord, Verdict
from cucumbervision_greenhouse.store.repository import Store

_CAMERA_SD_M = 0.03  # standard deviation of a camera from its usual height and distance
_USUAL_REACH = 0.687  # a D435's colour camera, for stops without a stored camera
_LEAST_SD = 0.01  # of a length, relative
_DIAMETER_SD = 0.05


@dataclass(frozen=True, eq=False)
class StoredRow:
    """One row of a round.

    Parameters
    ----------
    name : str
        The row; empty where it has no name.
    stops : RowStops
        Its stops with a position.
    views : RowViews
        Their detections with a place, rejected ones left out.
    taken : tuple of StopRecord
        The stops, in order.
    fruit : tuple of FruitRow
        The detections, in order.
    sides : tuple of str
        Names of the sides: 0, and 1 where there is one.
    unplaced : int
        Detections that cannot be merged: no position, or no depth.
    """

    name: str
    stops: RowStops
    views: RowViews
    taken: tuple[StopRecord, ...]
    fruit: tuple[FruitRow, ...]
    sides: tuple[str, ...]
    unplaced: int


CONTENTS = 8
"""Rounds whose fruit and counts are kept, once computed from their content."""


@dataclass(frozen=True, eq=False)
class RoundContent:
    """The stored content of a round, read once and shared.

    Parameters
    ----------
    key : str
        The round's.
    stops : tuple of StopRecord
        Its stops.
    views : tuple of FruitRow
        Its detections, in groups.
    """

    key: str
    stops: tuple[StopRecord, ...]
    views: tuple[FruitRow, ...]

    @cached_property
    def rows(self) -> tuple[StoredRow, ...]:
        """Its rows as arrays, computed once."""
        return tuple(_load_rows(self))

    @cached_property
    def group_of(self) -> Mapping[str, str]:
        """The fruit of each view, by the view's key."""
        return {view.key: view.group for view in self.views}


def find_round(store: Store, name: str = "") -> Round:
    """Find a round by its key, the start of it, or its name; the newest without one.

    Raises
    ------
    RoundError
        If no key starts so, or several do.
    """
    rounds = store.rounds()
    name_or_key = name.strip().lower()
    named = [walk for walk in rounds if walk.name == name or walk.key == name_or_key]
    # A short number is never the start of a key: it may be a mistyped name.
    is_start = not name_or_key.isdecimal() or len(name_or_key) > 5
    matches = named or [x for x in rounds if is_start and x.key.startswith(name_or_key)]
    if not name_or_key:
        matches = rounds[:1]
    if len(matches) == 1:
        return matches[0]
    problem = "several rounds are" if matches else "no round is"
    raise RoundError(f"{problem} called '{name}'", source=store.name, remedy="see `round list`")


def read_round(store: Store, round_key: str) -> RoundContent:
    """Read a round.

    Raises
    ------
    StoreError
        If it is not there.
    """
    views = store.detections(round_key)  # first: a stop may be saved meanwhile
    return RoundContent(round_key, tuple(store.stops(round_key)), tuple(views))


def counted_fruit(views: Iterable[FruitRow]) -> list[FruitRow]:
    """Return the fruit of a round, each by its representative view; rejected ones are left out."""
    return [view for view in views if view.best and view.verdict is not Verdict.REJECTED]


def _load_rows(content: RoundContent) -> Iterator[StoredRow]:
    """Yield a round's rows as arrays.

    Raises
    ------
    RoundError
        If a row has more than two sides.
    """
    keys = {stop.key for stop in content.stops}
    counted = (view for view in content.views if view.verdict is not Verdict.REJECTED)
    views = [view for view in counted if view.stop_key in keys]  # a stop may be saved meanwhile
    for name in sorted({stop.row or "" for stop in content.stops}):
        stops = [stop for stop in content.stops if (stop.row or "") == name]
        yield _row(name, stops, [view for view in views if (view.row or "") == name])


def _reach(camera: Mapping[str, Any]) -> float:
    width, fx = camera.get("width"), camera.get("fx")
    return float(width) / 2 / float(fx) if width and fx else _USUAL_REACH


def _row(name: str, stops: Sequence[StopRecord], fruit: Sequence[FruitRow]) -> StoredRow:
    sides = tuple(sorted({stop.side or "" for stop in stops}))
    if len(sides) > 2:
        raise RoundError(
            "row '{row}' has {count} sides: {sides}",
            remedy="call the two sides of a row by two names",
            row=name,
            count=len(sides),
            sides=", ".join(sides),
        )
    taken = [stop for stop in stops if stop.position_m is not None]
    index = {stop.key: k for k, stop in enumerate(taken)}
    poses = {stop.key: stored_pose(stop.pose_now, stop.side) for stop in stops}
    offsets = [(view, offset_of(view, poses[view.stop_key])) for view in fruit]
    places = [(view, at) for view, at in offsets if view.stop_key in index and at is not None]
    # A stop's pose gives the camera's height.
    at_m, sd_m = np.zeros((len(taken), 3)), np.full((len(taken), 3), _CAMERA_SD_M)
    at_m[:, ALONG] = [stop.position_m or 0.0 for stop in taken]
    at_m[:, UP] = [poses[stop.key][UP, 3] for stop in taken]
    sd_m[:, ALONG] = [stop.position_sd_m or MIDDLE_SD_M for stop in taken]
    side = np.array([sides.index(stop.side or "") for stop in taken], np.int64)
    views = [view for view, _ in places]
    at_stop = np.array([index[view.stop_key] for view in views], np.int64)
    captures = {place: k for k, place in enumerate({(v.stop_key, v.capture): 0 for v in views})}
    offset_m = np.array([at for _, at in places], np.float64).reshape(-1, 2, 3)
    offset_m[:, 0, DEPTH] *= np.where(side[at_stop] == 1, -1.0, 1.0)
    length = np.array([_length(view) for view in views], np.float64).reshape(-1, 2)
    return StoredRow(
        name=name,
        stops=RowStops(at_m, sd_m, side, np.array([_reach(x.camera) for x in taken], np.float64)),
        views=RowViews(
            stop=at_stop,
            capture=np.array([captures[v.stop_key, v.capture] for v in views], np.int64),
            offset_m=offset_m[:, 0],
            offset_sd_m=offset_m[:, 1],
            length_m=length[:, 0],
            length_sd=length[:, 1],
            diameter_m=np.array([view.diameter_max_m or np.nan for view in views], np.float64),
            diameter_sd=np.full(len(views), _DIAMETER_SD),
            partial=np.array([view.partial for view in views], bool),
            view_score=np.array([view.view_score for view in views], np.float64),
        ),
        taken=tuple(taken),
        fruit=tuple(views),
        sides=sides,
        unplaced=len(fruit) - len(places),
    )


def _length(view: FruitRow) -> tuple[float, float]:
    """Return the length, NaN where nothing is known of it, and its relative SD."""
    length = view.known_length
    if length is None or not length.value_m > 0:
        return np.nan, UNKNOWN_SD
    # Lengths of another kind may differ by more than any of them errs.
    least_sd = _LEAST_SD if length.kind in set(LengthDefinition) else UNKNOWN_SD
    return length.value_m, max(length.relative_sd or UNKNOWN_SD, least_sd)


def stored_merging(row: StoredRow) -> tuple[Ints, RowStops]:
    """Return each view's fruit, and the stops, as a row was merged and saved."""
    groups = np.array([view.group for view in row.fruit], dtype=str)
    _, cluster = np.unique(groups, return_inverse=True)
    at_m, sd_m = row.stops.at_m.copy(), row.stops.sd_m.copy()
    for k, stop in enumerate(row.taken):
        if stop.fitted_m is not None:
            at_m[k, ALONG], sd_m[k, ALONG] = stop.fitted_m, stop.fitted_sd_m or sd_m[k, ALONG]
    return cluster, replace(row.stops, at_m=at_m, sd_m=sd_m)


def on_the_plant(fruit: Iterable[FruitRow]) -> list[FruitRow]:
    """Return the fruit that count today: neither deleted, picked nor doubtful."""
    return [
        view
        for view in fruit
        if view.picked_s is None and view.verdict is not Verdict.REJECTED and not view.doubtful
    ]


def hanging_lengths_m(fruit: Iterable[FruitRow]) -> list[float]:
    """Return the lengths of the fruit on the plant, metres, that count (`whole_length`)."""
    lengths = (view.whole_length for view in on_the_plant(fruit))
    return [length.value_m for length in lengths if length is not None]


def round_figures(content: RoundContent, table: Sequence[FruitRow]) -> dict[str, Any]:
    """Return the figures of a round, the same on all pages and in all files.

    Parameters
    ----------
    content : RoundContent
        The round.
    table : sequence of FruitRow
        Its `fruit_table`, without rejected fruit.

    Returns
    -------
    dict
        'fruit', 'measured' and 'picked': fruit, those with a length, and those that were picked;
        'detections'; 'mean_m', 'sd_m', 'shortest_m' and 'longest_m' of the lengths of the fruit on
        the plant that count, None without any.
    """
    lengths_m = hanging_lengths_m(table)
    return {
        "fruit": len(table),
        "measured": sum(line.length_m is not None for line in table),
        "picked": sum(line.picked_s is not None for line in table),
        "detections": sum(view.verdict is not Verdict.REJECTED for view in content.views),
        "mean_m": fmean(lengths_m) if lengths_m else None,
        "sd_m": stdev(lengths_m) if len(lengths_m) > 1 else None,
        "shortest_m": min(lengths_m, default=None),
        "longest_m": max(lengths_m, default=None),
    }


def along_rows(view: FruitRow) -> tuple[object, ...]:
    """Return a key by which fruit are sorted by row and position; those without one come last."""
    return natural_key(view.row or ""), view.along_m is None, view.along_m or 0.0, view.key


@lru_cache(maxsize=CONTENTS)  # all pages of a round ask for the same
def fruit_table(content: RoundContent) -> tuple[FruitRow, ...]:
    """Return a round's fruit, each once, by row and position; rejected ones are left out."""
    pooled = _pooled(content)
    best = counted_fruit(content.views)
    best.sort(key=along_rows)
    return tuple(
        view.with_(number=number, **_pooled_length(view, pooled.get(view.key)))
        for number, view in enumerate(best, 1)
    )


def _pooled_length(view: FruitRow, pooled: tuple[float, float] | None) -> dict[str, Any]:
    """Return the length of all views of a fruit."""
    if pooled is None or view.length is None:
        return {}
    length_m, sd_m = pooled
    length = replace(view.length, value_m=length_m)
    if length.low_m is not None:
        spread = math.exp(INTERVAL_Z * sd_m / length_m)
        length = replace(length, low_m=length_m / spread, high_m=length_m * spread)
    return {"length": length}


def _pooled(content: RoundContent) -> dict[str, tuple[float, float]]:
    """Return the pooled lengths of fruit by all keys of their views.

    Only of those that two or more views show whole, with lengths of one kind.
    """
    lengths: dict[str, tuple[float, float]] = {}
    for row in content.rows:
        (cluster, _), views = stored_merging(row), row.views
        order = np.argsort(cluster, kind="stable")
        for members in np.split(order, np.flatnonzero(np.diff(cluster[order])) + 1):
            measured = members[np.isfinite(views.length_m[members]) & ~views.partial[members]]
            kinds = {row.fruit[k].length_kind for k in measured.tolist()}
            length = pooled_length(
                views.length_m[members], views.length_sd[members], views.partial[members]
            )
            if length is not None and len(measured) > 1 and len(kinds) == 1:
                lengths |= dict.fromkeys((row.fruit[k].key for k in members.tolist()), length)
    return lengths


def least_sure_first(fruit: Sequence[FruitRow]) -> list[FruitRow]:
    """Return unjudged fruit with a single view, the least certain first."""
    once = [view for view in fruit if view.views == 1 and view.verdict is None]
    return sorted(once, key=lambda view: (view.score, view.key))


def round_doubts(views: Iterable[FruitRow]) -> list[str]:
    """Return the doubts about the fruit of a round, one line each with the remedy.

    Rejected ones are left out.
    """
    summary = Summary()
    summary.add(_table_row(view) for view in views if view.verdict is not Verdict.REJECTED)
    return summary.doubts()


def _table_row(view: FruitRow) -> dict[str, Cell]:
    row = table_row(vars(view))
    is_measured = any(row[f"{method.lower()}_cm"] is not None for method in AVAILABLE)
    return {**row, "reason": row["reason"] if is_measured else "", "simulated": False}
